"""Validated values from JSON files; every error is a sentence that names the file and the key."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from sim_replay.bop.records import MM_PER_M, Array, BopError

_NUMBER_MAX = 2**63 - 1  # of an image; a time in nanoseconds has 19 digits
ROTATION_TOLERANCE = 0.02  # of R R^T from the identity: tolerates single precision and rounded files, not a shear


def load_json(path: Path) -> Any:
    """The file's content. Raises BopError."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise BopError(f"{path} is missing") from error
    except (OSError, UnicodeDecodeError) as error:
        raise BopError(f"{path} cannot be read: {getattr(error, 'strerror', 'not UTF-8 text')}") from error
    except json.JSONDecodeError as error:
        raise BopError(f"{path} line {error.lineno} is not JSON: {error.msg}") from error
    except RecursionError as error:
        raise BopError(f"{path} nests lists or objects too deep") from error
    except ValueError as error:  # a number with thousands of digits
        raise BopError(f"{path} cannot be read: {error}") from error


def load_object(path: Path, optional: bool = False) -> dict[str, Any]:
    """The file's object by key; an empty one if an optional file does not exist. Raises BopError."""
    if optional and not path.is_file():
        return {}
    value = load_json(path)
    if not isinstance(value, dict):
        raise BopError(f"{path} does not hold an object of pictures or models")
    return value


def by_number(path: Path, entries: dict[str, Any]) -> dict[int, Any]:
    """The entries by number, whose keys are '000003' or '3'. Raises BopError."""
    return {number_key(path, key): entry for key, entry in entries.items()}


def number_key(path: Path, key: str) -> int:
    """The number of an image or model. Raises BopError."""
    if not key.isdecimal() or len(key.lstrip("0")) > len(str(_NUMBER_MAX)) or int(key) > _NUMBER_MAX:
        raise BopError(f"{path}: {key[:80]!r} is not the number of a picture or model")
    return int(key)


def matrix(path: Path, key: str, entry: Any, name: str, shape: tuple[int, ...]) -> Array:
    """Finite numbers of the given shape from entry[name]. Raises BopError."""
    if not isinstance(entry, dict) or name not in entry:
        raise BopError(f"{path}: {key!r} has no {name!r}")
    try:
        values = np.asarray(entry[name], dtype=np.float64).reshape(shape)
    except (ValueError, TypeError, OverflowError) as error:
        raise BopError(f"{path}: {name!r} of {key!r} is not {int(np.prod(shape))} numbers") from error
    if not np.isfinite(values).all():
        raise BopError(f"{path}: {name!r} of {key!r} is not finite")
    return values


def is_rotation(R: Array) -> bool:
    """Whether R [3, 3] is a rotation without shear, scale or reflection."""
    bounded = bool(np.abs(R).max() <= 1.0 + ROTATION_TOLERANCE)  # otherwise the product may overflow
    return bounded and bool(np.abs(R @ R.T - np.eye(3)).max() < ROTATION_TOLERANCE and np.linalg.det(R) > 0)


def rotation(path: Path, key: str, entry: Any, name: str) -> Array:
    """A rotation matrix [3, 3]. Raises BopError, also for a reflection (a left-handed frame)."""
    R = matrix(path, key, entry, name, (3, 3))
    if not is_rotation(R):
        raise BopError(f"{path}: {name!r} of {key!r} is not a rotation (nine numbers, row by row, right-handed)")
    return R


def length_m(path: Path, key: str, entry: Any, name: str, shape: tuple[int, ...]) -> Array:
    """Lengths stated in millimetres, converted to metres. Raises BopError."""
    return matrix(path, key, entry, name, shape) / MM_PER_M


def integer(path: Path, key: str, entry: Any, name: str) -> int:
    """An integer, also if it is written as 5.0. Raises BopError."""
    value = entry.get(name) if isinstance(entry, dict) else None
    if isinstance(value, int) or (isinstance(value, float) and value.is_integer()):
        return int(value)
    raise BopError(f"{path}: {key!r} has no integer {name!r}")
