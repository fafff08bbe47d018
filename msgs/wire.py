"""CDR as ROS 2 writes it (XCDR1, little-endian): the primitives, and the reasons to refuse a payload."""

from __future__ import annotations

import struct
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_ENCAPSULATION = b"\x00\x01\x00\x00"
_NS = 1_000_000_000
_U32, _STAMP = struct.Struct("<I"), struct.Struct("<iI")
_QUATERNION_TOLERANCE = 1e-3
_COVARIANCE_TOLERANCE = 1e-6


class Refusal(Enum):
    """Why a sample from the wire was not taken."""

    ENCAPSULATION = "not little-endian CDR"
    TRUNCATED = "ends before its last field"
    TRAILING = "goes on after its last field"
    STRING = "a string is not terminated UTF-8"
    LENGTH = "a sequence claims more elements than the payload can hold"
    STAMP = "stamp is not a time"
    BOOL = "a boolean is neither 0 nor 1"
    NOT_FINITE = "a number is not finite"
    QUATERNION = "quaternion is not of unit length"
    COVARIANCE = "covariance is not symmetric positive semi-definite"
    ATTACHMENT = "attachment is missing or malformed"
    SEQUENCE = "sequence number did not rise"
    STALE = "stamp is too old, or older than one already taken"
    FUTURE = "stamp lies in the future"
    TOPIC = "key is no topic of the table"


class PayloadError(ValueError):
    """A payload that must not be used; `reason` says why."""

    def __init__(self, reason: Refusal) -> None:
        super().__init__(reason.value)
        self.reason = reason


class Writer:
    """Appends CDR fields. Alignment counts from the end of the encapsulation header."""

    def __init__(self) -> None:
        self._out = bytearray(_ENCAPSULATION)

    def _align(self, size: int) -> None:
        self._out += bytes(-(len(self._out) - 4) % size)

    def u8(self, value: int) -> None:
        self._out += value.to_bytes(1, "little")

    def u32(self, *values: int) -> None:
        self._align(4)
        self._out += struct.pack(f"<{len(values)}I", *values)

    def f64(self, values: ArrayLike) -> None:
        """Float64 array of any shape, row-major, without a length."""
        self._align(8)
        self._out += np.ascontiguousarray(values, dtype="<f8").tobytes()

    def f64_sequence(self, values: ArrayLike) -> None:
        flat = np.ascontiguousarray(values, dtype="<f8").ravel()
        self.u32(flat.size)
        if flat.size:
            self.f64(flat)

    def bytes_sequence(self, data: bytes) -> None:
        self.u32(len(data))
        self._out += data

    def string(self, text: str) -> None:
        encoded = text.encode()
        self.u32(len(encoded) + 1)
        self._out += encoded + b"\x00"

    def stamp(self, stamp_ns: int) -> None:
        self._align(4)
        self._out += _STAMP.pack(*divmod(stamp_ns, _NS))

    def header(self, stamp_ns: int, frame_id: str) -> None:
        self.stamp(stamp_ns)
        self.string(frame_id)

    def done(self) -> bytes:
        return bytes(self._out)


class Reader:
    """Takes CDR fields off untrusted bytes. Every method raises PayloadError and nothing else."""

    def __init__(self, payload: bytes) -> None:
        if payload[:2] != _ENCAPSULATION[:2] or len(payload) < 4:
            raise PayloadError(Refusal.ENCAPSULATION)
        self._data = payload
        self._at = 4

    def _take(self, size: int, align: int) -> int:
        start = self._at + (-(self._at - 4) % align)
        if start + size > len(self._data):
            raise PayloadError(Refusal.TRUNCATED)
        self._at = start + size
        return start

    def u8(self) -> int:
        return self._data[self._take(1, 1)]

    def boolean(self) -> bool:
        value = self.u8()
        if value > 1:
            raise PayloadError(Refusal.BOOL)
        return value == 1

    def u32(self) -> int:
        return _U32.unpack_from(self._data, self._take(4, 4))[0]

    def f64(self, count: int) -> Array:
        """`count` finite numbers, shape [count]."""
        start = self._take(8 * count, 8)
        values = np.frombuffer(self._data, dtype="<f8", count=count, offset=start)
        if not np.isfinite(values).all():
            raise PayloadError(Refusal.NOT_FINITE)
        return values

    def length(self, element_size_min: int) -> int:
        """A sequence's length, refused if the bytes left cannot hold that many elements."""
        count = self.u32()
        if count * element_size_min > len(self._data) - self._at:
            raise PayloadError(Refusal.LENGTH)
        return count

    def f64_sequence(self) -> Array:
        count = self.length(8)
        return self.f64(count) if count else np.empty(0)

    def bytes_sequence(self) -> bytes:
        count = self.length(1)
        start = self._take(count, 1)
        return self._data[start : start + count]

    def string(self) -> str:
        raw = self.bytes_sequence()
        if not raw.endswith(b"\x00") or b"\x00" in raw[:-1]:
            raise PayloadError(Refusal.STRING)
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError:
            raise PayloadError(Refusal.STRING) from None

    def stamp(self) -> int:
        """Nanoseconds since the UNIX epoch."""
        seconds, nanoseconds = _STAMP.unpack_from(self._data, self._take(8, 4))
        if nanoseconds >= _NS:
            raise PayloadError(Refusal.STAMP)
        return seconds * _NS + nanoseconds

    def header(self) -> tuple[int, str]:
        return self.stamp(), self.string()

    def quaternion(self) -> Array:
        """[4], unit length within 1e-3."""
        q = self.f64(4)
        if not abs(np.hypot(np.hypot(q[0], q[1]), np.hypot(q[2], q[3])) - 1.0) <= _QUATERNION_TOLERANCE:
            raise PayloadError(Refusal.QUATERNION)
        return q

    def covariance(self) -> Array:
        """[6, 6], symmetric positive semi-definite."""
        matrix = self.f64(36).reshape(6, 6)
        if not is_covariance(matrix):
            raise PayloadError(Refusal.COVARIANCE)
        return matrix

    def done(self) -> None:
        # Writers may pad the whole payload to four bytes.
        if len(self._data) - self._at > 3:
            raise PayloadError(Refusal.TRAILING)


def is_covariance(matrix: Array) -> bool:
    """Whether a finite square [n, n] is symmetric positive semi-definite, up to rounding.

    Judged on the correlation matrix, so that metres and radians weigh alike.
    """
    variance = np.diagonal(matrix)
    if (variance < 0.0).any():
        return False
    sigma = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    with np.errstate(over="ignore"):
        correlation = matrix / sigma[:, None] / sigma[None, :]
    if (np.abs(correlation) > 1.0 + _COVARIANCE_TOLERANCE).any():
        return False
    if np.abs(correlation - correlation.T).max() > _COVARIANCE_TOLERANCE:
        return False
    return bool(np.linalg.eigvalsh(correlation)[0] >= -_COVARIANCE_TOLERANCE)
