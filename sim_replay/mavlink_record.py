"""A MAVLink message as one JSON object."""

from __future__ import annotations

import math
from typing import Any


def message_record(message: Any, t_ns: int) -> dict[str, Any]:
    """Arrival time, message name, sender, and every field."""
    fields = {field: _plain(getattr(message, field)) for field in message.get_fieldnames()}
    sender = {"system": message.get_srcSystem(), "component": message.get_srcComponent()}
    return {"t_ns": t_ns, "message": message.get_type(), **sender, **fields}


def _plain(value: Any) -> Any:
    """A field as a JSON value: text, numbers, lists; null for NaN and infinities."""
    if isinstance(value, bytes | bytearray):
        return bytes(value).rstrip(b"\0").decode("utf-8", "replace")
    if isinstance(value, list | tuple):
        return [_plain(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
