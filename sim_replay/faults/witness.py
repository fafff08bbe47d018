"""What was observed of a run: frames exposed by the camera, poses received by the peers, lines logged by the daemon."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from edge.clock import UtcClock
from sim_replay.faults.messages import AUTOPILOT, SUBSCRIBER, ReceivedMessage, from_mavlink, from_zenoh

NEVER_NS = 2**63


@dataclass(frozen=True)
class ExposedFrame:
    """Times are UTC."""

    exposed_ns: int
    stamp_ns: int  # as published by the camera
    frozen: bool  # the previous image again


@dataclass(frozen=True)
class ReceivedPose:
    """A pose that a peer accepted as valid. Times are UTC."""

    peer: str
    capture_ns: int  # as stated in the pose
    arrival_ns: int
    q_ned_cam_wxyz: tuple[float, ...] | None = None  # own attitude sent with it; zeros: unknown; None: not sent


@dataclass
class Witness:
    """Filled by the reader threads of all processes; every wait uses `wait_for`."""

    frames: list[ExposedFrame] = field(default_factory=list)
    poses: list[ReceivedPose] = field(default_factory=list)
    messages: list[ReceivedMessage] = field(default_factory=list)  # all other messages about targets
    held_back: list[tuple[int, int]] = field(default_factory=list)  # UTC ns: intervals in which a link held data back
    said: list[tuple[int, str]] = field(default_factory=list)  # UTC ns, a line of the daemon's log
    counters: dict[str, int] = field(default_factory=dict)  # of the newest diagnostics
    state: str = ""  # with its reasons, of the same diagnostics
    counted_ns: int = 0  # UTC when both arrived
    ready: set[str] = field(default_factory=set)
    summaries: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)  # other output of processes than the daemon
    _changed: threading.Condition = field(default_factory=threading.Condition)
    _clock: UtcClock = field(default_factory=UtcClock)

    def wait_for(self, seen: Callable[[], bool], within_s: float) -> bool:
        """Whether `seen` came true; evaluated with the witness locked, at each change and ten times per second."""
        deadline_s = time.monotonic() + within_s
        with self._changed:
            while not seen():
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    return False
                self._changed.wait(min(left_s, 0.1))
            return True

    def hear_daemon(self, line: str, arrival_ns: int) -> None:
        with self._changed:
            self.said.append((self._clock.utc_ns(arrival_ns), line))
            self._changed.notify_all()

    def hear(self, name: str, line: str) -> None:
        """A line of another process: a JSON object, otherwise stored as a complaint."""
        try:
            record = json.loads(line)
            event = record["event"]
        except (ValueError, TypeError, KeyError):
            record, event = {}, ""
        with self._changed:
            self._take(name, event, record, line)
            self._changed.notify_all()

    def forget_ready(self, name: str) -> None:
        with self._changed:
            self.ready.discard(name)

    def forget_counters(self) -> None:
        """The daemon's counters start at 0 again."""
        with self._changed:
            self.counters = {}

    def zenoh_cut(self, cut: bool, now_ns: int) -> None:
        """From now on the link to the ground holds data back, or releases it."""
        with self._changed:
            if cut:
                self.held_back.append((now_ns, NEVER_NS))
            elif self.held_back and self.held_back[-1][1] == NEVER_NS:
                self.held_back[-1] = (self.held_back[-1][0], now_ns)

    def poses_at(self, peer: str, since_ns: int) -> list[ReceivedPose]:
        """Poses of frames exposed after `since_ns` (UTC), in the order of their arrival."""
        return [pose for pose in self.poses if pose.peer == peer and pose.capture_ns > since_ns]

    def _take(self, name: str, event: str, record: dict[str, Any], line: str) -> None:
        if event == "ready":
            self.ready.add(name)
        elif event == "frame":
            stamp_ns, exposed_ns = record["stamp_utc_ns"], record["exposed_utc_ns"]
            self.frames.append(ExposedFrame(exposed_ns, stamp_ns, record["frozen"]))
        elif event == "target_relative":
            arrival_ns = self._clock.utc_ns(record["received_ns"])
            q_ned_cam = tuple(record["q_ned_cam_wxyz"])
            self.poses.append(ReceivedPose(AUTOPILOT, record["capture_utc_us"] * 1000, arrival_ns, q_ned_cam))
        elif event == "pose":
            capture_ns = record["capture_utc_ns"]
            self.poses.append(ReceivedPose(SUBSCRIBER, capture_ns, capture_ns + round(record["age_ms"] * 1e6)))
        elif event == "message":
            if (message := from_mavlink(record, self._clock.utc_ns)) is not None:
                self.messages.append(message)
        elif event == "sample":
            self.messages.append(from_zenoh(record))
        elif event == "diagnostics":
            values = record["values"].items()
            self.counters = {key: int(value) for key, value in values if value.isdecimal()}
            self.state, self.counted_ns = record["message"], time.time_ns()
        elif event == "summary":
            self.summaries.append((name, record))
        elif event != "direction":  # a `sample` tells it as well
            self.complaints.append(f"{name}: {line}")
