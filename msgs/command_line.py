"""How a command ends when a person must correct something (a sentence on standard error, exit code 2) or stops it."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Callable

EXIT_BAD_INPUT = 2
# What a shell says of a command that Ctrl-C or a closed pipe ended.
EXIT_INTERRUPTED, EXIT_UNREAD = 130, 141


def exit_code(act: Callable[[], int], bad_input: type[Exception]) -> int:
    """What `act` returns; 2 after it raised `bad_input`, whose text names file and key; 130 after Ctrl-C; 141 where
    nobody reads what it prints, as behind `| head`."""
    try:
        code = act()
        sys.stdout.flush()
    except bad_input as error:
        print(error, file=sys.stderr)
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        if _stdout_is_read():
            raise  # it was another pipe or socket
        # What is still in its buffer would be complained of at the end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return EXIT_UNREAD
    return code


def _stdout_is_read() -> bool:
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return not any(event & select.POLLERR for _, event in poll.poll(0))
