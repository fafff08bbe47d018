"""How a command ends when a person must correct something (a sentence on standard error, exit code 2) or stops it."""

from __future__ import annotations

import sys
from collections.abc import Callable

EXIT_BAD_INPUT = 2
EXIT_INTERRUPTED = 130  # what a shell says of a command that Ctrl-C ended


def exit_code(act: Callable[[], int], bad_input: type[Exception]) -> int:
    """What `act` returns, 2 after it raised `bad_input`, whose text names file and key, or 130 after Ctrl-C."""
    try:
        return act()
    except bad_input as error:
        print(error, file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
