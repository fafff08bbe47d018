"""How commands exit on invalid input or a full disk (a message on standard error, exit code 2) or when interrupted."""

from __future__ import annotations

import io
import os
import re
import select
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from importlib.metadata import PackageNotFoundError, requires

from msgs.interrupts import raise_on_interrupt

EXIT_BAD_INPUT = 2
PROJECT = "mf-uavpose6d-edge"
_DISTRIBUTIONS = {"rerun": "rerun-sdk", "PIL": "pillow"}  # where the distribution is not named like the package
# What a shell reports for a command that Ctrl-C or a closed pipe ended.
EXIT_INTERRUPTED, EXIT_UNREAD = 130, 141


class OutputError(Exception):
    """Standard output cannot be written, as on a full disk; the text is a complete message."""


def exit_code(
    act: Callable[[], int], bad_input: type[Exception] | tuple[type[Exception], ...], extras: Sequence[str] = ()
) -> int:
    """Run `act` and return its exit code; 2 if it raises `bad_input`, whose text names file and key, or OutputError, or
    needs a missing package that one of the `extras` installs; 130 after Ctrl-C; 141 if the output pipe was closed, as
    by `| head`."""
    raise_on_interrupt()
    told: list[type[Exception]] = [OutputError, *(bad_input if isinstance(bad_input, tuple) else [bad_input])]
    if isinstance(sys.stdout, io.TextIOWrapper):
        # As on standard error, characters that the locale's encoding lacks, in paths or our own, are escaped.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = act()
        with output():
            print(end="", flush=True)  # also where there is no standard output: sys.stdout is then None
    except tuple(told) as error:
        say_aside(str(error))
        return EXIT_BAD_INPUT
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        extra = next((extra for extra in extras if _brings(extra, package)), None)
        if extra is None:
            raise
        say_aside(f"the package {package} is missing: pip install '.[{extra}]'")
        return EXIT_BAD_INPUT
    except KeyboardInterrupt:
        return EXIT_INTERRUPTED
    except BrokenPipeError:
        if _stdout_is_read():
            raise  # another pipe or socket broke
        discard_output()
        return EXIT_UNREAD
    return code


@contextmanager
def output() -> Iterator[None]:
    """Around what prints: raises OutputError if standard output cannot be written, and BrokenPipeError if nobody reads
    it any more."""
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        discard_output()
        raise OutputError(f"standard output: cannot be written: {error.strerror}") from error


def say_out(text: str, end: str = "\n") -> None:
    """Print on standard output, at once. Raises as `output`."""
    with output():
        print(text, end=end, flush=True)


def say_aside(text: str) -> None:
    """Print a message on standard error; it is lost if nobody reads it there, or its disk is full."""
    with suppress(OSError):
        print(text, file=sys.stderr, flush=True)


def discard_output() -> None:
    """After an error on standard output: otherwise Python would report it again at exit, when flushing the buffer."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _stdout_is_read() -> bool:
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return not any(event & select.POLLERR for _, event in poll.poll(0))


def _brings(extra: str, package: str) -> bool:
    """Whether an extra of this project installs a package, according to the installed project's metadata."""
    name = _DISTRIBUTIONS.get(package, package).replace("_", "-")
    try:
        wanted = requires(PROJECT) or []
    except PackageNotFoundError:
        return False
    return any(re.fullmatch(rf"{name}\b[^;]*; *extra == .{extra}.", one, re.IGNORECASE) for one in wanted)
