"""Both peers of the daemon in lock-step: an autopilot on the sequence's time, a subscriber that awaits all outputs.

Their records contain only times of the sequence: timestamps count from the exposure of its first frame.
"""

from __future__ import annotations

import queue
import socket
import time
from typing import Any

import zenoh

from edge.status_board import key_of
from msgs import topics
from msgs.cdr import Detection3DArray
from msgs.client import connect
from msgs.mavlink import MAVLink
from msgs.receive import PoseReceiver, TargetPose
from sim_replay.autopilot import Autopilot
from sim_replay.mavlink_record import message_record
from sim_replay.play import PlayError
from sim_replay.ports import LOOPBACK
from sim_replay.subscriber import direction_record, pose_record

Record = dict[str, Any]

ARRIVAL_TIMEOUT_S = 60.0
_DATAGRAM_BYTES = 65535
# Fields with a time of the daemon's clock, and the nanoseconds per unit.
STAMPS_NS = {
    ("TARGET_RELATIVE", "timestamp"): 1_000,
    ("FOLLOW_TARGET", "timestamp"): 1_000_000,
    ("CAMERA_INFORMATION", "time_boot_ms"): 1_000_000,
    ("TIMESYNC", "ts1"): 1,
}


class MavlinkPeer:
    """A simulated autopilot with its own socket; `records` contains every message that it received."""

    def __init__(self, autopilot: Autopilot, port: int, frame0_ns: int) -> None:
        """`port` is the daemon's, `frame0_ns` the exposure of the first frame on the stepped clock."""
        self.records: list[Record] = []
        self.targets: list[Record] = []  # sim_replay.autopilot's `target_relative`
        self._autopilot = autopilot
        self._frame0_ns = frame0_ns
        self._parser = MAVLink(None)
        self._parser.robust_parsing = True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect((LOOPBACK, port))
        self._socket.setblocking(False)

    def next_due_ns(self) -> int | None:
        """Time of its next telemetry message."""
        return self._autopilot.next_due_ns()

    def speak(self, now_ns: int) -> None:
        """Send the telemetry that is due."""
        for packed in self._autopilot.due(now_ns):
            self._socket.send(packed)

    def listen(self, now_ns: int) -> bool:
        """Process everything received, and answer; returns whether anything was to be answered."""
        answered = False
        while True:
            try:
                datagram = self._socket.recv(_DATAGRAM_BYTES)
            except (BlockingIOError, ConnectionRefusedError):
                return answered
            self._record(datagram, now_ns)
            replies, targets = self._autopilot.take(datagram, now_ns)
            self.targets += targets
            for reply in replies:
                answered = True
                self._socket.send(reply)

    def close(self) -> None:
        self._socket.close()

    def _record(self, datagram: bytes, now_ns: int) -> None:
        for message in self._parser.parse_buffer(datagram) or []:
            record = message_record(message, now_ns - self._frame0_ns)
            for (stamped, field), unit_ns in STAMPS_NS.items():
                # An unset timestamp is 0 and remains 0.
                if message.get_type() == stamped and record[field]:
                    record[field] -= self._frame0_ns // unit_ns
            self.records.append(record)


class Subscriber:
    """Receives poses and directions like a user's program; the frame's detections say which poses belong to it."""

    def __init__(self, endpoint: str, uav: str, frame0_ns: int) -> None:
        """Raises PlayError if the daemon does not answer at `endpoint`."""
        self.records: list[Record] = []
        self.received: list[Record] = []  # poses as in sim_replay.subscriber's output
        self.directions: list[Record] = []  # likewise
        self._frame0_ns = frame0_ns
        self._receiver = PoseReceiver(uav)
        self._came: queue.SimpleQueue[tuple[str, bytes, bytes]] = queue.SimpleQueue()
        self._poses: dict[tuple[int, str], TargetPose] = {}
        self._frames: dict[int, list[str]] = {}
        self._uav = uav
        self._session = _connect(endpoint)
        handler = zenoh.handlers.Callback(self._on_sample, indirect=False)
        keys = [topics.subscription_key(topic, uav) for topic in (topics.POSE, topics.DIRECTION, topics.DETECTIONS)]
        self._subscribers = [self._session.declare_subscriber(key, handler) for key in keys]
        self._wait_until_known(uav)

    def collect(self, frame: int, now_ns: int) -> list[Record]:
        """Wait for the records of the frame exposed at `now_ns`: poses, then directions as in `directions`.

        Raises PlayError if they do not arrive.
        """
        before = len(self.directions)
        deadline_s = time.monotonic() + ARRIVAL_TIMEOUT_S
        while now_ns not in self._frames or any((now_ns, name) not in self._poses for name in self._frames[now_ns]):
            try:
                key, payload, attachment = self._came.get(timeout=max(deadline_s - time.monotonic(), 0.0))
            except queue.Empty:
                raise PlayError(f"the daemon's outputs for frame {frame} did not reach the subscriber") from None
            self._take(key, payload, attachment, now_ns)
        names = sorted(self._frames.pop(now_ns))
        records = [self._record(frame, self._poses.pop((now_ns, name))) for name in names]
        self.records += records
        return records + self.directions[before:]

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._session.close()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
        self._came.put((str(sample.key_expr), sample.payload.to_bytes(), attachment))

    def _take(self, key: str, payload: bytes, attachment: bytes, now_ns: int) -> None:
        row = topics.parse_key(key, self._uav)
        if row is not None and row[0] is topics.DETECTIONS:
            array = Detection3DArray.decode(payload)
            self._frames[array.stamp_ns] = [one.id for one in array.detections]
            return
        if row is not None and row[0] is topics.DIRECTION:
            seen = self._receiver.receive_direction(key, payload, attachment, now_ns)
            if seen is None:
                raise PlayError(f"the subscriber refused a direction: {dict(self._receiver.refused)}")
            self.directions.append(direction_record(seen))
            return
        pose = self._receiver.receive(key, payload, attachment, now_ns)
        if pose is None:
            raise PlayError(f"the subscriber refused a pose: {dict(self._receiver.refused)}")
        self._poses[pose.stamp_ns, pose.target] = pose

    def _record(self, frame: int, taken: TargetPose) -> Record:
        told = pose_record(taken)
        self.received.append(told)
        values = {name: told[name] for name in told.keys() - {"event", "capture_utc_ns", "age_ms"}}
        return {"frame": frame, "t_ns": taken.stamp_ns - self._frame0_ns, **dict(sorted(values.items()))}

    def _wait_until_known(self, uav: str) -> None:
        # An answer to a query sent after the declarations shows that those have reached the daemon.
        deadline_s = time.monotonic() + ARRIVAL_TIMEOUT_S
        while not any(reply.ok for reply in self._session.get(key_of(uav, "info"), timeout=2.0)):
            if time.monotonic() > deadline_s:
                raise PlayError("the daemon does not answer over zenoh")


def _connect(endpoint: str) -> zenoh.Session:
    try:
        return connect(endpoint)
    except ConnectionError as error:
        raise PlayError(str(error)) from error
