"""Generates docs/configuration.md from the configuration tree: every key with its values, default and description.

python -m edge.config_reference > docs/configuration.md
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from edge.config import Config

HEAD = """# Configuration

The configuration is one TOML file; `deploy/examples/` has examples. This page is generated from the code by
`python -m edge.config_reference > docs/configuration.md`; a test keeps it up to date.

    uavpose-edge check --config flight.toml

reports every invalid key with file and line. If all keys are valid, it reports the first fault of each of the
certificates, the model and the camera that they name. Unknown keys are rejected. Paths are relative to the file's
folder. `systemctl reload` reads the file again: [install.md](install.md) says what changes in flight.
"""
SHIPPED = "the shipped model"

Schema = Mapping[str, Any]


def reference() -> str:
    """The whole page, Markdown."""
    tree = Config.model_json_schema()
    parts = [HEAD]
    for name, field in tree["properties"].items():
        for title, section in _sections(name, field, tree["$defs"]):
            parts.append("\n".join([f"## {title}", "", *_told(section), *_table(section, tree["$defs"]), ""]))
    return "\n".join(parts)


def _sections(name: str, field: Schema, definitions: Schema) -> Iterator[tuple[str, Schema]]:
    """Title and schema of a table and of those inside it, one for each type it may have."""
    for section in _alternatives(field, definitions):
        kind = section["properties"].get("type", {}).get("const")
        yield f"`[{name}]`" + (f', `type = "{kind}"`' if kind else ""), section
    inner: dict[str, Schema] = {}
    for section in _alternatives(field, definitions):
        inner |= {key: value for key, value in section["properties"].items() if _alternatives(value, definitions)}
    for key, value in inner.items():
        yield from _sections(f"{name}.{key}", value, definitions)


def _alternatives(field: Schema, definitions: Schema) -> list[Schema]:
    """The tables that a field may be; empty if it is a value."""
    options = field.get("oneOf") or field.get("anyOf") or [field]
    return [definitions[option["$ref"].rpartition("/")[2]] for option in options if "$ref" in option]


def _told(section: Schema) -> list[str]:
    return [section["description"], ""] if "description" in section else []


def _table(section: Schema, definitions: Schema) -> list[str]:
    lines = ["| key | value | default | description |", "|---|---|---|---|"]
    for key, field in section["properties"].items():
        if key == "type":
            continue
        needed = key in section.get("required", [])
        default = "required" if needed else _default(field)
        takes = "a table" if _alternatives(field, definitions) else _takes(field)
        lines.append(f"| `{key}` | {takes} | {default} | {field.get('description', '')} |")
    return lines


def _default(field: Schema) -> str:
    value = field.get("default")
    if value is None or value == []:
        return "–"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str) and value.endswith(".onnx"):
        return SHIPPED
    return f'`"{value}"`' if isinstance(value, str) else f"`{value}`".replace("'", '"')


def _takes(field: Schema) -> str:
    options = [option for option in field.get("anyOf", [field]) if option.get("type") != "null"]
    return " or ".join(_kind(option) for option in options)


def _kind(value: Schema) -> str:
    if "enum" in value:
        return ", ".join(f'`"{word}"`' for word in value["enum"])
    if value["type"] == "array":
        items = value.get("items", (value.get("prefixItems") or [{}])[0])
        count = value.get("maxItems")
        return f"list ({f'{count} × ' if count and count == value.get('minItems') else ''}{_kind(items)})"
    if value["type"] in ("number", "integer"):
        return ("integer" if value["type"] == "integer" else "number") + _bounds(value)
    return {"boolean": "true, false", "string": "path" if value.get("format") == "path" else "string"}[value["type"]]


def _bounds(value: Schema) -> str:
    low, above, high = value.get("minimum"), value.get("exclusiveMinimum"), value.get("maximum")
    bounds = (("from", low), ("above", above), ("to", high))
    told = " ".join(f"{word} {number:.15g}" for word, number in bounds if number is not None)
    return f", {told}" if told else ""


if __name__ == "__main__":
    print(reference(), end="")
