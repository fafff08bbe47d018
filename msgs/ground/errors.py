"""The error for invalid user input: the command line prints its message and exits with code 2."""

from __future__ import annotations


class InputError(Exception):
    """A file, key or endpoint given by the user is invalid; the text is a complete message."""
