"""MAVLink 2: pymavlink's `common` dialect plus the messages of dialect/uavpose.xml, and packing with validation.

Of pymavlink only `MAVLink` (pack and parse) is used; sockets, addresses and signatures are handled by the link.
"""

from __future__ import annotations

import math
import os
import struct
import xml.etree.ElementTree as ET
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

# Any value, even "0", would switch CRC checks off.
os.environ.pop("MAV_IGNORE_CRC", None)

from pymavlink.dialects.v20 import common as dialect

# pymavlink may have been imported, and the variable read, before this module.
dialect.MAVLINK_IGNORE_CRC = 0

DIALECT_XML = Path(__file__).parent / "dialect" / "uavpose.xml"

MAVLink = dialect.MAVLink
MAVLinkMessage = dialect.MAVLink_message
MAVError = dialect.MAVError

TARGET_OBS_FRAME_OTHER = 3
CANDIDATES_MAX = 256  # false frame starts in the bytes of one `feed`: with more, the rest is discarded as a flood
# Messages in which MAVLink frames of another time or vehicle may travel: passed through, or from a log.
CARRIERS = frozenset((
    dialect.MAVLINK_MSG_ID_FILE_TRANSFER_PROTOCOL,
    dialect.MAVLINK_MSG_ID_LOG_DATA,
    dialect.MAVLINK_MSG_ID_SERIAL_CONTROL,
    dialect.MAVLINK_MSG_ID_ENCAPSULATED_DATA,
    dialect.MAVLINK_MSG_ID_V2_EXTENSION,
    dialect.MAVLINK_MSG_ID_LOGGING_DATA,
    dialect.MAVLINK_MSG_ID_LOGGING_DATA_ACKED,
    dialect.MAVLINK_MSG_ID_TUNNEL,
))  # fmt: skip
_Q_UNKNOWN = (0.0, 0.0, 0.0, 0.0)
_TYPES = {
    "uint64_t": ("Q", 8), "int64_t": ("q", 8), "double": ("d", 8),
    "uint32_t": ("I", 4), "int32_t": ("i", 4), "float": ("f", 4),
    "uint16_t": ("H", 2), "int16_t": ("h", 2),
    "uint8_t": ("B", 1), "int8_t": ("b", 1),
}  # fmt: skip


def _message_class(definition: ET.Element) -> type[Any]:
    """A pymavlink message class from a `<message>` without extensions or text fields.

    Fields are ordered on the wire by element size, largest first, stable; CRC_EXTRA is the checksum of the name and
    the fields in that order (MAVLink guide, "Serialization").
    """
    name = definition.attrib["name"]
    fields = []
    for element in definition.findall("field"):
        base, _, count = element.attrib["type"].rstrip("]").partition("[")
        fields.append((element.attrib["name"], base, int(count or 0)))
    ordered = sorted(fields, key=lambda field: -_TYPES[field[1]][1])
    checksum = dialect.x25crc(f"{name} ".encode())
    for field, base, length in ordered:
        checksum.accumulate(f"{base} {field} ".encode())
        if length:
            checksum.accumulate(bytes([length]))
    names = [field for field, _, _ in fields]
    wire_names = [field for field, _, _ in ordered]

    def __init__(self: Any, *values: Any) -> None:
        MAVLinkMessage.__init__(self, self.id, self.msgname)
        self._fieldnames = self.fieldnames
        for field, value in zip(names, values, strict=True):
            setattr(self, field, value)

    def pack(self: Any, mav: Any, force_mavlink1: bool = False) -> bytes:
        flat: list[Any] = []
        for field, _, count in ordered:
            value = getattr(self, field)
            flat.extend(value if count else [value])
        return self._pack(mav, self.crc_extra, self.unpacker.pack(*flat), force_mavlink1=force_mavlink1)

    return type(
        f"MAVLink_{name.lower()}_message",
        (MAVLinkMessage,),
        {
            "id": int(definition.attrib["id"]),
            "msgname": name,
            "fieldnames": names,
            "ordered_fieldnames": wire_names,
            "fieldtypes": [base for _, base, _ in fields],
            "orders": [wire_names.index(field) for field in names],
            "lengths": [count or 1 for _, _, count in ordered],
            "array_lengths": [count for _, _, count in ordered],
            "crc_extra": (checksum.crc & 0xFF) ^ (checksum.crc >> 8),
            "unpacker": struct.Struct("<" + "".join(f"{count or ''}{_TYPES[base][0]}" for _, base, count in ordered)),
            "__init__": __init__,
            "pack": pack,
        },
    )


def _register() -> dict[str, type[Any]]:
    messages = [_message_class(element) for element in ET.parse(DIALECT_XML).getroot().iter("message")]
    for message in messages:
        dialect.mavlink_map[message.id] = message
    return {message.msgname: message for message in messages}


MAVLink_target_relative_message = _register()["TARGET_RELATIVE"]


def pack(mav: Any, message: Any, *, unknown: Collection[str] = ()) -> bytes:
    """Pack a message as MAVLink 2 with `mav`'s ids and signing, and advance its sequence number.

    Raises ValueError, naming message and field, for a number that is not finite, unless the field is in `unknown`
    (fields whose definition uses NaN for "unknown"), and for a value that does not fit its field.
    """
    if (field := not_finite(message, but=unknown)) is not None:
        raise ValueError(f"{message.get_type()}.{field} is not finite: {getattr(message, field)}")
    try:
        packed = message.pack(mav)
    except (struct.error, OverflowError, IndexError, TypeError) as error:
        raise ValueError(f"{message.get_type()} cannot be packed: {error}") from error
    mav.seq = (mav.seq + 1) % 256
    return packed


def not_finite(message: Any, *, but: Collection[str]) -> str | None:
    """The first field, of others than `but`, with a number that is not finite; None: there is none."""
    for field in message.get_fieldnames():
        value = getattr(message, field)
        numbers = value if isinstance(value, (list, tuple)) else (value,)
        if field not in but and any(isinstance(x, float) and not math.isfinite(x) for x in numbers):
            return str(field)
    return None


def target_relative(
    *,
    utc_us: int,
    target_id: int,
    t_cam_target_m: Sequence[float],
    position_std_m: Sequence[float],
    attitude_std_rad: float,
    q_cam_target_wxyz: Sequence[float] | None,
    q_ned_cam_wxyz: Sequence[float] | None,
) -> Any:
    """TARGET_RELATIVE (511) with the target's full pose in `cam` (frame OTHER), for `pack`.

    Vectors are [3], quaternions [4] of unit length; `q_cam_target_wxyz` None: the target's attitude is unknown,
    `q_ned_cam_wxyz` None: the own attitude is; both are sent as all zeros. `utc_us` is the exposure time. Raises
    ValueError for an invalid vector or rotation; `pack` does for a value that is not finite or does not fit its field.
    """
    q_target = _Q_UNKNOWN if q_cam_target_wxyz is None else _unit_quaternion("q_target", q_cam_target_wxyz)
    q_sensor = _Q_UNKNOWN if q_ned_cam_wxyz is None else _unit_quaternion("q_sensor", q_ned_cam_wxyz)
    return MAVLink_target_relative_message(
        utc_us,
        target_id,
        TARGET_OBS_FRAME_OTHER,
        *_floats("x, y, z", t_cam_target_m, 3),
        _floats("pos_std", position_std_m, 3),
        float(attitude_std_rad),
        q_target,
        q_sensor,
        dialect.LANDING_TARGET_TYPE_VISION_OTHER,
    )


def _floats(field: str, values: Sequence[float], count: int) -> tuple[float, ...]:
    if len(values) != count:
        raise ValueError(f"TARGET_RELATIVE.{field} takes {count} numbers, not {len(values)}")
    return tuple(float(value) for value in values)


def _unit_quaternion(field: str, q_wxyz: Sequence[float]) -> tuple[float, ...]:
    q = _floats(field, q_wxyz, 4)
    if not abs(math.hypot(*q) - 1.0) <= 1e-3:
        raise ValueError(f"TARGET_RELATIVE.{field} is not of unit length: {q}")
    return q


class FrameReader:
    """Extracts MAVLink messages from bytes, skipping garbage between them.

    After a false frame start it skips one byte, not the length claimed there, so a truncated header hides nothing that
    follows, nor delays it, unless it is that of a message of CARRIERS: what those carry is not taken for messages. Use
    `datagram=True` for datagram transports, where no frame continues in the next datagram; for byte streams use one
    reader per connection.
    """

    def __init__(self, datagram: bool) -> None:
        self.bad_runs = 0  # contiguous runs of bytes that belong to no frame
        self.unknown_ids = 0  # frames with an id not in our dialects: neither checksum nor signature can be verified
        self.datagram = datagram
        self._buffer = bytearray()
        self._decoder = dialect.MAVLink(None)
        self._in_bad_run = False
        self._framed = 0  # end in the buffer of the last frame, of whatever id

    def feed(self, data: bytes) -> list[Any]:
        """All messages with a valid checksum that are complete with these bytes, as pymavlink's classes."""
        self._buffer += data
        self._in_bad_run = self._in_bad_run and not self.datagram
        messages = []
        at, spoilt = 0, 0
        begun: int | None = None  # the first start whose frame may still be completed
        while spoilt <= CANDIDATES_MAX and (at := self._next_magic(at)) < len(self._buffer):
            end = self._frame_end(at)
            if end is not None and end <= len(self._buffer):
                message = self._decoded(at, end)
                known = message is not None and message.get_msgId() >= 0
                if known or (message is not None and begun is None and at >= self._framed):
                    self._skip(at)
                    self._in_bad_run, self._framed = False, max(self._framed, end)
                    self.unknown_ids += not known
                if known:
                    messages.append(message)
                    at, begun = end, None
                    continue
                spoilt += 1
            elif not self.datagram:
                begun = at if begun is None else begun
                if self._may_carry_frames(at):
                    break
                # What follows is read all the same: a false start must not hold it back.
            at += 1
        keep_from = len(self._buffer) if begun is None or spoilt > CANDIDATES_MAX else begun
        self._skip(keep_from)
        self._framed = max(self._framed - keep_from, 0)
        del self._buffer[:keep_from]
        return messages

    def _next_magic(self, start: int) -> int:
        found = [i for i in (self._buffer.find(magic, start) for magic in (b"\xfd", b"\xfe")) if i >= 0]
        return min(found, default=len(self._buffer))

    def _frame_end(self, at: int) -> int | None:
        """End of the frame that starts here; None if its header is incomplete, 0 if it is no frame."""
        header = self._buffer[at : at + 3]
        if header[0] == 0xFE:
            return at + 8 + header[1] if len(header) > 1 else None
        if len(header) < 3:
            return None
        if header[2] & ~dialect.MAVLINK_IFLAG_SIGNED:
            return 0
        return at + 12 + header[1] + (13 if header[2] else 0)

    def _may_carry_frames(self, at: int) -> bool:
        """Whether this is the start of a message whose payload may be MAVLink of another time or vehicle."""
        header = self._buffer[at : at + 10]
        return len(header) == 10 and header[0] == 0xFD and int.from_bytes(header[7:], "little") in CARRIERS

    def _decoded(self, at: int, end: int) -> Any | None:
        """The message of this frame, unchecked and with a negative id if its id is not in our dialects."""
        try:
            return self._decoder.decode(self._buffer[at:end]) if end > at else None
        except MAVError:
            return None

    def _skip(self, end: int) -> None:
        if end > self._framed and not self._in_bad_run:
            self._in_bad_run = True
            self.bad_runs += 1
