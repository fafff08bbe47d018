"""Number types for argparse, whose error messages name the allowed range."""

from __future__ import annotations

import argparse
import math

SEED_MAX = 2**31 - 1


def positive(text: str) -> float:
    """A finite number above zero."""
    number = _number(text)
    if not (math.isfinite(number) and number > 0):
        raise argparse.ArgumentTypeError(f"'{text}' is not a number above 0")
    return number


def count(text: str) -> int:
    """An integer of at least 1."""
    number = _whole_number(text)
    if number is None or number < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not an integer of at least 1")
    return number


def whole(text: str) -> int:
    """A non-negative integer, up to SEED_MAX, for use as a random seed."""
    number = _whole_number(text)
    if number is None or not 0 <= number <= SEED_MAX:
        raise argparse.ArgumentTypeError(f"'{text}' is not an integer from 0 to {SEED_MAX}")
    return number


def share(text: str) -> float:
    """A number from 0 to 1."""
    number = _number(text)
    if not 0.0 <= number <= 1.0:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number from 0 to 1")
    return number


def _number(text: str) -> float:
    """NaN for text that is no number, which fails every range check."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _whole_number(text: str) -> int | None:
    try:
        return int(text)
    except ValueError:
        return None
