"""Settings in TOML: read, held against a pydantic model, faults told by file and key to the person who wrote them.

Each package raises an error of its own, so every reader here takes the type to raise: one made from one sentence.
Subscribers need none of this: msgs.client works without pydantic.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar

from pydantic import BaseModel, ConfigDict, Strict, ValidationError

_KNOWN = {
    "extra_forbidden": "unknown key",
    "missing": "is missing",
    **dict.fromkeys(("model_type", "model_attributes_type", "dict_type"), "must hold keys with values"),
    **dict.fromkeys(("tuple_type", "list_type"), "must be a list"),
}


class Section(BaseModel):
    """A table of settings: unknown keys are refused, `true` or "5" is no number, and what was read stays as it is."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


SomeSection = TypeVar("SomeSection", bound=BaseModel)
Item = TypeVar("Item")

# TOML has no paths and no tuples, so a section takes them of strings and of lists.
WrittenPath = Annotated[Path, Strict(False)]
Pair = Annotated[tuple[Item, Item], Strict(False)]


class Fault(NamedTuple):
    """What is wrong at one key."""

    location: tuple[str | int, ...]  # keys and indices from the root; empty: the whole
    reason: str
    type: str  # pydantic's name for this kind of error
    context: dict[str, Any]  # what pydantic adds to it


def faults_of(error: ValidationError) -> list[Fault]:
    """All that pydantic found, with reasons worded for a person."""
    return [
        Fault(
            item["loc"],
            _KNOWN.get(item["type"], item["msg"].removeprefix("Value error, ")),
            item["type"],
            item.get("ctx", {}),
        )
        for item in error.errors()
    ]


def dotted(location: tuple[str | int, ...]) -> str:
    """`splits.test.frames` for a key of a file; empty for the whole of it."""
    # "[key]" is pydantic's way of telling a mapping's key from its value.
    return ".".join(str(part) for part in location if part != "[key]")


def read_text(path: Path, raising: type[Exception]) -> str:
    """The file's text. Raises `raising`, with the path and the reason."""
    try:
        return path.read_text(encoding="utf-8-sig")  # some editors begin a file with a mark
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
    """TOML text, which lies at `place`, as `model`. Raises `raising`: a line a fault, each naming place and key."""
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
    """A TOML file as `model`. Raises `raising`, as `parse_settings` does and where the file cannot be read."""
    return parse_settings(read_text(path, raising), path, model, raising, name_key)


def toml_value(value: object) -> str:
    """A string, number, boolean or list of these as TOML of one line: JSON writes them as TOML does."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
