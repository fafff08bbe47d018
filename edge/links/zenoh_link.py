"""The link to the ground: publishes each report on the keys of the topic table, from its own thread.

The loop only leaves the newest report in a mailbox. The session is a peer: it opens whether or not the ground is
reachable, and zenoh keeps trying to connect. Everything published is also recorded, byte for byte, if there is a
recorder; with zenoh disabled it is only recorded.
"""

from __future__ import annotations

import logging
import re
import threading
from collections import Counter, defaultdict, deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import zenoh
from zenoh import CongestionControl, Reliability

from edge import clock
from edge.clock import UTC_SET_NS, UtcClock
from edge.config_ground import ZenohSettings
from edge.health import HealthSnapshot
from edge.links import zenoh_messages as ros
from edge.links.errors import LinkError
from edge.links.outgoing import NS_PER_MS, rangeless, sendable
from edge.links.zenoh_commands import Actions, declare_commands
from edge.pictures import Picture, Rate
from edge.requests import AskReload, RequestQueue
from edge.types import Mount, Report
from msgs import topics
from msgs.cdr import CompressedImage, Log, Payload
from msgs.publish import Node, TopicPublisher
from msgs.recording import Recorder
from msgs.session import peer_config, reason_of
from msgs.topics import Topic

log = logging.getLogger(__name__)

EVENTS_WAITING = 64
PICTURES_WAITING = 4
STOP_TIMEOUT_S = 5.0
# Closing waits for connection attempts; one to a router that does not answer is left to end with the process.
CLOSE_TIMEOUT_S = 2.0
SETTLE_TIMEOUT_S = 60.0
EXPOSURES_KEPT = 16  # a frame's picture is ready a few frames after its poses


@dataclass
class Mailbox:
    """What is queued for the worker: the newest report and snapshot, and events and pictures in order."""

    report: Report | None = None
    snapshot: HealthSnapshot | None = None
    events: deque[tuple[int, int, str]] = field(default_factory=lambda: deque(maxlen=EVENTS_WAITING))
    pictures: deque[Picture] = field(default_factory=lambda: deque(maxlen=PICTURES_WAITING))
    stopping: bool = False

    def empty(self) -> bool:
        return self.report is None and self.snapshot is None and not self.events and not self.pictures


class ZenohLink:
    """Publishes reports, diagnostics and events of one vehicle. The publish methods never block."""

    def __init__(
        self,
        settings: ZenohSettings,
        vehicle_name: str,
        mount: Mount,
        recorder: Recorder | None = None,
        requests: RequestQueue | None = None,
        reload: AskReload | None = None,
    ) -> None:
        self._settings = settings
        self._requests = requests
        self._reload = reload
        self._recorder = recorder
        self._vehicle_name = vehicle_name
        self._mount = mount
        self._sleep = clock.SleepWatch()
        self._waiting = threading.Condition()
        self._mailbox = Mailbox()
        self._counters: Counter[str] = Counter()
        self._delivering = False
        self._targets: dict[str, int] = {}  # of the newest report: name to track id
        self._links = 0  # routers and peers currently connected
        self._picture_publisher: TopicPublisher | None = None
        self._worker: threading.Thread | None = None
        self._session: zenoh.Session | None = None

    def start(self) -> None:
        """Open the session and begin. Raises LinkError if an endpoint cannot be listened on."""
        if self._settings.enabled:
            self._session = self._open()
        self._worker = threading.Thread(target=self._work, args=(self._session,), name="zenoh", daemon=True)
        self._worker.start()

    def _open(self) -> zenoh.Session:
        settings = self._settings
        try:
            config = peer_config(
                settings.listen,
                settings.connect,
                tls=settings.tls.files() if settings.tls is not None else None,
                pose_rate_max_hz=settings.pose_rate_max_hz,
            )
            return zenoh.open(config)
        except zenoh.ZError as error:
            if taken := re.search(r"(:\d+): Address already in use", str(error)):
                endpoints = " or ".join(endpoint for endpoint in settings.listen if taken[1] in endpoint)
                raise LinkError(f"{endpoints} is in use: does another daemon run?") from error
            endpoints = ", ".join(settings.listen) or "none"
            raise LinkError(f"zenoh cannot listen on {endpoints}: {reason_of(error)}") from error

    def publish(self, report: Report) -> None:
        """Leave a report for the worker; one it has not taken yet is replaced and counted."""
        with self._waiting:
            self._counters["reports_replaced"] += self._mailbox.report is not None
            self._mailbox.report = report
            self._targets = {ros.target_name(track): track.track_id for track in report.tracks}
            self._waiting.notify()

    def publish_diagnostics(self, snapshot: HealthSnapshot) -> None:
        with self._waiting:
            self._mailbox.snapshot = snapshot
            self._waiting.notify()

    def publish_event(self, level: int, text: str) -> None:
        """`level` as in rcl_interfaces/Log: 10 debug, 20 info, 30 warn, 40 error, 50 fatal."""
        with self._waiting:
            self._counters["events_lost"] += len(self._mailbox.events) == EVENTS_WAITING
            self._mailbox.events.append((clock.monotonic_ns(), level, text))
            self._waiting.notify()

    def wants_picture(self) -> bool:
        """Whether pictures have a subscriber now."""
        publisher = self._picture_publisher
        try:
            return publisher is not None and publisher.matching()
        except zenoh.ZError:  # the worker has ended, which must not end the loop too
            return False

    def records_picture(self) -> bool:
        """Whether a recording is in progress."""
        return self._recorder is not None and self._recorder.recording

    def publish_picture(self, picture: Picture) -> None:
        """Queue a picture for the worker; if there are too many, the oldest is dropped and counted."""
        with self._waiting:
            self._counters["pictures_replaced"] += len(self._mailbox.pictures) == PICTURES_WAITING
            self._mailbox.pictures.append(picture)
            self._waiting.notify()

    def settle(self) -> None:
        """In lock-step mode: wait until everything queued is handed to zenoh. Raises LinkError on a timeout."""
        with self._waiting:
            idle = self._waiting.wait_for(lambda: self._mailbox.empty() and not self._delivering, SETTLE_TIMEOUT_S)
        if not idle:
            raise LinkError(f"zenoh: not sent within {SETTLE_TIMEOUT_S:.0f} s")

    def stop(self) -> None:
        """Send what is queued, then close the session. May be called twice, or without start."""
        with self._waiting:
            self._mailbox.stopping = True
            self._waiting.notify()
        if self._worker is not None:
            self._worker.join(STOP_TIMEOUT_S)
            self._worker = None
        if self._session is not None:
            # An open session keeps the process from exiting; a (daemon) thread that is still closing it does not.
            closer = threading.Thread(target=self._session.close, name="closing", daemon=True)
            closer.start()
            closer.join(CLOSE_TIMEOUT_S)
            self._session = None

    @property
    def session(self) -> zenoh.Session | None:
        """Open between start and stop, if zenoh is enabled."""
        return self._session

    def counters(self) -> dict[str, int]:
        with self._waiting:
            return {**self._counters, "links": self._links}

    def _take(self) -> Mailbox:
        with self._waiting:
            self._waiting.wait_for(lambda: self._mailbox.stopping or not self._mailbox.empty())
            taken, self._mailbox = self._mailbox, Mailbox(stopping=self._mailbox.stopping)
            self._delivering = True
            return taken

    def _work(self, session: zenoh.Session | None) -> None:
        with ExitStack() as stack:
            node: Node | None = None
            if session is not None:
                domain, distribution = self._settings.domain, self._settings.ros_distribution
                node = stack.enter_context(Node(session, self._vehicle_name, domain=domain, distribution=distribution))
                token = session.liveliness().declare_token(topics.alive_token(self._vehicle_name))
                stack.enter_context(token)
            desk = Desk(node, self._recorder, self._vehicle_name, self._mount, self._settings.max_age_ms)
            if self._settings.image_max_hz > 0:
                self._picture_publisher = desk.open_pictures()
            if session is not None and self._settings.commands:
                request = self._requests.put if self._requests is not None else None
                actions = Actions(request, self._recorder, desk.set_pose_rate, self._reload, lambda: self._targets)
                stack.enter_context(declare_commands(session, self._vehicle_name, actions))
            while True:
                mail = self._take()
                counted = self._deliver(desk, mail)
                links = 0 if session is None else len([*session.info.routers_zid(), *session.info.peers_zid()])
                with self._waiting:
                    self._links = links
                    self._counters.update(counted)
                    self._delivering = False
                    self._waiting.notify_all()
                    if mail.stopping and self._mailbox.empty():
                        return

    def _deliver(self, desk: Desk, mail: Mailbox) -> Counter[str]:
        """Send each item independently: one that fails, for whatever reason, stops neither the link nor the others.

        What was seen before the computer slept is not sent.
        """
        puts: list[Callable[[], None]] = []
        if self._sleep.slept_ns():
            desk.counted["too_late"] += (mail.report is not None) + len(mail.pictures)
            mail.report = None
            mail.pictures.clear()
        if mail.report is not None:
            puts.append(partial(desk.put_report, mail.report))
        if mail.snapshot is not None:
            puts.append(partial(desk.put_diagnostics, mail.snapshot))
        puts += [partial(desk.put_event, *event) for event in mail.events]
        puts += [partial(desk.put_picture, picture) for picture in mail.pictures]
        for put in puts:
            try:
                put()
            except Exception as error:
                desk.counted["failed"] += 1
                log.warning("zenoh: not published: %r", error)
        counted, desk.counted = desk.counted, Counter()
        return counted


class Desk:
    """Converts reports and events to messages for publishers and recorder; used by the worker only."""

    def __init__(
        self, node: Node | None, recorder: Recorder | None, vehicle_name: str, mount: Mount, max_age_ms: float
    ) -> None:
        self.counted: Counter[str] = Counter()
        self._node = node
        self._recorder = recorder
        self._vehicle_name = vehicle_name
        self._mount = mount
        self._max_age_ms = max_age_ms
        self._clock = UtcClock()
        self._exposures: dict[int, int] = {}  # UTC of the last ones, by monotonic time
        self._publishers: dict[tuple[str, str | None], TopicPublisher] = {}
        self._intrinsics: tuple[bytes, tuple[int, int], tuple[float, ...]] | None = None
        self._pose_rates: defaultdict[tuple[str, str | None], Rate] | None = None  # None: no limit
        shared = (topics.DETECTIONS, topics.TF, topics.CAMERA_INFO, topics.DIAGNOSTICS, topics.EVENTS)
        if node is not None:
            for topic in shared:
                self._publisher(node, topic, None)

    def set_pose_rate(self, max_hz: float | None) -> None:
        """Limit the rate of each target's poses, odometry and directions; None: no limit. Recordings are not limited.
        May be called from any thread."""
        self._pose_rates = None if max_hz is None else defaultdict(partial(Rate, max_hz))

    def put_report(self, report: Report) -> None:
        stamp_ns = self._exposed_ns(report.meta.capture_ns)
        now_ns = clock.monotonic_ns()
        tracks = sendable(report, now_ns, self._max_age_ms)
        unranged = rangeless(report, now_ns, self._max_age_ms)
        self.counted["tracks_withheld"] += len(report.tracks) - len(tracks) - len(unranged)
        max_age_ns = round(self._max_age_ms * NS_PER_MS)
        for track in tracks:
            name, until_ns = ros.target_name(track), track.measured_ns + max_age_ns
            self._put(topics.POSE, ros.pose(track, stamp_ns), name, until_ns)
            if report.own_ship is not None:
                odometry = ros.odometry(track, report.own_ship, stamp_ns)
                if odometry is not None:
                    self._put(topics.ODOM, odometry, name, until_ns)
        for track in unranged:
            until_ns = track.measured_ns + max_age_ns
            self._put(topics.DIRECTION, ros.direction(track, stamp_ns), ros.target_name(track), until_ns)
        until_ns = report.meta.capture_ns + max_age_ns
        self._put(topics.DETECTIONS, ros.detections(tracks, stamp_ns), until_ns=until_ns)
        if report.own_ship is not None:
            self._put(topics.TF, ros.transforms(report.own_ship, self._mount, stamp_ns), until_ns=until_ns)
        intrinsics = (np.asarray(report.K).tobytes(), report.image_size_wh, report.distortion)
        if intrinsics != self._intrinsics:
            self._put(topics.CAMERA_INFO, ros.camera_info(report, stamp_ns))
            self._intrinsics = intrinsics

    def put_diagnostics(self, snapshot: HealthSnapshot) -> None:
        stamp_ns = self._clock.utc_ns(snapshot.time_ns)
        self._put(topics.DIAGNOSTICS, ros.diagnostics(snapshot, self._vehicle_name, stamp_ns))

    def open_pictures(self) -> TopicPublisher | None:
        """Declare the publisher of pictures; None without a node."""
        return None if self._node is None else self._publisher(self._node, topics.IMAGE, None)

    def put_picture(self, picture: Picture) -> None:
        stamp_ns = self._exposed_ns(picture.capture_ns)
        payload = CompressedImage(stamp_ns, topics.FRAME_CAMERA, "jpeg", picture.jpeg).encode()
        if picture.recorded and self._recorder is not None:
            self._recorder.record(topics.IMAGE, self._vehicle_name, None, payload, clock.utc_ns())
        if picture.live and self._node is not None:
            self._publisher(self._node, topics.IMAGE, None).put(payload)
            self.counted["sent_image"] += 1

    def _exposed_ns(self, capture_ns: int) -> int:
        """UTC of an exposure. A frame's picture has the same stamp as its poses, unless UTC was stepped in between."""
        stamp_ns = self._clock.utc_ns(capture_ns)
        told_ns = self._exposures.get(capture_ns, stamp_ns)
        if abs(told_ns - stamp_ns) <= UTC_SET_NS:
            stamp_ns = told_ns
        self._exposures[capture_ns] = stamp_ns
        while len(self._exposures) > EXPOSURES_KEPT:
            del self._exposures[next(iter(self._exposures))]
        return stamp_ns

    def put_event(self, time_ns: int, level: int, text: str) -> None:
        self._put(topics.EVENTS, Log(self._clock.utc_ns(time_ns), level, topics.NODE_NAME, text))

    def _put(self, topic: Topic, message: Payload, target: str | None = None, until_ns: int | None = None) -> None:
        """`until_ns` (monotonic): the message is dropped if it is later than that, as after a stall of the process."""
        payload = message.encode()
        if until_ns is not None and clock.monotonic_ns() > until_ns:
            self.counted["too_late"] += 1
            return
        if self._recorder is not None and topic.recorded:
            self._recorder.record(topic, self._vehicle_name, target, payload, clock.utc_ns())
        if self._node is not None and self._due(topic, target):
            self._publisher(self._node, topic, target).put(payload)
            self.counted[f"sent_{topic.name.rpartition('/')[2]}"] += 1

    def _due(self, topic: Topic, target: str | None) -> bool:
        rates = self._pose_rates
        return rates is None or not topic.per_target or rates[topic.name, target].due(clock.monotonic_ns())

    def _publisher(self, node: Node, topic: Topic, target: str | None) -> TopicPublisher:
        key = (topic.name, target)
        if key not in self._publishers:
            if clock.stepped():  # the player waits for all outputs of a frame: none may be dropped for congestion
                topic = replace(topic, reliability=Reliability.RELIABLE, congestion=CongestionControl.BLOCK)
            self._publishers[key] = node.publisher(topic, target)
        return self._publishers[key]
