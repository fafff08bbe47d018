"""CDR as used by ROS 2 (XCDR1, little-endian): primitive types, and the reasons for refusing a payload."""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_ENCAPSULATION = b"\x00\x01\x00\x00"
_NS = 1_000_000_000
_U32, _STAMP, _HEADER = struct.Struct("<I"), struct.Struct("<iI"), struct.Struct("<iII")
_POSE = struct.Struct("<43d")  # position 3, quaternion 4, covariance 36
_QUATERNION_TOLERANCE = 1e-3
_COVARIANCE_TOLERANCE = 1e-6
_HUGE = 1e150  # variances above it overflow when multiplied


class Refusal(Enum):
    """Why a received sample was refused."""

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
    FRAME = "frame is not the camera's"
    POSITION = "position, or its standard deviation, is beyond what any camera measures"
    VARIANCE = "a variance of the position is not positive: it is not known"
    DIRECTION = "direction is not of unit length"
    PUBLISHER = "another publisher of this target was heard within the last second"


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

    def f64(self, values: ArrayLike, *shape: int) -> None:
        """Float64 array of that shape (none: one number), row-major, without a length. Raises ValueError for another
        shape."""
        array = np.asarray(values, dtype="<f8")
        if array.shape != shape:
            raise ValueError(f"an array of shape {array.shape} where {shape} belongs")
        self._align(8)
        self._out += array.tobytes()

    def f64_sequence(self, values: ArrayLike) -> None:
        flat = np.asarray(values, dtype="<f8").ravel()
        self.u32(flat.size)
        if flat.size:
            self.f64(flat, flat.size)

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
    """Parses CDR fields from untrusted bytes. Methods raise PayloadError and nothing else."""

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

    def pose(self) -> tuple[Array, Array, Array]:
        """Position [3], unit quaternion [4] and covariance [6, 6] of a geometry_msgs/PoseWithCovariance.

        Called at frame rate, so it is validated in plain floats: for 43 numbers numpy's call overhead is larger.
        """
        start = self._take(_POSE.size, 8)
        numbers = _POSE.unpack_from(self._data, start)
        # Any inf or nan makes the sum non-finite; so may an overflow of finite numbers, hence the second test.
        if not math.isfinite(sum(numbers)) and not all(map(math.isfinite, numbers)):
            raise PayloadError(Refusal.NOT_FINITE)
        if not _is_unit(*numbers[3:7]):
            raise PayloadError(Refusal.QUATERNION)
        values = np.frombuffer(self._data, "<f8", 43, start)
        matrix = values[7:].reshape(6, 6)
        if not _is_plainly_covariance(numbers[7:]) and not is_covariance(matrix):
            raise PayloadError(Refusal.COVARIANCE)
        return values[:3], values[3:7], matrix

    def length(self, element_size_min: int) -> int:
        """A sequence's length, refused if the remaining bytes cannot hold that many elements."""
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
        return self._text(self.u32())

    def _text(self, size: int) -> str:
        start, end = self._at, self._at + size
        if end > len(self._data):
            raise PayloadError(Refusal.LENGTH)
        self._at = end
        if size == 0 or self._data.find(b"\x00", start, end) != end - 1:
            raise PayloadError(Refusal.STRING)
        try:
            return str(self._data[start : end - 1], "utf-8")
        except UnicodeDecodeError:
            raise PayloadError(Refusal.STRING) from None

    def stamp(self) -> int:
        """Nanoseconds since the UNIX epoch."""
        seconds, nanoseconds = _STAMP.unpack_from(self._data, self._take(8, 4))
        if nanoseconds >= _NS:
            raise PayloadError(Refusal.STAMP)
        return seconds * _NS + nanoseconds

    def header(self) -> tuple[int, str]:
        """Stamp in ns since the UNIX epoch, and frame_id."""
        seconds, nanoseconds, size = _HEADER.unpack_from(self._data, self._take(_HEADER.size, 4))
        if nanoseconds >= _NS:
            raise PayloadError(Refusal.STAMP)
        return seconds * _NS + nanoseconds, self._text(size)

    def quaternion(self) -> Array:
        """[4], unit length within 1e-3."""
        q = self.f64(4)
        if not _is_unit(*q.tolist()):
            raise PayloadError(Refusal.QUATERNION)
        return q

    def covariance(self) -> Array:
        """[6, 6], symmetric positive semi-definite."""
        flat = self.f64(36)
        matrix = flat.reshape(6, 6)
        if not _is_plainly_covariance(flat.tolist()) and not is_covariance(matrix):
            raise PayloadError(Refusal.COVARIANCE)
        return matrix

    def done(self) -> None:
        # Writers may pad the whole payload to four bytes.
        if len(self._data) - self._at > 3:
            raise PayloadError(Refusal.TRAILING)


def is_covariance(matrix: Array) -> bool:
    """Whether a finite square [n, n] is symmetric positive semi-definite, up to rounding.

    Tested on the correlation matrix, so that the tolerance does not depend on units (metres, radians).
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


def _is_unit(x: float, y: float, z: float, w: float) -> bool:
    return abs(math.hypot(x, y, z, w) - 1.0) <= _QUATERNION_TOLERANCE


def _is_plainly_covariance(p: Sequence[float]) -> bool:
    """Fast path of `is_covariance`: whether 36 finite numbers, row-major, are an exactly symmetric matrix that is
    positive definite once each variance is raised by the tolerance, as nearly all are. If False, ask `is_covariance`.

    L D L^T decomposition, unrolled: loops over six would take three times as long. Raising the variances raises the
    eigenvalues of the correlation matrix, so the tolerance does not depend on units here either.
    """
    a, ab, ac, ad, ae, af, ba, b, bc, bd, be, bf, ca, cb, c, cd, ce, cf = p[:18]
    da, db, dc, d, de, df, ea, eb, ec, ed, e, ef, fa, fb, fc, fd, fe, f = p[18:]
    lower, upper = (ba, ca, cb, da, db, dc, ea, eb, ec, ed), (ab, ac, bc, ad, bd, cd, ae, be, ce, de)
    if lower != upper or (fa, fb, fc, fd, fe) != (af, bf, cf, df, ef):
        return False
    raised = 1.0 + _COVARIANCE_TOLERANCE
    if not 0.0 < a < _HUGE:
        return False
    a *= raised
    # From here on, names of the lower triangle (ba, ca, ...) hold L D of their column, those of the upper one L.
    ab, ac, ad, ae, af = ba / a, ca / a, da / a, ea / a, fa / a
    b = b * raised - ab * ba
    if not 0.0 < b < _HUGE:
        return False
    cb -= ca * ab
    db -= da * ab
    eb -= ea * ab
    fb -= fa * ab
    bc, bd, be, bf = cb / b, db / b, eb / b, fb / b
    c = c * raised - ac * ca - bc * cb
    if not 0.0 < c < _HUGE:
        return False
    dc -= da * ac + db * bc
    ec -= ea * ac + eb * bc
    fc -= fa * ac + fb * bc
    cd, ce, cf = dc / c, ec / c, fc / c
    d = d * raised - ad * da - bd * db - cd * dc
    if not 0.0 < d < _HUGE:
        return False
    ed -= ea * ad + eb * bd + ec * cd
    fd -= fa * ad + fb * bd + fc * cd
    de, df = ed / d, fd / d
    e = e * raised - ae * ea - be * eb - ce * ec - de * ed
    if not 0.0 < e < _HUGE:
        return False
    fe -= fa * ae + fb * be + fc * ce + fd * de
    return 0.0 < f * raised - af * fa - bf * fb - cf * fc - df * fd - fe * fe / e < _HUGE
