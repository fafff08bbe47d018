"""Turns samples into Rerun entities, live or from a recording: refused samples are not drawn, and a target without a
new pose for one second is removed."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import rerun as rr

from msgs import topics
from msgs.cdr import CameraInfo, CompressedImage, DiagnosticArray, Log, PoseWithCovarianceStamped, TFMessage
from msgs.geometry import R_FORWARD_CAM, R_from_q_wxyz
from msgs.ground.feed import Incoming
from msgs.ground.fleet import HEALTH_STALE_NS, SET_BACK_NS, VEHICLES_MAX, DirectionRow, Fleet, Row, TargetRow
from msgs.ground.own_ship import GAP_NS, OwnShipHistory
from msgs.ground.view import entities
from msgs.ground.view.layout import TIMELINE
from msgs.receive import TargetPose
from msgs.wire import Array, PayloadError

GONE_NS = 1_000_000_000
_WAITING_MAX = 256
_OF_BEFORE_NS = 3_000_000_000  # so much older than all else is an event only if it is told again; clocks differ by less
# Without own attitude the own ship is drawn where it was last, level and heading north, and the camera looking north.
_R_NED_CAM_UNKNOWN = R_FORWARD_CAM


@dataclass
class _Vehicle:
    camera: CameraInfo | None = None
    own: OwnShipHistory = field(default_factory=OwnShipHistory)
    t_own_m: Array = field(default_factory=lambda: np.zeros(3))  # in ned, the last known
    # What waits for the own-ship state of its stamp: drawn by R_ned_cam and t_ned_cam_m.
    waiting: deque[tuple[int, Callable[[Array, Array], None]]] = field(
        default_factory=lambda: deque(maxlen=_WAITING_MAX)
    )
    seen_ns: dict[str, tuple[int, int]] = field(default_factory=dict)  # stamp and reception time of each drawn target
    prepared: set[str] = field(default_factory=set)  # targets whose plots are named
    rangeless: set[str] = field(default_factory=set)  # targets of which only the direction is drawn
    health: DiagnosticArray | None = None  # the latest, and its reception time
    health_came_ns: int = 0
    health_silent: bool = False
    told_no_attitude: bool = False


class Scene:
    """Draws into a Rerun recording; thread-safe. `size_m` is the length, width and height of the box drawn for a
    target, as its true size is unknown. `on_vehicles` is called with all names whenever there is a new one."""

    def __init__(
        self,
        rec: rr.RecordingStream,
        fleet: Fleet,
        size_m: Sequence[float],
        on_vehicles: Callable[[Sequence[str]], None],
    ) -> None:
        self.drawn = 0  # poses
        self.directions_drawn = 0
        self._rec = rec
        self._fleet = fleet
        self._size_m = tuple(size_m)
        self._on_vehicles = on_vehicles
        self._lock = threading.Lock()
        self._vehicles: dict[str, _Vehicle] = {}
        self._began_ns = 0  # reception time of the first sample

    def take(self, incoming: Incoming, now_ns: int) -> None:
        """Draw one sample received at `now_ns` (UTC)."""
        with self._lock:
            self._began_ns = self._began_ns or now_ns
            believed = self._fleet.believes(incoming, now_ns)
            news = self._fleet.take(incoming, now_ns)
            if incoming.topic is topics.POSE:
                if isinstance(news, TargetRow):
                    self._take_pose(incoming, news, now_ns)
                return
            if incoming.topic is topics.DIRECTION:
                if isinstance(news, DirectionRow):
                    self._take_direction(news, now_ns)
                return
            if not believed and incoming.topic is not topics.EVENTS:
                return
            try:
                self._take_other(incoming, news, now_ns)
            except PayloadError:
                return  # counted by the fleet if it is one of its topics; otherwise just not drawn

    def alive(self, uav: str, here: bool, now_ns: int) -> None:
        """A daemon appeared or disappeared."""
        with self._lock:
            self._fleet.alive(uav, here)
            if self._vehicle(uav) is not None:
                self._at(now_ns)
                entities.log_event(self._rec, uav, 20 if here else 30, "here" if here else "gone")

    def empty(self) -> bool:
        """Whether nothing was received, hence nothing drawn."""
        with self._lock:
            return not self._vehicles

    def tick(self, now_ns: int) -> None:
        """Remove targets without new poses and mark stale health; call periodically."""
        with self._lock:
            for uav, vehicle in self._vehicles.items():
                self._tell_silence(uav, vehicle, now_ns)
                for target, (stamp_ns, came_ns) in list(vehicle.seen_ns.items()):
                    # A time in the future means that our clock was set back since: the true age is unknown.
                    if not -SET_BACK_NS <= now_ns - came_ns <= GONE_NS:
                        self._place(uav, vehicle, stamp_ns)
                        self._at(stamp_ns + GONE_NS)
                        for path in entities.target_paths(uav, target):
                            self._rec.log(path, rr.Clear(recursive=True))
                        del vehicle.seen_ns[target]

    def _tell_silence(self, uav: str, vehicle: _Vehicle, now_ns: int) -> None:
        heard = -SET_BACK_NS <= now_ns - vehicle.health_came_ns <= HEALTH_STALE_NS
        if vehicle.health is None or vehicle.health_silent or heard:
            return
        vehicle.health_silent = True
        self._at(vehicle.health.stamp_ns + HEALTH_STALE_NS)
        entities.log_silence(self._rec, uav, vehicle.health)

    def finish(self) -> None:
        """Draw the poses that still wait, at the end of the data."""
        with self._lock:
            for uav, vehicle in self._vehicles.items():
                self._place(uav, vehicle, None)

    def _vehicle(self, uav: str) -> _Vehicle | None:
        """The vehicle's state; None for new names beyond VEHICLES_MAX, which are presumably fake."""
        if uav not in self._vehicles:
            if len(self._vehicles) >= VEHICLES_MAX:
                return None
            self._vehicles[uav] = _Vehicle()
            entities.prepare(self._rec, uav)
            self._on_vehicles(sorted(self._vehicles))
        return self._vehicles[uav]

    def _at(self, utc_ns: int) -> None:
        self._rec.set_time(TIMELINE, timestamp=np.datetime64(utc_ns, "ns"))

    def _take_pose(self, incoming: Incoming, row: TargetRow, now_ns: int) -> None:
        vehicle = self._vehicle(incoming.uav)
        if vehicle is None:
            return
        message = PoseWithCovarianceStamped.decode(incoming.payload)
        pose = TargetPose(row.uav, row.target, message, 0, now_ns)
        self._begin(vehicle, row, now_ns, rangeless=False)
        entities.log_seen(self._rec, row, pose, vehicle.camera, self._size_m)
        entities.log_plots(self._rec, row, pose.age_s)
        if row.target not in vehicle.prepared:
            vehicle.prepared.add(row.target)
            entities.prepare_target(self._rec, row.uav, row.target)

        def place(R_ned_cam: Array, t_ned_cam_m: Array) -> None:
            entities.log_placed(self._rec, row, pose, R_ned_cam, t_ned_cam_m, self._size_m)

        self.drawn += 1
        self._place_soon(vehicle, row, place)

    def _take_direction(self, row: DirectionRow, now_ns: int) -> None:
        vehicle = self._vehicle(row.uav)
        if vehicle is None:
            return
        self._begin(vehicle, row, now_ns, rangeless=True)
        entities.log_direction(self._rec, row, vehicle.camera)
        self.directions_drawn += 1
        self._place_soon(vehicle, row, partial(entities.log_direction_placed, self._rec, row))

    def _begin(self, vehicle: _Vehicle, row: Row, now_ns: int, *, rangeless: bool) -> None:
        """Begin to draw a target at the row's time. If its range was known before and is not now, or the other way
        round, what was drawn of it is removed."""
        # Own-ship states of before that time will not arrive any more.
        self._place(row.uav, vehicle, row.stamp_ns - GAP_NS)
        self._at(row.stamp_ns)
        if rangeless != (row.target in vehicle.rangeless):
            entities.clear_target(self._rec, row.uav, row.target)
            vehicle.rangeless ^= {row.target}
        vehicle.seen_ns[row.target] = row.stamp_ns, now_ns

    def _place_soon(self, vehicle: _Vehicle, row: Row, place: Callable[[Array, Array], None]) -> None:
        vehicle.waiting.append((row.stamp_ns, place))
        if vehicle.own.at(row.stamp_ns) is not None:
            self._place(row.uav, vehicle, row.stamp_ns)

    def _take_other(self, incoming: Incoming, news: object, now_ns: int) -> None:
        uav = incoming.uav
        vehicle = self._vehicle(uav)
        if vehicle is None:
            return
        if incoming.topic is topics.CAMERA_INFO:
            vehicle.camera = CameraInfo.decode(incoming.payload)
            self._at(now_ns)  # its stamp is of its last change, possibly long ago
            entities.log_camera(self._rec, uav, vehicle.camera)
        elif incoming.topic is topics.IMAGE:
            image = CompressedImage.decode(incoming.payload)
            self._at(image.stamp_ns)
            entities.log_image(self._rec, uav, image)
        elif incoming.topic is topics.TF:
            self._take_own(uav, vehicle, TFMessage.decode(incoming.payload))
        elif isinstance(news, DiagnosticArray):
            self._at(news.stamp_ns)
            before = None if vehicle.health is None else vehicle.health.status[0].message
            entities.log_health(self._rec, uav, news, news=news.status[0].message != before)
            vehicle.health, vehicle.health_came_ns, vehicle.health_silent = news, now_ns, False
        elif isinstance(news, Log):
            # Whoever joins late is told what happened before. Drawn at its own time, a recording, which is played from
            # its first time on, would begin with up to hours of nothing else.
            of_before = news.stamp_ns < self._began_ns - _OF_BEFORE_NS
            self._at(self._began_ns if of_before else news.stamp_ns)
            text = f"{entities.clock(news.stamp_ns)}: {news.msg}" if of_before else news.msg
            entities.log_event(self._rec, uav, news.level, text)

    def _take_own(self, uav: str, vehicle: _Vehicle, message: TFMessage) -> None:
        ship = vehicle.own.take(message)
        body = next((one for one in message.transforms if one.child_frame_id == topics.FRAME_BODY), None)
        if ship is None or body is None:
            return
        self._at(ship.stamp_ns)
        R_ned_body = R_from_q_wxyz(np.roll(body.q_frame_child_xyzw, 1))
        entities.log_ship(self._rec, uav, R_ned_body, ship.t_ned_own_m, ship.R_ned_cam, ship.t_ned_cam_m)
        vehicle.t_own_m = ship.t_ned_own_m
        self._place(uav, vehicle, ship.stamp_ns)

    def _place(self, uav: str, vehicle: _Vehicle, until_ns: int | None) -> None:
        """Draw what waits, up to `until_ns`, in space: its own-ship state has arrived, or will not."""
        for _ in range(len(vehicle.waiting)):
            stamp_ns, place = vehicle.waiting.popleft()
            if until_ns is not None and stamp_ns > until_ns:
                vehicle.waiting.append((stamp_ns, place))
                continue
            self._at(stamp_ns)
            ship = vehicle.own.near(stamp_ns)
            if ship is None and not vehicle.told_no_attitude:
                entities.log_event(self._rec, uav, 30, "own attitude unknown: drawn as if level and looking north")
                here_m = vehicle.t_own_m
                entities.log_ship(self._rec, uav, np.eye(3), here_m, _R_NED_CAM_UNKNOWN, here_m)
            vehicle.told_no_attitude = ship is None
            if ship is None:
                place(_R_NED_CAM_UNKNOWN, vehicle.t_own_m)
            else:
                place(ship.R_ned_cam, ship.t_ned_cam_m)
