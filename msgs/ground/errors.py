"""The one error a person can mend: the command line prints it as a sentence and leaves with exit code 2."""

from __future__ import annotations


class InputError(Exception):
    """A file, key or endpoint that a person named does not do; the text is a whole sentence."""
