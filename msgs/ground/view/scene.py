"""Turns samples into Rerun entities, live or from a recording alike: what the fleet refuses is not drawn, and what is
not told again for a second is taken away."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import rerun as rr

from msgs import topics
from msgs.cdr import CameraInfo, CompressedImage, DiagnosticArray, Log, PoseWithCovarianceStamped, TFMessage
from msgs.geometry import R_from_q_wxyz
from msgs.ground.feed import Incoming
from msgs.ground.fleet import ATTITUDE_AGE_NS, VEHICLES_MAX, Fleet, TargetRow, camera_attitude
from msgs.ground.view import entities
from msgs.ground.view.layout import TIMELINE
from msgs.receive import TargetPose
from msgs.wire import Array, PayloadError

GONE_NS = 1_000_000_000
_ORIGIN_M = np.zeros(3)
# Without own attitude the camera is drawn level and looking north.
_R_NED_CAM_UNKNOWN = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


@dataclass
class _Vehicle:
    camera: CameraInfo | None = None
    R_ned_cam: Array | None = None
    t_ned_own_m: Array = field(default_factory=lambda: _ORIGIN_M)
    own_stamp_ns: int = 0
    waiting: dict[str, tuple[TargetRow, TargetPose]] = field(default_factory=dict)  # for the own ship at their stamp
    seen_ns: dict[str, int] = field(default_factory=dict)  # stamp of each target that is drawn
    prepared: set[str] = field(default_factory=set)  # targets whose plots have their names
    health: str = ""
    told_no_attitude: bool = False


class Scene:
    """Draws on a recording; used from any thread. `size_m` is the length, width and height of the box that is drawn for
    a target: its true size is not known. `on_vehicles` hears all names whenever there is a new one."""

    def __init__(
        self,
        rec: rr.RecordingStream,
        fleet: Fleet,
        size_m: Sequence[float],
        on_vehicles: Callable[[Sequence[str]], None],
    ) -> None:
        self.drawn = 0  # poses
        self._rec = rec
        self._fleet = fleet
        self._size_m = tuple(size_m)
        self._on_vehicles = on_vehicles
        self._lock = threading.Lock()
        self._vehicles: dict[str, _Vehicle] = {}

    def take(self, incoming: Incoming, now_ns: int) -> None:
        """Draw one sample that came at `now_ns` (UTC)."""
        with self._lock:
            news = self._fleet.take(incoming, now_ns)
            if incoming.topic is topics.POSE:
                if isinstance(news, TargetRow):
                    self._take_pose(incoming, news, now_ns)
                return
            try:
                self._take_other(incoming, news, now_ns)
            except PayloadError:
                return  # the fleet has counted those it looks at; the rest is only not drawn

    def alive(self, uav: str, here: bool, now_ns: int) -> None:
        """A daemon came or went."""
        with self._lock:
            self._fleet.alive(uav, here)
            if self._vehicle(uav) is not None:
                self._at(now_ns)
                entities.log_event(self._rec, uav, 20 if here else 30, "here" if here else "gone")

    def tick(self, now_ns: int) -> None:
        """Take away the targets that were not told again; call it now and then."""
        with self._lock:
            for uav, vehicle in self._vehicles.items():
                for target, stamp_ns in list(vehicle.seen_ns.items()):
                    if now_ns - stamp_ns > GONE_NS:
                        self._place(uav, vehicle, target)
                        self._at(stamp_ns + GONE_NS)
                        for path in entities.target_paths(uav, target):
                            self._rec.log(path, rr.Clear(recursive=True))
                        del vehicle.seen_ns[target]

    def finish(self) -> None:
        """Draw what still waits: no more will come."""
        with self._lock:
            for uav, vehicle in self._vehicles.items():
                for target in list(vehicle.waiting):
                    self._place(uav, vehicle, target)

    def _vehicle(self, uav: str) -> _Vehicle | None:
        """None for the names, made up no doubt, that are one too many."""
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
        self._place(row.uav, vehicle, row.target)
        message = PoseWithCovarianceStamped.decode(incoming.payload)
        pose = TargetPose(row.uav, row.target, message, 0, now_ns)
        self._at(row.stamp_ns)
        entities.log_seen(self._rec, row, pose, vehicle.camera, self._size_m)
        entities.log_plots(self._rec, row, pose.age_s)
        if row.target not in vehicle.prepared:
            vehicle.prepared.add(row.target)
            entities.prepare_target(self._rec, row.uav, row.target)
        vehicle.waiting[row.target] = (row, pose)
        vehicle.seen_ns[row.target] = row.stamp_ns
        self.drawn += 1
        if vehicle.own_stamp_ns == row.stamp_ns:
            self._place(row.uav, vehicle, row.target)

    def _take_other(self, incoming: Incoming, news: object, now_ns: int) -> None:
        uav = incoming.uav
        vehicle = self._vehicle(uav)
        if vehicle is None:
            return
        if incoming.topic is topics.CAMERA_INFO:
            vehicle.camera = CameraInfo.decode(incoming.payload)
            self._at(now_ns)  # its stamp may be from long before, when it last changed
            entities.log_camera(self._rec, uav, vehicle.camera)
        elif incoming.topic is topics.IMAGE:
            image = CompressedImage.decode(incoming.payload)
            self._at(image.stamp_ns)
            entities.log_image(self._rec, uav, image)
        elif incoming.topic is topics.TF:
            self._take_own(uav, vehicle, TFMessage.decode(incoming.payload))
        elif isinstance(news, DiagnosticArray):
            self._at(news.stamp_ns)
            text = news.status[0].message
            entities.log_health(self._rec, uav, news, news=text != vehicle.health)
            vehicle.health = text
        elif isinstance(news, Log):
            self._at(news.stamp_ns)
            entities.log_event(self._rec, uav, news.level, news.msg)

    def _take_own(self, uav: str, vehicle: _Vehicle, message: TFMessage) -> None:
        R_ned_cam = camera_attitude(message)
        links = {one.child_frame_id: one for one in message.transforms}
        if R_ned_cam is None or topics.FRAME_BODY not in links:
            return
        body = links[topics.FRAME_BODY]
        place = links.get(topics.FRAME_BODY_NED)
        vehicle.R_ned_cam = R_ned_cam
        vehicle.t_ned_own_m = place.t_frame_child_m if place is not None else _ORIGIN_M
        vehicle.own_stamp_ns = body.stamp_ns
        self._at(body.stamp_ns)
        R_ned_body = R_from_q_wxyz(np.roll(body.q_frame_child_xyzw, 1))
        entities.log_ship(self._rec, uav, R_ned_body, vehicle.t_ned_own_m, R_ned_cam)
        for target, (row, _) in list(vehicle.waiting.items()):
            if row.stamp_ns <= body.stamp_ns:
                self._place(uav, vehicle, target)

    def _place(self, uav: str, vehicle: _Vehicle, target: str) -> None:
        """Draw a pose that waits in space: the own ship at its stamp has come, or will not."""
        if target not in vehicle.waiting:
            return
        row, pose = vehicle.waiting.pop(target)
        self._at(row.stamp_ns)
        R_ned_cam, t_own_m = vehicle.R_ned_cam, vehicle.t_ned_own_m
        if R_ned_cam is None or abs(row.stamp_ns - vehicle.own_stamp_ns) > ATTITUDE_AGE_NS:
            R_ned_cam, t_own_m = _R_NED_CAM_UNKNOWN, _ORIGIN_M
            if not vehicle.told_no_attitude:
                vehicle.told_no_attitude = True
                entities.log_event(self._rec, uav, 30, "own attitude unknown: drawn as if level and looking north")
        else:
            vehicle.told_no_attitude = False
        entities.log_placed(self._rec, row, pose, R_ned_cam, t_own_m, self._size_m)
