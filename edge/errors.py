"""The error class for what the user can correct: the command line prints it and exits with code 2."""

from __future__ import annotations


class InputError(Exception):
    """A file, key or device given by the user cannot be used; the text is a complete sentence.

    `key` is the configuration key at fault, for example ("camera", "intrinsics"), if known where it is raised.
    """

    def __init__(self, text: str, key: tuple[str, ...] = ()) -> None:
        super().__init__(text)
        self.key = key
