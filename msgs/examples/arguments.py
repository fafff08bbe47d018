"""The arguments that every example takes."""

from __future__ import annotations

import argparse


def parse(description: str, count: int | None = None) -> argparse.Namespace:
    """`endpoint`, `uav` and `count`, from the command line; `count` is what holds where none is given."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("-e", "--endpoint", default="tcp/127.0.0.1:7447", help="router or daemon (default %(default)s)")
    parser.add_argument("-u", "--uav", default="uav1", help="vehicle (default %(default)s)")
    until = "on Ctrl-C" if count is None else f"{count}, or on Ctrl-C"
    parser.add_argument("-n", "--count", type=int, default=count, help=f"end after so many poses (default: {until})")
    return parser.parse_args()
