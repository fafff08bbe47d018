"""Settings in TOML: reads them, validates them with a pydantic model, and reports errors by file and key.

Each package has its own exception type, so every reader here takes the type to raise; it is called with one message.
Not needed by subscribers: msgs.client works without pydantic.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, Strict, ValidationError

# Reasons by pydantic's error type, with its parameters; all others are in pydantic's words.
_REASONS = {
    "extra_forbidden": "unknown key",
    "missing": "is missing",
    **dict.fromkeys(("model_type", "model_attributes_type", "dict_type"), "must hold keys with values"),
    **dict.fromkeys(("tuple_type", "list_type"), "must be a list"),
    **dict.fromkeys(("string_type", "path_type"), "must be text"),
    "bool_type": "must be true or false",
    "int_type": "must be a whole number",
    "float_type": "must be a number",
    "finite_number": "must be a finite number",
    "greater_than": "must be more than {gt:.12g}",
    "greater_than_equal": "must be at least {ge:.12g}",
    "less_than": "must be less than {lt:.12g}",
    "less_than_equal": "must be at most {le:.12g}",
    "multiple_of": "must be a multiple of {multiple_of:.12g}",
    "literal_error": "must be {expected}",
    "union_tag_not_found": "{discriminator} is missing",
    "union_tag_invalid": "{discriminator} must be one of {expected_tags}",
    "too_short": "must have {min_length} or more items, not {actual_length}",
    "too_long": "must have {max_length} or fewer items, not {actual_length}",
    "string_too_short": "must have {min_length} or more characters",
    "string_too_long": "must have {max_length} or fewer characters",
}


class Section(BaseModel):
    """A table of settings, frozen: unknown keys are refused and types are strict (`true` or "5" is no number)."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


SomeSection = TypeVar("SomeSection", bound=BaseModel)
Item = TypeVar("Item")

# TOML has no paths and no tuples, so these accept strings and lists in spite of strict types.
WrittenPath = Annotated[Path, Strict(False)]
Pair = Annotated[tuple[Item, Item], Strict(False)]


class Fault(NamedTuple):
    """A validation error at one key."""

    location: tuple[str | int, ...]  # keys and indices from the root; empty: the whole file
    reason: str
    type: str  # pydantic's name for this kind of error
    context: dict[str, Any]  # pydantic's parameters of the error


def faults_of(error: ValidationError) -> list[Fault]:
    """All errors that pydantic found, with readable reasons."""
    return [
        Fault(item["loc"], _reason(item["type"], item["msg"], item.get("ctx", {})), item["type"], item.get("ctx", {}))
        for item in error.errors()
    ]


def _reason(kind: str, message: str, context: dict[str, Any]) -> str:
    known = _REASONS.get(kind)
    return message.removeprefix("Value error, ") if known is None else known.format_map(context)


def dotted(location: tuple[str | int, ...]) -> str:
    """A location as a dotted key, e.g. `splits.test.frames`; empty for the whole file."""
    # pydantic adds "[key]" where a mapping's key, not its value, is wrong.
    return ".".join(str(part) for part in location if part != "[key]")


def read_text(path: Path, raising: type[Exception]) -> str:
    """The file's text. Raises `raising`, naming the path and the reason."""
    try:
        return path.read_text(encoding="utf-8-sig")  # some editors write a byte order mark
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise raising(f"{path}: cannot be read: {reason}") from error


def parse_toml(text: str, place: str | Path, raising: type[Exception]) -> dict[str, Any]:
    """TOML text as a tree. Raises `raising`, naming `place`."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise raising(f"{place}: not valid TOML: {error}") from error


def read_toml(path: Path, raising: type[Exception]) -> dict[str, Any]:
    """The file as a tree. Raises `raising`."""
    return parse_toml(read_text(path, raising), path, raising)


def parse_settings(
    text: str,
    place: str | Path,
    model: type[SomeSection],
    raising: type[Exception],
    name_key: Callable[[tuple[str | int, ...]], str] = dotted,
) -> SomeSection:
    """TOML text from `place` as `model`. Raises `raising` with one line per error, each naming place and key."""
    tree = parse_toml(text, place, raising)
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        told = ((str(place), name_key(fault.location), fault.reason) for fault in faults_of(error))
        raise raising("\n".join(": ".join(filter(None, words)) for words in told)) from error


def load_settings(
    path: Path,
    model: type[SomeSection],
    raising: type[Exception],
    name_key: Callable[[tuple[str | int, ...]], str] = dotted,
) -> SomeSection:
    """A TOML file as `model`. Raises `raising` like `parse_settings`, and if the file cannot be read."""
    return parse_settings(read_text(path, raising), path, model, raising, name_key)


def toml_value(value: object) -> str:
    """A string, number, boolean or list of these as one line of TOML, whose syntax for them is JSON's."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
