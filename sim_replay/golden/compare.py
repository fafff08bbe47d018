"""Compares two sets of lock-step outputs, field by field. Pure.

Records are reduced to what is compared: covariances to standard deviations, numbers to nine digits. Floats may differ
between machines, since processors round networks' sums differently; on one machine they are the same.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sim_replay.lockstep.player import Outputs

Record = dict[str, Any]
Key = tuple[Any, ...]

DIGITS = 9


@dataclass(frozen=True)
class Tolerance:
    """Allowed deviation: `least`, plus `share` of the expected number's size, or of the norm of the whole list."""

    least: float | tuple[float, ...]  # for all the numbers of a list, or for each
    share: float = 0.0
    of_norm: bool = False

    def allows(self, expected: Sequence[float]) -> list[float]:
        """For each number of a field."""
        least = self.least if isinstance(self.least, tuple) else (self.least,) * len(expected)
        sizes = [math.hypot(*expected)] * len(expected) if self.of_norm else [abs(value) for value in expected]
        return [one + self.share * size for one, size in zip(least, sizes, strict=True)]


POSITION = Tolerance(0.2, 0.01, of_norm=True)  # m
ROTATION_DEG = 2.0
DEVIATION_M, DEVIATION_MPS, DEVIATION_RAD = Tolerance(0.02, 0.1), Tolerance(0.1, 0.1), Tolerance(0.005, 0.1)
DEVIATIONS = Tolerance((0.02, 0.02, 0.02, 0.005, 0.005, 0.005), 0.1)  # of position, m, and of rotation, rad
# By record and field; others are OTHER if they are floats, and otherwise exact.
TOLERANCES = {
    ("pose", "t_cam_target_m"): POSITION,
    ("pose", "std"): DEVIATIONS,
    ("TARGET_RELATIVE", "x"): Tolerance(2.0),
    ("TARGET_RELATIVE", "y"): Tolerance(2.0),
    ("TARGET_RELATIVE", "z"): Tolerance(0.2, 0.01),
    ("TARGET_RELATIVE", "pos_std"): DEVIATION_M,
    ("TARGET_RELATIVE", "yaw_std"): DEVIATION_RAD,
    ("CAMERA_TRACKING_GEO_STATUS", "lat"): Tolerance(300),  # 1e-7 degrees: 3 m
    ("CAMERA_TRACKING_GEO_STATUS", "lon"): Tolerance(300),
    ("CAMERA_TRACKING_GEO_STATUS", "alt"): Tolerance(2.0),
    ("CAMERA_TRACKING_GEO_STATUS", "dist"): Tolerance(0.2, 0.01),
    ("CAMERA_TRACKING_GEO_STATUS", "h_acc"): DEVIATION_M,
    ("CAMERA_TRACKING_GEO_STATUS", "v_acc"): DEVIATION_M,
    ("CAMERA_TRACKING_GEO_STATUS", "vel_n"): Tolerance(1.0, 0.05),
    ("CAMERA_TRACKING_GEO_STATUS", "vel_e"): Tolerance(1.0, 0.05),
    ("CAMERA_TRACKING_GEO_STATUS", "vel_d"): Tolerance(1.0, 0.05),
    ("CAMERA_TRACKING_GEO_STATUS", "vel_acc"): DEVIATION_MPS,
    ("CAMERA_TRACKING_GEO_STATUS", "hdg"): Tolerance(math.radians(3.0)),
    ("CAMERA_TRACKING_GEO_STATUS", "hdg_acc"): DEVIATION_RAD,
}
OTHER = Tolerance(0.005, 0.01)
QUATERNION_LENGTH_OFF = 1e-3
QUATERNIONS = frozenset({"q_cam_target_wxyz", "q_target", "q_sensor"})
# Fields of a pose that are kept unchanged.
POSE_FIELDS = ("t_ns", "frame", "target", "rotation_known", "t_cam_target_m", "q_cam_target_wxyz")
# Fields that identify a record.
POSE_NAMES = ("kind", "t_ns", "frame", "target")
DIRECTION_NAMES = ("kind", "t_ns", "target")
MESSAGE_NAMES = ("kind", "t_ns", "system", "component")
TARGET_NAMES = (*MESSAGE_NAMES, "id")  # one message per target


@dataclass(frozen=True)
class Difference:
    """One deviation from the expected records, in words."""

    where: str
    what: str

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


def reduced(outputs: Outputs) -> list[Record]:
    """The records in a golden file: poses first, then directions, then MAVLink messages, each in order of arrival."""
    records = []
    for pose in outputs.poses:
        std = [math.sqrt(max(pose["covariance"][k][k], 0.0)) for k in range(6)]
        kept = {name: pose[name] for name in POSE_FIELDS}
        records.append({"kind": "pose", **kept, "std": std})
    for seen in outputs.recording.directions:
        t_ns = outputs.recording.capture_ns(seen) - outputs.recording.start_at_ns
        records.append({"kind": "direction", "t_ns": t_ns, "target": seen["target"], "ray_cam": seen["ray_cam"]})
    for message in outputs.mavlink:
        fields = {name: value for name, value in message.items() if name != "message"}
        records.append({"kind": message["message"], **fields})
    return [{name: _rounded(value) for name, value in record.items()} for record in records]


def differences(expected: Iterable[Record], actual: Iterable[Record]) -> list[Difference]:
    """All that is missing, new or outside its tolerance, ordered by time."""
    old, new = _keyed(expected), _keyed(actual)
    found = []
    for key in sorted(old.keys() | new.keys(), key=lambda key: (key[1], str(key))):
        where = _where(old.get(key) or new[key])
        if key not in new:
            found.append(Difference(where, "expected, but missing"))
        elif key not in old:
            found.append(Difference(where, "present, but not expected"))
        else:
            found += [Difference(where, text) for text in _off(old[key], new[key])]
    return found


def _keyed(records: Iterable[Record]) -> dict[Key, Record]:
    seen: Counter[Key] = Counter()
    keyed = {}
    for record in records:
        name = tuple(record[part] for part in _names(record))
        seen[name] += 1
        keyed[*name, seen[name]] = record
    return keyed


def _names(record: Record) -> tuple[str, ...]:
    if record["kind"] == "pose":
        return POSE_NAMES
    if record["kind"] == "direction":
        return DIRECTION_NAMES
    return TARGET_NAMES if record["kind"] == "TARGET_RELATIVE" else MESSAGE_NAMES


def _where(record: Record) -> str:
    told = f"{record['t_ns'] / 1e9:+.3f} s {record['kind']}"
    if record["kind"] == "pose":
        return f"{told} frame {record['frame']} {record['target']}"
    if record["kind"] == "direction":
        return f"{told} {record['target']}"
    return f"{told} from {record['system']}/{record['component']}"


def _off(expected: Record, actual: Record) -> list[str]:
    told = []
    for field in sorted((expected.keys() | actual.keys()) - set(_names(expected))):
        if field not in expected or field not in actual:
            told.append(f"{field} {'is new' if field in actual else 'is missing'}")
            continue
        text = _field_off(expected["kind"], field, expected[field], actual[field])
        if text is not None:
            told.append(text)
    return told


def _field_off(kind: str, field: str, expected: Any, actual: Any) -> str | None:
    if expected == actual:
        return None
    said = f"{field} is {_short(actual)}, expected {_short(expected)}"
    if isinstance(expected, str) and isinstance(actual, str):
        # Numbers in a text are rounded from fields that are compared themselves.
        same = re.sub(r"[-\d.]+", "#", expected) == re.sub(r"[-\d.]+", "#", actual)
        return None if same else said
    old, new = _numbers(expected), _numbers(actual)
    if old is None or new is None or len(old) != len(new):
        return said
    if any(str(a) != str(b) for a, b in zip(old, new, strict=True) if not (math.isfinite(a) and math.isfinite(b))):
        return said
    if field in QUATERNIONS:
        if abs(math.hypot(*old) - math.hypot(*new)) > QUATERNION_LENGTH_OFF:
            return f"{said}: of another length"
        angle_deg = math.degrees(2.0 * math.acos(min(1.0, abs(sum(a * b for a, b in zip(old, new, strict=True))))))
        return None if angle_deg <= ROTATION_DEG else f"{said}: {angle_deg:.2f}° apart, {ROTATION_DEG:.0f}° allowed"
    tolerance = TOLERANCES.get((kind, field))
    if tolerance is None:
        if all(isinstance(value, int) for value in (*old, *new)):
            return said
        tolerance = OTHER
    off = [
        (abs(a - b), allowed) for a, b, allowed in zip(old, new, tolerance.allows(old), strict=True) if math.isfinite(a)
    ]
    error, allowed = max(off, key=lambda one: one[0] - one[1], default=(0.0, 0.0))
    return None if error <= allowed else f"{said}: {error:.4g} off, {allowed:.4g} allowed"


def _numbers(value: Any) -> list[float] | None:
    values = value if isinstance(value, list) else [value]
    return values if values and all(isinstance(one, int | float) for one in values) else None


def _rounded(value: Any) -> Any:
    if isinstance(value, list):
        return [_rounded(one) for one in value]
    return float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def _short(value: Any) -> str:
    if isinstance(value, list):
        return "[" + " ".join(_short(one) for one in value) + "]"
    return f"{value:.5g}" if isinstance(value, float) else str(value)


def counts(records: Iterable[Mapping[str, Any]]) -> dict[str, int]:
    """Number of records of each kind."""
    return dict(Counter(record["kind"] for record in records))
