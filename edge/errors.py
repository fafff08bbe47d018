"""The one error a person can mend: the command line prints it as a sentence and leaves with exit code 2."""

from __future__ import annotations


class InputError(Exception):
    """A file, key or device that a person named does not do; the text is a whole sentence.

    `key` is the configuration key at fault, for example ("camera", "intrinsics"), where the raiser knows it.
    """

    def __init__(self, text: str, key: tuple[str, ...] = ()) -> None:
        super().__init__(text)
        self.key = key
