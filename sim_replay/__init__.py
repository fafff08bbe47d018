"""Rendered data, recorded sequences and the harness that replays them through the real daemon."""
