"""How every command ends when a person must correct something: a sentence on standard error, exit code 2."""

from __future__ import annotations

import sys
from collections.abc import Callable

EXIT_BAD_INPUT = 2


def exit_code(act: Callable[[], int], bad_input: type[Exception]) -> int:
    """What `act` returns, or 2 after it raised `bad_input`, whose text names file and key."""
    try:
        return act()
    except bad_input as error:
        print(error, file=sys.stderr)
        return EXIT_BAD_INPUT
