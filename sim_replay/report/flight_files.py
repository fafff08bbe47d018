"""Files of a replay from which it can be scored again: flight.json, and received.jsonl with the peers' records."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from edge.errors import InputError
from msgs.receive import RAY_TOLERANCE
from sim_replay.play import MESSAGES_JSONL, Record, Recording
from sim_replay.result import direction_of, pose_of
from sim_replay.result import latency_ms as latency_ms_of

FLIGHT_JSON, RECEIVED_JSONL = "flight.json", "received.jsonl"
# Files that `demo`, `play` and `score` write into a flight's folder; the daemon's recordings belong to the user.
WRITTEN = (
    *(FLIGHT_JSON, RECEIVED_JSONL, MESSAGES_JSONL, "poses.jsonl", "config.toml", "daemon.log", "gimbal.csv"),
    *("score.json", "frames.jsonl", "report.html", "overlay.mp4", "overlay.png"),
)
_PEER_OF = {"target_relative": "autopilot"} | dict.fromkeys(("pose", "direction", "diagnostics"), "subscriber")


@dataclass(frozen=True, eq=False)
class RecordedFlight:
    """A recorded flight."""

    sequence: Path  # folder of the flown scene
    model: dict[str, Any]  # file, sha256, precision
    recording: Recording
    speed: float = 1.0  # factor on the sequence's own frame rate


def remove_flight(folder: Path) -> None:
    """Remove the files of an earlier replay, so that they are not taken for those of the one that begins now."""
    for name in WRITTEN:
        (folder / name).unlink(missing_ok=True)


def write_flight(out: Path, flight: RecordedFlight) -> None:
    """Write both files into `out`, which must exist."""
    recording = flight.recording
    about = {
        "sequence": str(flight.sequence.resolve()),
        "speed": flight.speed,
        "model": flight.model,
        "start_at_ns": recording.start_at_ns,
        "utc_minus_monotonic_ns": recording.utc_minus_monotonic_ns,
        "mavlink_port": recording.mavlink_port,
        "zenoh_endpoint": recording.zenoh_endpoint,
        "daemon_exit": recording.daemon_exit,
        "daemon_counters": recording.daemon_counters,
    }
    (out / FLIGHT_JSON).write_text(json.dumps(about, indent=2) + "\n", encoding="utf-8")
    records = (*recording.poses, *recording.directions, *recording.targets, *recording.diagnostics)
    lines = [(_PEER_OF[record["event"]], record) for record in records]
    summaries = (("autopilot", recording.mavlink), ("subscriber", recording.zenoh))
    lines += [(peer, {"event": "summary", **summary}) for peer, summary in summaries if summary]
    with (out / RECEIVED_JSONL).open("w", encoding="utf-8") as file:
        for peer, record in lines:
            file.write(json.dumps({"peer": peer, **record}) + "\n")


def read_flight(folder: Path) -> RecordedFlight:
    """Read what `write_flight` wrote into `folder`. Raises InputError, naming file and key or line."""
    path = folder / FLIGHT_JSON
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
        recording = Recording(
            start_at_ns=int(about["start_at_ns"]),
            utc_minus_monotonic_ns=int(about["utc_minus_monotonic_ns"]),
            mavlink_port=int(about["mavlink_port"]),
            zenoh_endpoint=str(about["zenoh_endpoint"]),
            daemon_exit=about["daemon_exit"],
            daemon_counters=dict(about["daemon_counters"]),
        )
        sequence, model, speed = Path(about["sequence"]), dict(about["model"]), float(about["speed"])
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read: {error.strerror}; is {folder} the output folder of a replay?"
        ) from error
    except KeyError as error:
        raise InputError(f"{path}: {error.args[0]!r} is missing") from error
    except (ValueError, TypeError, OverflowError) as error:
        raise InputError(f"{path}: not as expected: {error}") from error
    _read_received(folder / RECEIVED_JSONL, recording)
    return RecordedFlight(sequence, model, recording, speed)


def _read_received(path: Path, recording: Recording) -> None:
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {getattr(error, 'strerror', 'not UTF-8 text')}") from error
    for number, line in enumerate(lines, 1):
        try:
            record = json.loads(line)
            recording.take(record.pop("peer"), record)
            _check(record, recording)
        except KeyError as error:
            raise InputError(f"{path}: line {number} is not a record of a peer: it has no {error.args[0]!r}") from error
        except (ValueError, AttributeError, TypeError, OverflowError, RecursionError) as error:
            raise InputError(f"{path}: line {number} is not a record of a peer: {error}") from error


def _check(record: Record, recording: Recording) -> None:
    """Raise KeyError, ValueError or TypeError for a pose or direction that cannot be evaluated."""
    if record["event"] == "direction":
        ray_cam = np.array(record["ray_cam"], dtype=np.float64)
        if ray_cam.shape != (3,) or not abs(np.linalg.norm(ray_cam) - 1.0) <= RAY_TOLERANCE:
            raise ValueError("its direction is not a vector of length 1")
        direction_of(record, 0)
        _check_finite(float(record["age_ms"]), float(recording.capture_ns(record)))
    if record["event"] not in ("pose", "target_relative"):
        return
    pose = pose_of(record, 0)
    latency_ms = float(record["age_ms"]) if record["event"] == "pose" else latency_ms_of(record, recording)
    if pose.t_cam_target_m.shape != (3,) or pose.R_cam_target.shape != (3, 3):
        raise ValueError("its pose is not three metres and a quaternion")
    if pose.covariance is not None:
        if pose.covariance.shape != (6, 6):
            raise ValueError("its covariance is not a 6×6 matrix")
        if not (np.isfinite(pose.covariance).all() and pose.covariance.diagonal().min() >= 0.0):
            raise ValueError("its covariance is not finite, or a variance is negative")
    _check_finite(*pose.t_cam_target_m, latency_ms, float(recording.capture_ns(record)))


def _check_finite(*numbers: float) -> None:
    if not np.isfinite(numbers).all():
        raise ValueError("a number is not finite")
