"""Renders fixed-wing aircraft before sky and ground, with exact labels, on any machine with EGL."""
