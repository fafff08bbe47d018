"""Renders fixed-wing aircraft in front of sky and ground, with exact labels, on any machine with EGL."""
