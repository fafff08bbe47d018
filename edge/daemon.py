"""The daemon: newest frame → own-ship state at its exposure → predicted targets → poses → tracks → links.

`run` sets up, `Pipeline.fly` is the loop. Threads are in `edge/threads.py`, stages in `edge/stages.py`; no other thread
ever blocks the loop.
"""

from __future__ import annotations

import gc
import logging
import threading
from collections import Counter
from contextlib import ExitStack, suppress
from dataclasses import replace

from edge.attention import Attention
from edge.cameras import FrameSupply, open_capture
from edge.cameras.own_ship_mask import load_own_parts
from edge.cameras.source import EndOfStream
from edge.clock import SleepWatch, monotonic_ns
from edge.config import ConfigFile, camera_key
from edge.errors import InputError
from edge.estimator.decode import lies_on
from edge.estimator.estimator import Estimator
from edge.estimator.own_parts import OwnParts
from edge.estimator.upright import up_in_cam
from edge.fixed_places import FixedPlaces
from edge.health import Reason
from edge.memory import MemoryKeeper
from edge.outlets import Outlets, start_outlets
from edge.picture_watch import PictureWatch
from edge.reload import Reloader, load_configured, warm_estimator
from edge.requests import RequestQueue, StopTracking
from edge.size_watch import SizeWatch
from edge.stages import StageClock
from edge.status_board import StatusBoard
from edge.supervisor import Supervisor
from edge.tracking.by_hand import ByHand
from edge.tracking.own_ship import OwnShipBuffer
from edge.tracking.rolling_shutter import RollingShutter
from edge.tracking.tracker import Tracker
from edge.tracking.view import View
from edge.types import Array, Estimate, Frame, OwnShip, Report, Track

log = logging.getLogger(__name__)

TICK_S = 0.1


def run(file: ConfigFile, stop: threading.Event, reloader: Reloader) -> int:
    """Run until `stop` is set or the recording ends; returns 0. Raises InputError for what the user can correct."""
    config = file.config
    with ExitStack() as cleanup:
        model = load_configured(file)
        with file.blame(*camera_key(config.camera)):
            capture, camera_info = open_capture(config.camera)
            own_parts = load_own_parts(config.camera, camera_info.image_size_wh)
        cleanup.callback(capture.stop)
        own_ship = OwnShipBuffer(gimballed=config.camera.mount == "gimbal")
        requests = RequestQueue()
        board = StatusBoard(file, model, camera_info)
        outlets = start_outlets(board, own_ship, requests, reloader.ask_for, cleanup)
        estimator = warm_estimator(model, config.estimator.max_targets, camera_info)
        estimator.target_size = config.target.size()
        pipeline = Pipeline(board, estimator, own_ship, outlets, capture, requests, reloader, own_parts)
        cleanup.callback(pipeline.search.stop)
        pipeline.search.start()
        # Objects that exist now live until exit: exclude them from garbage collection between frames.
        gc.collect()
        gc.freeze()
        memory = MemoryKeeper()
        cleanup.callback(memory.stop)
        memory.start()
        pipeline.ready()
        cleanup.callback(pipeline.supervisor.stopping)
        try:
            # In lock-step mode start() waits for the first step, before which the player may disconnect or `stop` be
            # set.
            with file.blame(*camera_key(config.camera)), suppress(EndOfStream):
                capture.start(outlets.settle, stop.is_set)
                pipeline.fly(stop)
        except Exception as error:
            # Sent before the links stop: who only misses the daemon does not know why.
            why = error if isinstance(error, InputError) else f"an error of its own: {error!r}"
            outlets.event(logging.ERROR, f"the daemon ends: {why}")
            raise
    # The links have stopped, so their counters are final.
    log.info("stopped: %s", pipeline.supervisor.snapshot().line())
    return 0


class Pipeline:
    """Processes one frame at a time through all stages and reports to the supervisor in every iteration."""

    def __init__(
        self,
        board: StatusBoard,
        estimator: Estimator,
        own_ship: OwnShipBuffer,
        outlets: Outlets,
        capture: FrameSupply,
        requests: RequestQueue,
        reloader: Reloader,
        own_parts: OwnParts | None = None,
    ) -> None:
        config = board.file.config
        self._board = board
        self._estimator = estimator
        self._own_ship = own_ship
        self._outlets = outlets
        self._capture = capture
        self._requests = requests
        self._reloader = reloader
        self._own_parts = self._own_parts_now = own_parts
        self._by_hand = ByHand()
        self._attention = Attention(config.estimator)
        self._sleep = SleepWatch()
        self._tracker = Tracker(config.estimator.max_targets, config.mount.mount())
        self._shutter = RollingShutter(round(config.camera.readout_ms * 1e6), config.mount.mount())
        wants_attitude = config.mavlink.enabled
        self._picture_watch, self._size_watch = PictureWatch(), SizeWatch()
        self._fixed_places = FixedPlaces(gimballed=config.camera.mount == "gimbal")
        self.supervisor = Supervisor(config.health, wants_attitude, outlets, board, self._counters, self._reasons)
        self.search = self._attention.search  # not started yet; until then each search runs in the caller's thread
        self._out_of_order = self._time_jumps = 0
        self._warned: tuple[str, ...] = ()  # of the model in use

    def ready(self) -> None:
        """Log and report that the daemon is ready, and what it lacks."""
        model = self._estimator.model
        name = f"{model.contract.name} ({model.contract.precision}) on {model.provider}"
        log.info("ready: %s, camera %s", name, self._board.camera.name)
        self._warn_of_model()
        self.supervisor.ready()

    def fly(self, stop: threading.Event) -> None:
        """The loop. Returns when `stop` is set or the recording is over. Raises InputError from the camera."""
        with self.supervisor.watchdog.armed():
            while not stop.is_set():
                try:
                    frame = self._capture.newest(TICK_S)
                except EndOfStream:
                    return
                if frame is not None:
                    self._process(frame)
                    self._warn_of_model()
                self.supervisor.turn()
                self._take_reload()

    def _counters(self) -> dict[str, int]:
        searched = Counter(self.search.counters())
        searched.update({f"refused_{reason}": count for reason, count in self._estimator.refused.items()})
        return {
            **self._capture.counters(),
            "out_of_order": self._out_of_order,
            **searched,
            "refused_by_tracker": self._tracker.not_finite,
            "refused_fixed_in_picture": self._fixed_places.refused,
            **self._outlets.counters(),
        }

    def _reasons(self, now_ns: int) -> tuple[Reason, ...]:
        seen = *self._picture_watch.reasons(), *self._fixed_places.reasons(now_ns), *self._size_watch.reasons(now_ns)
        return *self._capture.reasons(now_ns), *seen

    def _process(self, frame: Frame) -> None:
        if self._slept():
            return
        if frame.meta.time_jumps != self._time_jumps:
            self._time_jumps = frame.meta.time_jumps
            self._tracker.doubt_motion()
        if self._tracker.is_late(frame.meta.capture_ns):
            # The tracks are already valid for a later time; published with this frame's stamp they would be wrong.
            self._out_of_order += 1
            return
        clock = StageClock(frame.meta, monotonic_ns())
        capture_ns, size_wh = frame.meta.capture_ns, frame.size_wh
        own_ship = self._own_ship.at(capture_ns)
        frame = replace(frame, up_cam=up_in_cam(own_ship, self._tracker.mount))
        self._take_requests(capture_ns)
        expected = self._tracker.predict(capture_ns, own_ship, frame.K, size_wh, frame.distortion)
        pointed_at = self._by_hand.box_xyxy_px(capture_ns, size_wh, expected)
        clock.lap("track")
        self._picture_watch.seen(frame)
        estimates = self._estimate(frame, expected, pointed_at, own_ship, clock)
        chosen_id = self._by_hand.chosen_id
        doubtful_below = self._estimator.model.doubtful_below
        self._size_watch.seen(capture_ns, estimates, doubtful_below)
        tracks = self._tracker.update(
            capture_ns, estimates, own_ship, frame.K, size_wh, frame.distortion, chosen_id, doubtful_below
        )
        if self._slept():
            return
        self._by_hand.settle(tracks)
        for text in self._by_hand.news():
            self._outlets.event(logging.INFO, text)
        clock.lap("track")
        report = self._publish(frame, tracks, own_ship)
        clock.lap("publish")
        self.supervisor.frame_done(report, clock.stages_ns())

    def _slept(self) -> bool:
        """Whether the computer was suspended since the last check: frame, tracks and own-ship state are then stale."""
        slept_ns = self._sleep.slept_ns()
        if slept_ns == 0:
            return False
        self._tracker.drop_all()
        self._own_ship.clear(same_autopilot=True, until_ns=monotonic_ns())
        text = f"the computer has slept for {slept_ns / 1e9:.1f} s: all targets are forgotten"
        log.warning("%s", text)
        self._outlets.event(logging.WARNING, text)
        return True

    def _take_requests(self, capture_ns: int) -> None:
        for request in self._requests.take():
            self._by_hand.take(request, capture_ns)
            if isinstance(request, StopTracking):
                self._tracker.drop_all()
        if self._requests.too_late():
            self._outlets.event(logging.WARNING, "what was pointed at is too long ago: no frame came in time")

    def _estimate(
        self,
        frame: Frame,
        expected: list[Track],
        pointed_at: Array | None,
        own_ship: OwnShip | None,
        clock: StageClock,
    ) -> list[Estimate]:
        searches = self._by_hand.searches(frame.meta.capture_ns)
        seen = self._without_own_parts(frame)
        looked = self._attention.look(self._estimator, seen, expected, clock, searches=searches, pointed_at=pointed_at)
        height_px = frame.size_wh[1]
        looked = looked.each(lambda one: self._shutter.at_frame_time(one, own_ship, height_px, self._own_ship.at))
        view = View.of(frame.meta.capture_ns, own_ship, self._tracker.mount)
        estimates = self._fixed_places.without(frame, looked.estimates, view)
        if looked.there is not None and any(looked.there is one for one in estimates):
            self._by_hand.found(looked.there)
            if not lies_on(looked.there.box_xyxy_px, [track.box_xyxy_px for track in expected]):
                self._tracker.make_room(looked.there)  # a tracked target has its slot already
        return estimates

    def _without_own_parts(self, frame: Frame) -> Frame:
        if self._own_parts is None or self._own_parts_now is None:
            return frame
        if self._own_parts_now.size_wh != frame.size_wh:  # the camera has changed its mode
            # From the mask as it was: one that was made smaller has lost what is thin for good.
            self._own_parts_now = OwnParts.of(self._own_parts.covered, frame.size_wh)
        return replace(frame, image_bgr=self._own_parts_now.hide(frame.image_bgr), own_parts=self._own_parts_now)

    def _publish(self, frame: Frame, tracks: tuple[Track, ...], own_ship: OwnShip | None) -> Report:
        chosen_id, doubtful_below = self._by_hand.chosen_id, self._estimator.model.doubtful_below
        report = Report(
            frame.meta, frame.K, frame.size_wh, tracks, own_ship, chosen_id, frame.distortion, doubtful_below
        )
        self._outlets.publish(report)
        self._outlets.show(frame)
        return report

    def _take_reload(self) -> None:
        """Between two frames: switch to a newly loaded model and configuration; tracks are kept."""
        new = self._reloader.take(self._board.file, self._estimator, self._board.camera, self._outlets.event)
        if new is None:
            return
        resized = new.file.config.target != self._board.file.config.target
        if resized:
            self._size_watch = SizeWatch()
        replaced = new.estimator is not self._estimator
        if resized or replaced:
            self._tracker.doubt_ranges()
        if replaced:
            new.estimator.refused.update(self._estimator.refused)
        self._estimator, self._board.model, self._board.file = new.estimator, new.estimator.model, new.file
        self._reloader.switched()
        self._attention.acquire_every_n = new.file.config.estimator.acquire_every_n
        self._estimator.target_size = new.file.config.target.size()
        self.supervisor.apply(new.file.config.health)
        log.info("%s", new.outcome.said)
        self._outlets.event(logging.INFO, new.outcome.said)
        if replaced:
            self._warned = ()
            self._warn_of_model()

    def _warn_of_model(self) -> None:
        """Of what has not been said yet: its execution provider may fail in flight."""
        warnings = self._estimator.model.warnings
        for text in warnings:
            if text not in self._warned:
                log.warning("model: %s", text)
                self._outlets.event(logging.WARNING, f"model: {text}")
        self._warned = warnings
