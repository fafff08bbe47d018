"""Judging poses as they arrive: decode, then refuse what is old, repeated, out of order or of a second publisher, and
count why."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from msgs import topics
from msgs.cdr import PoseWithCovarianceStamped
from msgs.geometry import rotation_estimated
from msgs.wire import PayloadError, Refusal

_NS = 1_000_000_000
_PUBLISHERS_REMEMBERED = 16
_SILENT_NS = _NS  # of one publisher, until another is taken for its successor


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


@dataclass(frozen=True)
class _Last:
    """The newest pose taken of a target."""

    stamp_ns: int
    arrival_ns: int
    gid: bytes  # of its publisher


class PoseReceiver:
    """Takes the poses of one UAV's targets and counts what it refuses, by reason.

    A vehicle has one daemon at a time: of two under one name the first that was heard is believed, until nothing of it
    was taken for a second, as when it was restarted. They are told apart by their zenoh sessions (`sender`), and where
    those are not known by the publisher of each target.
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
        self._last: dict[str, _Last] = {}
        self._sender: tuple[str, int] | None = None  # whose poses are taken, and when one last was

    def believes(self, sender: str, now_ns: int) -> bool:
        """Whether what that session sends, of whatever kind, goes with the poses that are taken; '' may be."""
        if not sender or self._sender is None or self._sender[0] == sender:
            return True
        # Set back, our clock tells nothing of how long the other has been silent.
        return not 0 <= now_ns - self._sender[1] <= _SILENT_NS

    def receive(self, key: str, payload: bytes, attachment: bytes, now_ns: int, sender: str = "") -> TargetPose | None:
        """The pose in a sample, or None if it is refused. `now_ns` is UTC; `sender` names the zenoh session."""
        try:
            pose = self._judge(key, payload, attachment, now_ns, sender)
        except PayloadError as error:
            self.refused[error.reason] += 1
            return None
        if sender:
            self._sender = sender, now_ns
        self.accepted += 1
        return pose

    def _judge(self, key: str, payload: bytes, attachment: bytes, now_ns: int, sender: str) -> TargetPose:
        row = topics.parse_key(key, self._uav, domain=self._domain)
        if row is None or row[0] is not topics.POSE or row[1] is None:
            raise PayloadError(Refusal.TOPIC)
        target = row[1]
        parsed = topics.parse_attachment(attachment)
        if parsed is None:
            raise PayloadError(Refusal.ATTACHMENT)
        sequence, _, gid = parsed
        pose = PoseWithCovarianceStamped.decode(payload)
        last = self._last.get(target)
        if not self.believes(sender, now_ns):
            raise PayloadError(Refusal.PUBLISHER)
        if last is not None and gid != last.gid and 0 <= now_ns - last.arrival_ns <= _SILENT_NS:
            raise PayloadError(Refusal.PUBLISHER)
        if sequence <= self._sequences.get((target, gid), 0):
            raise PayloadError(Refusal.SEQUENCE)
        if pose.stamp_ns - now_ns > self._max_future_ns:
            raise PayloadError(Refusal.FUTURE)
        # One that lies ahead is of a clock that was set back since: it must not keep poses out until that time comes.
        overtakes = last is None or pose.stamp_ns > last.stamp_ns or last.stamp_ns - now_ns > self._max_future_ns
        if now_ns - pose.stamp_ns > self._max_age_ns or not overtakes:
            raise PayloadError(Refusal.STALE)
        self._remember(target, gid, sequence)
        self._last[target] = _Last(pose.stamp_ns, now_ns, gid)
        return TargetPose(self._uav, target, pose, sequence, now_ns)

    def _remember(self, target: str, gid: bytes, sequence: int) -> None:
        # The newest goes last, so that a flood of made-up publishers cannot grow this without bound.
        self._sequences.pop((target, gid), None)
        self._sequences[target, gid] = sequence
        while len(self._sequences) > _PUBLISHERS_REMEMBERED:
            del self._sequences[next(iter(self._sequences))]
