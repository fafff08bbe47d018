"""Own-ship telemetry of a sequence: `telemetry.csv` beside the frames, and its state at any time."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from msgs.geometry import Array, R_from_q_wxyz, q_wxyz_from_R, slerp

COLUMNS = (
    *("t_ns", "q_ned_body_w", "q_ned_body_x", "q_ned_body_y", "q_ned_body_z", "p_radps", "q_radps", "r_radps"),
    *("north_m", "east_m", "down_m", "v_north_mps", "v_east_mps", "v_down_mps", "lat_deg", "lon_deg", "alt_m"),
)

FLOWN_CSV = "flown_telemetry.csv"  # in output folders: an output folder may be the scene's, which keeps its own file
GAP_NS = 500_000_000  # without rows for longer than this, own attitude is unknown, as in the daemon
GAP_ROWS = 5  # or this many rows, if they are further apart
_LATITUDE, _LONGITUDE = COLUMNS.index("lat_deg") - 1, COLUMNS.index("lon_deg") - 1  # among Telemetry.values


class TelemetryError(ValueError):
    """A telemetry file that cannot be used; the text is a sentence that names file, line and column."""


@dataclass(frozen=True)
class OwnShipState:
    """The state of the camera's vehicle at one time."""

    q_ned_body_wxyz: Array  # [4]
    rates_body_radps: Array  # [3], p q r
    t_ned_body_m: Array  # [3]
    v_ned_body_mps: Array  # [3]
    lat_deg: float
    lon_deg: float  # -180..180
    alt_m: float  # AMSL


@dataclass(frozen=True)
class Telemetry:
    """N rows over time; `t_ns` counts from the exposure of the sequence's first frame and increases."""

    t_ns: np.ndarray  # [N] int64
    values: Array  # [N, 16], COLUMNS[1:]

    @cached_property
    def _gap_ns(self) -> float:
        return max(GAP_NS, GAP_ROWS * float(np.median(np.diff(self.t_ns))))

    def tells_of(self, t_ns: int) -> bool:
        """False in a gap between two rows so long that the own ship's state is unknown."""
        i = int(np.searchsorted(self.t_ns, t_ns, side="left"))
        if i == 0 or i == len(self.t_ns) or self.t_ns[i] == t_ns:
            return True
        return bool(self.t_ns[i] - self.t_ns[i - 1] <= self._gap_ns)

    def at(self, t_ns: int) -> OwnShipState:
        """State at `t_ns`: slerp and linear between neighbours, longitude the short way round.

        Outside them, the first or last row without motion.
        """
        if t_ns <= self.t_ns[0] or t_ns >= self.t_ns[-1]:
            row = self.values[0 if t_ns <= self.t_ns[0] else -1].copy()
            row[4:7] = row[10:13] = 0.0
        else:
            i = int(np.searchsorted(self.t_ns, t_ns, side="right")) - 1
            share = float(t_ns - self.t_ns[i]) / float(self.t_ns[i + 1] - self.t_ns[i])
            following = self.values[i + 1].copy()
            following[_LONGITUDE] -= _whole_turns_deg(following[_LONGITUDE] - self.values[i, _LONGITUDE])
            row = (1.0 - share) * self.values[i] + share * following
            row[_LONGITUDE] -= _whole_turns_deg(row[_LONGITUDE])
            R_a, R_b = R_from_q_wxyz(self.values[i : i + 2, :4])
            row[:4] = q_wxyz_from_R(slerp(R_a, R_b, share))
        lat_deg, lon_deg, alt_m = (float(value) for value in row[13:16])
        return OwnShipState(row[:4], row[4:7], row[7:10], row[10:13], lat_deg, lon_deg, alt_m)


def read_telemetry(path: Path) -> Telemetry:
    """Read `telemetry.csv`. Raises TelemetryError."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:  # spreadsheets write a byte order mark before UTF-8
            reader = csv.reader(file)
            header = tuple(next(reader, ()))
            lines = [(reader.line_num, row) for row in reader if row]
    except (OSError, UnicodeDecodeError) as error:
        raise TelemetryError(f"{path}: cannot be read: {getattr(error, 'strerror', 'not UTF-8 text')}") from error
    except csv.Error as error:
        raise TelemetryError(f"{path}: line {reader.line_num} is not CSV: {error}") from error
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        raise TelemetryError(f"{path}: column {missing[0]} is missing")
    order = [header.index(name) for name in COLUMNS]
    values = np.empty((len(lines), len(COLUMNS) - 1))
    t_ns = np.empty(len(lines), dtype=np.int64)
    for k, (line, row) in enumerate(lines):
        try:
            t_ns[k] = int(row[order[0]])
            values[k] = [float(row[column]) for column in order[1:]]
        except (ValueError, IndexError) as error:
            raise TelemetryError(
                f"{path}: line {line} does not hold {len(COLUMNS)} numbers, t_ns a whole one"
            ) from error
        except OverflowError as error:
            raise TelemetryError(f"{path}: line {line}: t_ns is beyond 64 bits") from error
    if len(lines) < 2 or not (np.diff(t_ns) > 0).all():
        raise TelemetryError(f"{path}: t_ns must rise over at least two rows")
    if not np.isfinite(values).all() or not np.allclose(np.linalg.norm(values[:, :4], axis=1), 1.0, atol=1e-3):
        raise TelemetryError(f"{path}: a value is not finite or a quaternion is not of unit length")
    if np.abs(values[:, _LATITUDE]).max() > 90.0 or np.abs(values[:, _LONGITUDE]).max() > 360.0:
        raise TelemetryError(f"{path}: lat_deg or lon_deg is not in degrees: beyond 90, or 360")
    values[:, _LONGITUDE] -= _whole_turns_deg(values[:, _LONGITUDE])
    return Telemetry(t_ns, values)


def _whole_turns_deg(angle_deg: ArrayLike) -> Array:
    """The multiple of 360 nearest to each angle [...]: 0 from -180 to 180."""
    return 360.0 * np.round(np.asarray(angle_deg, dtype=np.float64) / 360.0)


def write_telemetry(path: Path, telemetry: Telemetry) -> None:
    """Write `telemetry.csv`, with a resolution of 1 µrad, 1 mm and 1e-8 degrees."""
    digits = (8,) * 7 + (3,) * 6 + (8, 8, 3)
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for t_ns, row in zip(telemetry.t_ns, telemetry.values, strict=True):
            writer.writerow([int(t_ns), *(f"{value:.{n}f}" for value, n in zip(row, digits, strict=True))])
