"""Shared by all examples: command-line arguments and exit codes."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import NoReturn

from msgs.command_line import exit_code
from msgs.topics import check_uav_name


class NoSessionError(Exception):
    """Nothing answers at the endpoint; the text is shown to the user."""


def parse(description: str, count: int | None = None) -> argparse.Namespace:
    """`endpoint`, `uav` and `count` from the command line; the argument `count` is the default."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("-e", "--endpoint", default="tcp/127.0.0.1:7447", help="router or daemon (default %(default)s)")
    parser.add_argument("-u", "--uav", type=_uav, default="uav1", help="vehicle (default %(default)s)")
    until = "on Ctrl-C" if count is None else f"{count}, or on Ctrl-C"
    parser.add_argument("-n", "--count", type=_count, default=count, help=f"end after so many poses (default: {until})")
    return parser.parse_args()


def run(example: Callable[[], None]) -> NoReturn:
    """Run an example and exit: 2 with a message if nothing answers, 141 if the output pipe is closed."""

    def act() -> int:
        try:
            example()
        except BrokenPipeError:
            raise
        except ConnectionError as error:
            raise NoSessionError(str(error)) from error
        return 0

    sys.exit(exit_code(act, NoSessionError))


def _uav(text: str) -> str:
    try:
        return check_uav_name(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) == 0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number above 0")
    return int(text)
