"""Rendered data, recorded sequences, and the tools that replay them through the real daemon."""
