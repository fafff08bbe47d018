"""The one error a person can mend: the command line prints it as a sentence and leaves with exit code 2."""

from __future__ import annotations


class InputError(Exception):
    """A file, key or device that a person named does not do; the text is a whole sentence."""


class SourceLost(Exception):
    """A camera that worked has stopped; opening it again may help."""
