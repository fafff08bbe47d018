"""How a command ends when a person must correct something (a sentence on standard error, exit code 2) or stops it."""

from __future__ import annotations

import os
import re
import select
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, requires

EXIT_BAD_INPUT = 2
PROJECT = "mf-uavpose6d-edge"
_DISTRIBUTIONS = {"rerun": "rerun-sdk"}  # whose name is not its package's
# What a shell says of a command that Ctrl-C or a closed pipe ended.
EXIT_INTERRUPTED, EXIT_UNREAD = 130, 141


def exit_code(act: Callable[[], int], bad_input: type[Exception], extras: Sequence[str] = ()) -> int:
    """What `act` returns; 2 after it raised `bad_input`, whose text names file and key, or wants a package that one of
    the `extras` brings; 130 after Ctrl-C; 141 where nobody reads what it prints, as behind `| head`."""
    try:
        code = act()
        sys.stdout.flush()
    except bad_input as error:
        print(error, file=sys.stderr)
        return EXIT_BAD_INPUT
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        extra = next((extra for extra in extras if _brings(extra, package)), None)
        if extra is None:
            raise
        print(f"the package {package} is missing: pip install '.[{extra}]'", file=sys.stderr)
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


def _brings(extra: str, package: str) -> bool:
    """Whether an extra of this project brings a package, by what the installed project says of itself."""
    name = _DISTRIBUTIONS.get(package, package).replace("_", "-")
    try:
        wanted = requires(PROJECT) or []
    except PackageNotFoundError:
        return False
    return any(re.fullmatch(rf"{name}\b[^;]*; *extra == .{extra}.", one, re.IGNORECASE) for one in wanted)
