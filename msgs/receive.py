"""Judging poses as they arrive: decode, then refuse what is old, repeated or out of order, and count why."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from msgs import topics
from msgs.cdr import PoseWithCovarianceStamped
from msgs.geometry import rotation_estimated
from msgs.wire import PayloadError, Refusal

_NS = 1_000_000_000
_PUBLISHERS_REMEMBERED = 16


@dataclass(frozen=True, eq=False)
class TargetPose:
    """A pose that was taken: target `target` (`t0`, …) of `uav`, in `cam`."""

    uav: str
    target: str
    pose: PoseWithCovarianceStamped
    sequence: int
    arrival_ns: int  # UTC, when it was judged

    @property
    def stamp_ns(self) -> int:
        """UTC of the exposure."""
        return self.pose.stamp_ns

    @property
    def rotation_known(self) -> bool:
        """False: the quaternion is a placeholder; how the target is turned is not known."""
        return rotation_estimated(self.pose.covariance)

    @property
    def age_s(self) -> float:
        """Time from exposure to arrival, as far as the two clocks agree."""
        return (self.arrival_ns - self.pose.stamp_ns) / _NS


class PoseReceiver:
    """Takes the poses of one UAV's targets and counts what it refuses, by reason.

    Ages compare the sender's clock with ours: `max_age_s` and `max_future_s` must allow for their difference.
    """

    def __init__(self, uav: str, *, domain: int = 0, max_age_s: float = 1.0, max_future_s: float = 0.5) -> None:
        self.accepted = 0
        self.refused: Counter[Refusal] = Counter()
        self._uav = topics.check_uav_name(uav)
        self._domain = domain
        self._max_age_ns = round(max_age_s * _NS)
        self._max_future_ns = round(max_future_s * _NS)
        self._sequences: dict[tuple[str, bytes], int] = {}
        self._stamps_ns: dict[str, int] = {}

    def receive(self, key: str, payload: bytes, attachment: bytes, now_ns: int) -> TargetPose | None:
        """The pose in a sample, or None if it is refused. `now_ns` is UTC."""
        try:
            pose = self._judge(key, payload, attachment, now_ns)
        except PayloadError as error:
            self.refused[error.reason] += 1
            return None
        self.accepted += 1
        return pose

    def _judge(self, key: str, payload: bytes, attachment: bytes, now_ns: int) -> TargetPose:
        row = topics.parse_key(key, self._uav, domain=self._domain)
        if row is None or row[0] is not topics.POSE or row[1] is None:
            raise PayloadError(Refusal.TOPIC)
        target = row[1]
        parsed = topics.parse_attachment(attachment)
        if parsed is None:
            raise PayloadError(Refusal.ATTACHMENT)
        sequence, _, gid = parsed
        pose = PoseWithCovarianceStamped.decode(payload)
        if sequence <= self._sequences.get((target, gid), 0):
            raise PayloadError(Refusal.SEQUENCE)
        if pose.stamp_ns - now_ns > self._max_future_ns:
            raise PayloadError(Refusal.FUTURE)
        last_ns = self._stamps_ns.get(target)
        # One that lies ahead is of a clock that was set back since: it must not keep poses out until that time comes.
        overtakes = last_ns is None or pose.stamp_ns > last_ns or last_ns - now_ns > self._max_future_ns
        if now_ns - pose.stamp_ns > self._max_age_ns or not overtakes:
            raise PayloadError(Refusal.STALE)
        self._remember(target, gid, sequence)
        self._stamps_ns[target] = pose.stamp_ns
        return TargetPose(self._uav, target, pose, sequence, now_ns)

    def _remember(self, target: str, gid: bytes, sequence: int) -> None:
        # The newest goes last, so that a flood of made-up publishers cannot grow this without bound.
        self._sequences.pop((target, gid), None)
        self._sequences[target, gid] = sequence
        while len(self._sequences) > _PUBLISHERS_REMEMBERED:
            del self._sequences[next(iter(self._sequences))]
