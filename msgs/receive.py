"""Validating received poses and directions: decodes them, refuses those that are old, repeated, out of order, from a
second publisher or cannot be a measurement of our camera, and counts refusals by reason."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from msgs import topics
from msgs.cdr import PoseWithCovarianceStamped, Vector3Stamped
from msgs.geometry import rotation_estimated
from msgs.topics import Topic
from msgs.wire import Array, PayloadError, Refusal

_NS = 1_000_000_000
_PUBLISHERS_REMEMBERED = 32  # of one target's poses or directions, each
POSITION_MAX_M = 100_000.0  # of each coordinate and its standard deviation: far beyond what a camera measures
RAY_TOLERANCE = 1e-3  # of a direction's length, which is one
_FUTURE_MAX_NS = _NS // 2  # how far the sender's clock may be ahead of ours
_SILENT_NS = _NS  # silence of a publisher after which another is accepted as its successor

_Accepted = TypeVar("_Accepted")


@dataclass(frozen=True, eq=False)
class TargetPose:
    """An accepted pose: target `target` (`t0`, …) of `uav`, in `cam`."""

    uav: str
    target: str
    pose: PoseWithCovarianceStamped
    sequence: int
    arrival_ns: int  # UTC of reception

    @property
    def stamp_ns(self) -> int:
        """UTC of the exposure."""
        return self.pose.stamp_ns

    @property
    def rotation_known(self) -> bool:
        """False: the quaternion is a placeholder, the target's attitude is unknown."""
        return rotation_estimated(self.pose.covariance)

    @property
    def age_s(self) -> float:
        """Time from exposure to arrival, including the offset between the two clocks."""
        return (self.arrival_ns - self.pose.stamp_ns) / _NS


@dataclass(frozen=True, eq=False)
class TargetDirection:
    """An accepted direction: target `target` of `uav` is seen there, at an unknown range."""

    uav: str
    target: str
    stamp_ns: int  # UTC of the exposure
    ray_cam: Array  # [3], unit length, camera to target
    arrival_ns: int  # UTC of reception

    @property
    def age_s(self) -> float:
        """As a pose's."""
        return (self.arrival_ns - self.stamp_ns) / _NS


@dataclass(frozen=True)
class _Last:
    """The newest accepted message on a target's topic."""

    arrival_ns: int
    gid: bytes  # of its publisher


class PoseReceiver:
    """Validates the poses and directions of one UAV's targets and counts refusals by reason.

    A vehicle has one daemon at a time. If two publish under one name, the first one received is accepted until none of
    its poses has been accepted for one second (as after a restart). They are distinguished by the publisher gid of each
    target that is being heard, and otherwise by their zenoh session (`sender`), if it is known.
    Ages compare the sender's clock with ours: `max_age_s` must allow for their offset.
    """

    def __init__(self, uav: str, *, domain: int = 0, max_age_s: float = 1.0) -> None:
        self.accepted = 0
        self.refused: Counter[Refusal] = Counter()
        self._uav = topics.check_uav_name(uav)
        self._domain = domain
        self._max_age_ns = round(max_age_s * _NS)
        self._sequences: dict[tuple[str, str, bytes], int] = {}
        self._last: dict[tuple[str, str], _Last] = {}
        self._newest_ns: dict[str, int] = {}  # by target: stamp of the newest accepted pose or direction
        self._sender: tuple[str, int] | None = None  # accepted session, and UTC ns of its last accepted message

    def believes(self, sender: str, now_ns: int) -> bool:
        """Whether messages of that session, of any topic, belong to the accepted daemon; True for '' (unknown)."""
        if not sender or self._sender is None or self._sender[0] == sender:
            return True
        # A negative difference means that our clock was set back, so the silence cannot be measured.
        return not 0 <= now_ns - self._sender[1] <= _SILENT_NS

    def receive(self, key: str, payload: bytes, attachment: bytes, now_ns: int, sender: str = "") -> TargetPose | None:
        """The pose in a sample, or None if it is refused. `now_ns` is UTC; `sender` names the zenoh session."""

        def judge() -> TargetPose:
            target = self._target(topics.POSE, key)
            sequence, gid = _sent_as(attachment)
            pose = PoseWithCovarianceStamped.decode(payload)
            _check_measurable(pose)
            self._admit(topics.POSE, target, pose.stamp_ns, sequence, gid, now_ns, sender)
            return TargetPose(self._uav, target, pose, sequence, now_ns)

        return self._judged(judge, now_ns, sender)

    def receive_direction(
        self, key: str, payload: bytes, attachment: bytes, now_ns: int, sender: str = ""
    ) -> TargetDirection | None:
        """The direction in a sample, or None if it is refused; as `receive`."""

        def judge() -> TargetDirection:
            target = self._target(topics.DIRECTION, key)
            sequence, gid = _sent_as(attachment)
            seen = Vector3Stamped.decode(payload)
            _check_ray(seen)
            self._admit(topics.DIRECTION, target, seen.stamp_ns, sequence, gid, now_ns, sender)
            return TargetDirection(self._uav, target, seen.stamp_ns, seen.ray_cam, now_ns)

        return self._judged(judge, now_ns, sender)

    def _judged(self, judge: Callable[[], _Accepted], now_ns: int, sender: str) -> _Accepted | None:
        try:
            accepted = judge()
        except PayloadError as error:
            self.refused[error.reason] += 1
            return None
        if sender:
            self._sender = sender, now_ns
        self.accepted += 1
        return accepted

    def _target(self, topic: Topic, key: str) -> str:
        row = topics.parse_key(key, self._uav, domain=self._domain)
        if row is None or row[0] is not topic or row[1] is None:
            raise PayloadError(Refusal.TOPIC)
        return row[1]

    def _admit(
        self, topic: Topic, target: str, stamp_ns: int, sequence: int, gid: bytes, now_ns: int, sender: str
    ) -> None:
        publisher = topic.name, target, gid
        last = self._last.get((topic.name, target))
        if last is not None and 0 <= now_ns - last.arrival_ns <= _SILENT_NS:
            believed = gid == last.gid  # a publisher that goes on, whatever its session is called now
        else:
            believed = self.believes(sender, now_ns)
        if not believed:
            raise PayloadError(Refusal.PUBLISHER)
        if sequence <= self._sequences.get(publisher, 0):
            raise PayloadError(Refusal.SEQUENCE)
        if stamp_ns - now_ns > _FUTURE_MAX_NS:
            raise PayloadError(Refusal.FUTURE)
        newest_ns = self._newest_ns.get(target)
        # If the last stamp lies in the future, a clock was set back since: do not refuse everything until then.
        overtakes = newest_ns is None or stamp_ns > newest_ns or newest_ns - now_ns > _FUTURE_MAX_NS
        if now_ns - stamp_ns > self._max_age_ns or not overtakes:
            raise PayloadError(Refusal.STALE)
        self._remember(publisher, sequence)
        self._last[topic.name, target] = _Last(now_ns, gid)
        self._newest_ns[target] = stamp_ns

    def _remember(self, publisher: tuple[str, str, bytes], sequence: int) -> None:
        # Bounded, newest last, so that a flood of fake publishers cannot exhaust memory.
        self._sequences.pop(publisher, None)
        self._sequences[publisher] = sequence
        while len(self._sequences) > _PUBLISHERS_REMEMBERED:
            del self._sequences[next(iter(self._sequences))]


def _sent_as(attachment: bytes) -> tuple[int, bytes]:
    """Sequence number and publisher."""
    parsed = topics.parse_attachment(attachment)
    if parsed is None:
        raise PayloadError(Refusal.ATTACHMENT)
    sequence, _, gid = parsed
    return sequence, gid


def _check_ray(seen: Vector3Stamped) -> None:
    """Raise PayloadError for a vector that is no direction in `cam`."""
    if seen.frame_id != topics.FRAME_CAMERA:
        raise PayloadError(Refusal.FRAME)
    if abs(math.hypot(*seen.ray_cam.tolist()) - 1.0) > RAY_TOLERANCE:
        raise PayloadError(Refusal.DIRECTION)


def _check_measurable(pose: PoseWithCovarianceStamped) -> None:
    """Raise PayloadError for a well-formed pose that is none of a target in `cam` with a known position."""
    if pose.frame_id != topics.FRAME_CAMERA:
        raise PayloadError(Refusal.FRAME)
    x_m, y_m, z_m = pose.t_cam_target_m.tolist()  # in plain floats: called at frame rate
    xx_m2, yy_m2, zz_m2 = map(pose.covariance.item, (0, 7, 14))
    if min(xx_m2, yy_m2, zz_m2) <= 0.0:  # ROS programs set zeros where they know none
        raise PayloadError(Refusal.VARIANCE)
    if max(abs(x_m), abs(y_m), abs(z_m)) > POSITION_MAX_M or max(xx_m2, yy_m2, zz_m2) > POSITION_MAX_M**2:
        raise PayloadError(Refusal.POSITION)
