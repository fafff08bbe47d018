"""State of each vehicle and its targets, from the samples received so far. No sockets; thread-safe.

Range and closing speed are relative to the camera. Bearing (clockwise from north), elevation and attitude are in NED
while the vehicle sends its own attitude; otherwise bearing and elevation are measured to the right of and above the
optical axis. Of a target whose range is not known, only bearing and elevation are. The own attitude arrives after the
pose and, over radio, less often: it is predicted for the row that is returned at once, and the row that is shown waits
for the one of its time.
"""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from msgs import topics
from msgs.cdr import DECODERS, Detection3DArray, DiagnosticArray, Log, TFMessage
from msgs.geometry import R_from_q_wxyz, euler_from_R
from msgs.ground.feed import Incoming
from msgs.ground.own_ship import GAP_NS, OwnShip, OwnShipHistory
from msgs.receive import PoseReceiver, TargetDirection, TargetPose
from msgs.wire import Array, PayloadError, Refusal

CLOSING_WINDOW_NS = 1_500_000_000
CLOSING_SPAN_NS = 400_000_000
# A larger change of range than flight can explain means another aircraft under the same number, or a track whose range
# was moved to that of its last frames. Two small aircraft approach each other at less than 150 m/s; noise changes a
# track's range by up to 5 m from frame to frame, such a move by tens of metres.
FLIGHT_MPS = 150.0
RANGE_NOISE_M = 5.0
FORGET_TARGET_NS = 10_000_000_000
RATE_WINDOW_NS = 3_000_000_000
HEALTH_STALE_NS = 3_000_000_000  # health is sent every second
SCORE_STALE_NS = 2_000_000_000  # scores come with each frame, at most as often as the poses
SET_BACK_NS = 500_000_000  # reception times further in the future mean that our clock was set back since
_KEPT_MAX = 256
# Topics that a Fleet evaluates.
TAKEN = (topics.POSE, topics.DIRECTION, topics.DETECTIONS, topics.TF, topics.DIAGNOSTICS, topics.EVENTS)
VEHICLES_MAX = 64  # bounds memory against fake names


@dataclass(frozen=True)
class TargetRow:
    """One target at its latest pose."""

    uav: str
    target: str
    stamp_ns: int  # UTC of the exposure
    heard_ns: int  # UTC of reception by our clock
    range_m: float
    bearing_deg: float
    elevation_deg: float
    frame: Literal["ned", "cam"]  # of bearing and elevation
    own_age_s: float | None  # from the own attitude that they are predicted from to the exposure; None: in cam
    closing_mps: float | None  # positive: approaching
    attitude_deg: tuple[float, float, float] | None  # roll, pitch, heading in NED; None: own or target's unknown
    score: float | None
    sigma_range_m: float
    sigma_rotation_deg: float | None  # None: target's attitude unknown
    t_cam_target_m: tuple[float, float, float]
    q_cam_target_xyzw: tuple[float, float, float, float]


@dataclass(frozen=True)
class DirectionRow:
    """One target at its latest direction, its range unknown; fields as in TargetRow."""

    uav: str
    target: str
    stamp_ns: int
    heard_ns: int
    bearing_deg: float
    elevation_deg: float
    frame: Literal["ned", "cam"]
    own_age_s: float | None
    ray_cam: tuple[float, float, float]  # unit length


Row = TargetRow | DirectionRow


@dataclass(frozen=True)
class VehicleRow:
    """One vehicle."""

    uav: str
    alive: bool  # its daemon's liveliness token is present
    level: int  # as in diagnostic_msgs: 0 ok, 1 warn, 2 error
    health: str
    health_heard_ns: int  # UTC of reception by our clock; 0: never
    event: str
    pose_rate_hz: float
    refused: Counter[Refusal]  # samples, by reason
    targets: tuple[Row, ...]


@dataclass
class _Target:
    newest: Row  # with the own attitude known at its reception
    seen_ns: int
    ranges: deque[tuple[int, float]] = field(default_factory=lambda: deque(maxlen=_KEPT_MAX))  # stamp, m
    # The newest row whose own attitude has arrived, and the stamps of later ones that still wait for theirs, each with
    # what makes the row.
    settled: Row | None = None
    waiting: deque[tuple[int, Callable[[OwnShip], Row]]] = field(default_factory=lambda: deque(maxlen=_KEPT_MAX))

    def row(self) -> Row:
        """The row to show: the newest settled one, unless the vehicle no longer sends its attitude."""
        if self.settled is not None and self.newest.stamp_ns - self.settled.stamp_ns <= GAP_NS:
            return self.settled
        return self.newest

    def settle(self, own: OwnShipHistory) -> None:
        """Recompute the newest row whose own attitude has arrived."""
        for index in reversed(range(len(self.waiting))):
            stamp_ns, row_with = self.waiting[index]
            ship = own.at(stamp_ns)
            if ship is not None:
                self.settled = row_with(ship)
                for _ in range(index + 1):
                    self.waiting.popleft()
                return


@dataclass
class _Vehicle:
    receiver: PoseReceiver
    alive: bool = False
    level: int = 0
    health: str = ""
    health_heard_ns: int = 0
    event: str = ""
    event_number: tuple[bytes, int] = (b"", 0)  # publisher and sequence number of the newest event
    own: OwnShipHistory = field(default_factory=OwnShipHistory)
    scores: dict[str, float] = field(default_factory=dict)
    scored_ns: int = 0  # stamp of the frame that they are of
    targets: dict[str, _Target] = field(default_factory=dict)
    arrivals_ns: deque[int] = field(default_factory=deque)  # of poses

    def pose_arrived(self, now_ns: int) -> None:
        self.arrivals_ns.append(now_ns)
        while not _is_recent(self.arrivals_ns[0], now_ns):
            self.arrivals_ns.popleft()

    def poses_per_s(self, now_ns: int) -> float:
        return sum(_is_recent(arrival_ns, now_ns) for arrival_ns in self.arrivals_ns) / (RATE_WINDOW_NS / 1e9)

    def score(self, pose: TargetPose) -> float | None:
        """As last told; None if that was for a frame long before this pose, or after it."""
        if abs(pose.stamp_ns - self.scored_ns) > SCORE_STALE_NS:
            return None
        return self.scores.get(pose.target)


class Fleet:
    """Collects samples and provides the current state. `max_age_s` must allow for the offset between the clocks."""

    def __init__(self, *, domain: int = 0, max_age_s: float = 2.0) -> None:
        self._domain = domain
        self._max_age_s = max_age_s
        self._lock = threading.Lock()
        self._vehicles: dict[str, _Vehicle] = {}

    def alive(self, uav: str, alive: bool) -> None:
        with self._lock:
            vehicle = self._vehicle(uav)
            if vehicle is not None:
                vehicle.alive = alive

    def take(self, incoming: Incoming, now_ns: int) -> Row | Log | DiagnosticArray | None:
        """Process a sample received at `now_ns` (UTC); returns what is new for the operator, or None. Counts malformed
        ones."""
        with self._lock:
            vehicle = self._vehicle(incoming.uav)
            if vehicle is None:
                return None
            sample = incoming.key, incoming.payload, incoming.attachment, now_ns, incoming.sender
            if incoming.topic is topics.POSE:
                pose = vehicle.receiver.receive(*sample)
                return None if pose is None else self._take_pose(vehicle, pose)
            if incoming.topic is topics.DIRECTION:
                seen = vehicle.receiver.receive_direction(*sample)
                return None if seen is None else self._take_direction(vehicle, seen)
            if incoming.topic not in TAKEN:
                return None
            try:
                message = DECODERS[incoming.topic.ros_type](incoming.payload)
            except PayloadError as error:
                vehicle.receiver.refused[error.reason] += 1
                return None
            # Events are exempt: their history includes those of earlier daemons.
            if incoming.topic is not topics.EVENTS and not vehicle.receiver.believes(incoming.sender, now_ns):
                vehicle.receiver.refused[Refusal.PUBLISHER] += 1
                return None
            return _note(vehicle, message, topics.parse_attachment(incoming.attachment), now_ns)

    def believes(self, incoming: Incoming, now_ns: int) -> bool:
        """Whether a sample is from the vehicle's accepted daemon, not from a second one under its name."""
        with self._lock:
            vehicle = self._vehicles.get(incoming.uav)
            return vehicle is None or vehicle.receiver.believes(incoming.sender, now_ns)

    def rows(self, now_ns: int) -> list[VehicleRow]:
        """All known vehicles, by name; targets not seen for ten seconds are left out."""
        with self._lock:
            return [self._row(uav, vehicle, now_ns) for uav, vehicle in sorted(self._vehicles.items())]

    def _vehicle(self, uav: str) -> _Vehicle | None:
        if uav not in self._vehicles and len(self._vehicles) < VEHICLES_MAX:
            self._vehicles[uav] = _Vehicle(PoseReceiver(uav, domain=self._domain, max_age_s=self._max_age_s))
        return self._vehicles.get(uav)

    def _take_pose(self, vehicle: _Vehicle, pose: TargetPose) -> TargetRow:
        known = _known(vehicle, pose.target, pose.stamp_ns)
        ranges = deque[tuple[int, float]](maxlen=_KEPT_MAX) if known is None else known.ranges
        range_m = float(np.linalg.norm(pose.pose.t_cam_target_m))
        if ranges and not _flown(*ranges[-1], pose.stamp_ns, range_m):
            ranges.clear()
        ranges.append((pose.stamp_ns, range_m))
        while ranges[0][0] < pose.stamp_ns - CLOSING_WINDOW_NS:
            ranges.popleft()
        closing, score = closing_mps(ranges), vehicle.score(pose)
        row = target_row(pose, closing, vehicle.own.near(pose.stamp_ns), score)
        if known is None:
            known = vehicle.targets[pose.target] = _Target(row, pose.arrival_ns, ranges)
        _update(vehicle, known, row, lambda ship: target_row(pose, closing, ship, score))
        vehicle.pose_arrived(pose.arrival_ns)
        return row

    def _take_direction(self, vehicle: _Vehicle, seen: TargetDirection) -> DirectionRow:
        row = direction_row(seen, vehicle.own.near(seen.stamp_ns))
        known = _known(vehicle, seen.target, seen.stamp_ns)
        if known is None:
            known = vehicle.targets[seen.target] = _Target(row, seen.arrival_ns)
        _update(vehicle, known, row, lambda ship: direction_row(seen, ship))
        return row

    def _row(self, uav: str, vehicle: _Vehicle, now_ns: int) -> VehicleRow:
        # A time in the future means that our clock was set back since: the true age is unknown.
        kept = {
            name: one
            for name, one in vehicle.targets.items()
            if -SET_BACK_NS <= now_ns - one.seen_ns <= FORGET_TARGET_NS
        }
        vehicle.targets = kept
        targets = tuple(one.row() for _, one in sorted(vehicle.targets.items()))
        return VehicleRow(
            uav,
            vehicle.alive,
            vehicle.level,
            vehicle.health,
            vehicle.health_heard_ns,
            vehicle.event,
            vehicle.poses_per_s(now_ns),
            vehicle.receiver.refused.copy(),
            targets,
        )


def _is_recent(arrival_ns: int, now_ns: int) -> bool:
    return -SET_BACK_NS <= now_ns - arrival_ns <= RATE_WINDOW_NS


def _known(vehicle: _Vehicle, target: str, stamp_ns: int) -> _Target | None:
    """The target as known so far; None if it is new, or the vehicle's clock was set back."""
    known = vehicle.targets.get(target)
    return None if known is None or stamp_ns <= known.newest.stamp_ns else known


def _update(vehicle: _Vehicle, known: _Target, row: Row, row_with: Callable[[OwnShip], Row]) -> None:
    """Note a target's newest row; `row_with` makes it with the own attitude of its time."""
    known.newest, known.seen_ns = row, row.heard_ns
    known.waiting.append((row.stamp_ns, row_with))
    while known.waiting[0][0] < row.stamp_ns - GAP_NS:
        known.waiting.popleft()
    known.settle(vehicle.own)


def _note(
    vehicle: _Vehicle, message: object, sent_as: tuple[int, int, bytes] | None, now_ns: int
) -> Log | DiagnosticArray | None:
    """Update the vehicle; returns what is new. `sent_as`: the attachment's sequence number, time and publisher."""
    match message:
        case Detection3DArray():
            vehicle.scores = {one.id: one.hypotheses[0].score for one in message.detections if one.hypotheses}
            vehicle.scored_ns = message.stamp_ns
        case TFMessage():
            vehicle.own.take(message)
            for target in vehicle.targets.values():
                target.settle(vehicle.own)
        case DiagnosticArray() if message.status:
            vehicle.level, vehicle.health = message.status[0].level, message.status[0].message
            vehicle.health_heard_ns = now_ns
            return message
        case Log() if _is_news(vehicle, sent_as):
            vehicle.event = message.msg
            return message
    return None


def _is_news(vehicle: _Vehicle, sent_as: tuple[int, int, bytes] | None) -> bool:
    """Whether an event is new, by its publisher's sequence number: clocks may be set, and history arrives late."""
    if sent_as is None:
        return False
    number, _, publisher = sent_as
    known, newest = vehicle.event_number
    if publisher == known and number <= newest:
        return False
    vehicle.event_number = (publisher, number)
    return True


def _flown(before_ns: int, before_m: float, stamp_ns: int, range_m: float) -> bool:
    """Whether flight can explain a change of range."""
    return abs(range_m - before_m) <= FLIGHT_MPS * (stamp_ns - before_ns) / 1e9 + RANGE_NOISE_M


def closing_mps(ranges: deque[tuple[int, float]]) -> float | None:
    """Closing speed from a line fitted to (stamp ns, range m); None if there are too few points."""
    if len(ranges) < 4 or ranges[-1][0] - ranges[0][0] < CLOSING_SPAN_NS:
        return None
    points = np.array(ranges, dtype=np.float64)
    return -float(np.polyfit((points[:, 0] - points[0, 0]) / 1e9, points[:, 1], 1)[0])


def target_row(pose: TargetPose, closing: float | None, ship: OwnShip | None, score: float | None) -> TargetRow:
    """Row for a pose; `ship` is None if the own attitude is unknown."""
    t_m, covariance = pose.pose.t_cam_target_m, pose.pose.covariance
    range_m = float(np.linalg.norm(t_m))
    along = t_m / max(range_m, 1e-9)
    attitude: tuple[float, float, float] | None = None
    bearing_deg, elevation_deg, frame, own_age_s = _bearing(t_m, pose.stamp_ns, ship)
    if ship is not None and pose.rotation_known:
        R_cam_target = R_from_q_wxyz(np.roll(pose.pose.q_cam_target_xyzw, 1))
        roll, pitch, yaw = np.degrees(euler_from_R(ship.R_ned_cam @ R_cam_target))
        attitude = (float(roll), float(pitch), float(yaw) % 360.0)
    sigma_rotation_rad = math.sqrt(max(float(np.trace(covariance[3:, 3:])), 0.0) / 3.0)
    x, y, z, w = map(float, pose.pose.q_cam_target_xyzw)
    return TargetRow(
        uav=pose.uav,
        target=pose.target,
        stamp_ns=pose.stamp_ns,
        heard_ns=pose.arrival_ns,
        range_m=range_m,
        bearing_deg=bearing_deg,
        elevation_deg=elevation_deg,
        frame=frame,
        own_age_s=own_age_s,
        closing_mps=closing,
        attitude_deg=attitude,
        score=score,
        sigma_range_m=math.sqrt(max(float(along @ covariance[:3, :3] @ along), 0.0)),
        sigma_rotation_deg=math.degrees(sigma_rotation_rad) if pose.rotation_known else None,
        t_cam_target_m=(float(t_m[0]), float(t_m[1]), float(t_m[2])),
        q_cam_target_xyzw=(x, y, z, w),
    )


def direction_row(seen: TargetDirection, ship: OwnShip | None) -> DirectionRow:
    """Row for a direction; `ship` is None if the own attitude is unknown."""
    x, y, z = map(float, seen.ray_cam)
    told = _bearing(seen.ray_cam, seen.stamp_ns, ship)
    return DirectionRow(seen.uav, seen.target, seen.stamp_ns, seen.arrival_ns, *told, (x, y, z))


def _bearing(
    t_cam_m: Array, stamp_ns: int, ship: OwnShip | None
) -> tuple[float, float, Literal["ned", "cam"], float | None]:
    """Bearing and elevation, degrees, of a vector [3] in `cam`; their frame; and the age of the own attitude, s."""
    if ship is None:
        right, down, ahead = t_cam_m
    else:
        ahead, right, down = ship.R_ned_cam @ t_cam_m
    bearing_deg = math.degrees(math.atan2(right, ahead))
    elevation_deg = math.degrees(math.atan2(-down, math.hypot(right, ahead)))
    if ship is None:
        return bearing_deg, elevation_deg, "cam", None
    return bearing_deg % 360.0, elevation_deg, "ned", (stamp_ns - ship.stamp_ns) / 1e9
