"""The daemon: newest frame → own ship at its exposure → where targets should be → poses → tracks → the links.

| thread     | does                                             | never waits for   |
|------------|--------------------------------------------------|-------------------|
| main       | the loop below                                   | links, camera     |
| capture    | reads the camera, keeps the newest frame         | the loop          |
| link's own | sends the newest report, hears the autopilot     | the loop          |
"""

from __future__ import annotations

import gc
import logging
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack

import numpy as np

from edge.cameras import open_source
from edge.cameras.capture import Capture
from edge.cameras.source import EndOfStream
from edge.config import Config, ConfigFile, camera_key
from edge.estimator.estimator import Estimator
from edge.estimator.model import Model, load_model
from edge.health import Announcer, Health, HealthSnapshot
from edge.outlets import Outlets, start_outlets
from edge.requests import RequestQueue, StopTracking
from edge.tracking.by_hand import ByHand
from edge.tracking.own_ship import OwnShipBuffer
from edge.tracking.tracker import Tracker
from edge.types import Array, CameraInfo, Estimate, Frame, FrameMeta, OwnShip, Report, Track, TrackState

log = logging.getLogger(__name__)

TICK_S = 0.1
SNAPSHOT_PERIOD_NS = 1_000_000_000


def run(file: ConfigFile, stop: threading.Event) -> int:
    """Fly until `stop` is set or the recording ends; 0. Raises InputError for what a person can mend."""
    config = file.config
    with ExitStack() as cleanup:
        with file.blame("model", "path"):
            model = load_model(config.model.path, config.model.threads, config.model.spinning)
            model.warm_up()
        with file.blame(*camera_key(config.camera)):
            source, camera_info, opened = open_source(config.camera)
        capture = Capture(source, opened)
        cleanup.callback(capture.stop)
        own_ship = OwnShipBuffer(gimballed=config.camera.mount == "gimbal")
        requests = RequestQueue()
        outlets = start_outlets(file, own_ship, camera_info, requests, cleanup)
        pipeline = Pipeline(config, model, own_ship, outlets, capture, requests)
        pipeline.warm_up(camera_info)
        # What lives by now lives to the end: the collector need not walk it between frames.
        gc.collect()
        gc.freeze()
        log.info("ready: %s (%s), camera %s", model.contract.name, model.contract.precision, camera_info.name)
        capture.start()
        with file.blame(*camera_key(config.camera)):
            pipeline.fly(stop)
    # With the links stopped, their counts are whole.
    log.info("stopped: %s", pipeline.snapshot().line())
    return 0


class Pipeline:
    """One frame at a time through the stages, and once a second word of how it goes."""

    def __init__(
        self,
        config: Config,
        model: Model,
        own_ship: OwnShipBuffer,
        outlets: Outlets,
        capture: Capture,
        requests: RequestQueue,
    ) -> None:
        self._model = model
        self._own_ship = own_ship
        self._outlets = outlets
        self._capture = capture
        self._requests = requests
        self._by_hand = ByHand()
        self._acquire_every_n = config.estimator.acquire_every_n
        self._max_targets = config.estimator.max_targets
        self._estimator = Estimator(model, config.estimator.max_targets)
        self._tracker = Tracker(config.estimator.max_targets, config.mount.mount())
        self._health = Health(wants_attitude=config.mavlink.enabled)
        self._since_acquire = 0
        self._out_of_order = 0
        self._announcer = Announcer()
        self._snapshot_due_ns = 0

    def warm_up(self, camera: CameraInfo) -> None:
        """Estimate on a black picture: first calls allocate, and should not cost a frame."""
        width, height = camera.image_size_wh
        black = np.zeros((height, width, 3), dtype=np.uint8)
        self._estimator.warm_up(Frame(FrameMeta(0, 0, 0), black, camera.K))

    def fly(self, stop: threading.Event) -> None:
        """The loop. Returns when `stop` is set or the recording is over. Raises InputError from the camera."""
        while not stop.is_set():
            try:
                frame = self._capture.newest(TICK_S)
            except EndOfStream:
                return
            if frame is not None:
                self._process(frame)
            self._supervise()

    def snapshot(self) -> HealthSnapshot:
        counters = {
            **self._capture.counters(),
            "out_of_order": self._out_of_order,
            **{f"refused_{reason}": count for reason, count in self._estimator.refused.items()},
            "refused_by_tracker": self._tracker.not_finite,
            **self._outlets.counters(),
        }
        return self._health.snapshot(time.monotonic_ns(), counters)

    def _process(self, frame: Frame) -> None:
        if self._tracker.is_late(frame.meta.capture_ns):
            # The tracks are valid at a later time than this frame's: told with its stamp they would be wrong.
            self._out_of_order += 1
            return
        clock = StageClock(frame.meta.capture_ns)
        clock.lap("wait")
        capture_ns, size_wh = frame.meta.capture_ns, (frame.image_bgr.shape[1], frame.image_bgr.shape[0])
        own_ship = self._own_ship.at(capture_ns)
        self._take_requests(capture_ns)
        expected = self._tracker.predict(capture_ns, own_ship, frame.K, size_wh)
        pointed_at = self._by_hand.box_xyxy_px(capture_ns, size_wh, expected)
        estimates = self._estimate(frame, expected, pointed_at, clock.lap)
        tracks = self._tracker.update(capture_ns, estimates, own_ship, frame.K, size_wh)
        self._by_hand.settle(tracks)
        for text in self._by_hand.news():
            self._outlets.event(logging.INFO, text)
        clock.lap("filter")
        self._publish(frame, size_wh, tracks, own_ship)
        clock.lap("publish")
        self._health.frame_done(
            frame.meta.sequence, clock.stages_ns(), tracks, own_ship is not None, time.monotonic_ns()
        )

    def _take_requests(self, capture_ns: int) -> None:
        for request in self._requests.take():
            self._by_hand.take(request, capture_ns)
            if isinstance(request, StopTracking):
                self._tracker.drop_all()

    def _estimate(
        self, frame: Frame, expected: list[Track], pointed_at: Array | None, lap: Callable[[str], None]
    ) -> list[Estimate]:
        found: list[Estimate] = []
        boxes = [track.box_xyxy_px for track in expected]
        if self._estimator.has_track_stage and (expected or pointed_at is not None):
            seen = self._estimator.track(frame, boxes if pointed_at is None else [*boxes, pointed_at])
            if pointed_at is not None and (there := seen[-1]) is not None:
                self._by_hand.found(there)
                self._tracker.make_room()
            found = [estimate for estimate in seen if estimate is not None]
            lap("track")
        self._since_acquire += 1
        nothing_tracked = all(track.state is TrackState.COASTING for track in expected)
        another_due = self._since_acquire >= self._acquire_every_n and len(expected) < self._max_targets
        wanted = nothing_tracked or another_due or not self._estimator.has_track_stage
        if wanted and self._by_hand.searches(frame.meta.capture_ns):
            found += self._estimator.acquire(frame, [estimate.box_xyxy_px for estimate in found])
            self._since_acquire = 0
            lap("acquire")
        return found

    def _publish(
        self, frame: Frame, size_wh: tuple[int, int], tracks: tuple[Track, ...], own_ship: OwnShip | None
    ) -> None:
        report = Report(
            frame.meta, frame.K, size_wh, tracks, own_ship, self._model.sha256, chosen_id=self._by_hand.chosen_id
        )
        self._outlets.publish(report)

    def _supervise(self) -> None:
        """Tell the links how the daemon is: its state at every turn, changes as events, counters once a second."""
        now_ns = time.monotonic_ns()
        state, reasons = self._health.assess(now_ns)
        self._outlets.set_health(state)
        if self._announcer.due(state, now_ns):
            self._outlets.tell(state, f"{state.value}: {'; '.join(reasons)}" if reasons else state.value)
        if now_ns >= self._snapshot_due_ns:
            self._snapshot_due_ns = now_ns + SNAPSHOT_PERIOD_NS
            snapshot = self.snapshot()
            log.info("%s", snapshot.brief())
            self._outlets.publish_diagnostics(snapshot)


class StageClock:
    """Laps of one frame from its exposure on."""

    def __init__(self, capture_ns: int) -> None:
        self._start_ns = self._last_ns = capture_ns
        self._stages_ns: dict[str, int] = {}

    def lap(self, stage: str) -> None:
        now_ns = time.monotonic_ns()
        self._stages_ns[stage] = now_ns - self._last_ns
        self._last_ns = now_ns

    def stages_ns(self) -> dict[str, int]:
        """Nanoseconds by stage, and from exposure to the last lap as `total`."""
        return {**self._stages_ns, "total": self._last_ns - self._start_ns}
