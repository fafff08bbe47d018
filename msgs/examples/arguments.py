"""The arguments that every example takes."""

from __future__ import annotations

import argparse


def parse(description: str) -> argparse.Namespace:
    """`endpoint`, `uav` and `count`, from the command line."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("-e", "--endpoint", default="tcp/127.0.0.1:7447", help="router or daemon (default %(default)s)")
    parser.add_argument("-u", "--uav", default="uav1", help="vehicle (default %(default)s)")
    parser.add_argument("-n", "--count", type=int, help="end after so many poses (default: never)")
    return parser.parse_args()
