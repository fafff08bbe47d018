"""Numbers on the command line, for argparse: what is out of bounds is a ValueError, which it tells."""

from __future__ import annotations

import math


def positive(text: str) -> float:
    """A finite number above zero."""
    number = float(text)
    if not (math.isfinite(number) and number > 0):
        raise ValueError(text)
    return number


def count(text: str) -> int:
    """A whole number from 1 on."""
    number = int(text)
    if number < 1:
        raise ValueError(text)
    return number


def whole(text: str) -> int:
    """A whole number from 0 on that a generator takes as its seed."""
    number = int(text)
    if not 0 <= number < 2**31:
        raise ValueError(text)
    return number


def share(text: str) -> float:
    """A number from 0 to 1."""
    number = float(text)
    if not 0.0 <= number <= 1.0:
        raise ValueError(text)
    return number
