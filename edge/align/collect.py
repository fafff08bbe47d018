"""Watches camera and autopilot while the vehicle is turned."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np

from edge.align.attitudes import AttitudeLog, Attitudes
from edge.align.fit import AXES, LATE_RANGE_S, UnknownError
from edge.align.turns import Sight, TurnTracker
from edge.cameras import open_source
from edge.cameras.capture import Capture
from edge.cameras.own_ship_mask import load_own_parts
from edge.cameras.source import EndOfStream
from edge.config import ConfigFile, camera_key
from edge.doctor_links import ADVICE_AUTOPILOT, running_daemon
from edge.errors import InputError
from edge.estimator.own_parts import OwnParts
from edge.health import Activity, Condition, HealthState
from edge.links.mavlink_link import MavlinkLink, signing_of
from edge.requests import RequestQueue
from msgs.command_line import say_aside

NOW = "pictures and attitude come: turn the vehicle now, to and fro about all three axes, unevenly; Ctrl-C ends it"
FIRST_S = 12.0  # without a picture or an attitude for so long, there will be none
LOOK_S = 0.2
TOLD_S = 0.5
# Attitudes of the last pictures may come later than these.
AFTERWARDS_S = 0.2 - LATE_RANGE_S[0]


@dataclass(frozen=True)
class Collected:
    """What was seen."""

    camera: str
    sights: list[Sight]
    attempts: int  # as of TurnTracker
    attitudes: Attitudes
    counters: Mapping[str, int]  # of Capture


def collect(file: ConfigFile, seconds: float, until: Callable[[], threading.Event]) -> Collected:
    """Watch for so long from when both pictures and attitudes come, or until the event of `until` or the end of a
    recording. `until` is called once the camera is open, which Ctrl-C is to interrupt.

    Raises InputError for what cannot be measured as configured, UnknownError if nothing comes.
    """
    config = file.config
    with file.blame("camera", "mount"):
        if config.camera.mount == "gimbal":
            raise InputError("a camera on a gimbal does not turn with the vehicle; only fixed ones can be aligned")
    with file.blame("mavlink", "enabled"):
        if not config.mavlink.enabled:
            raise InputError("the autopilot's attitude is needed, which comes by MAVLink")
    if (answer := running_daemon(config)) is not None:
        raise InputError(
            f"a daemon is running (process {answer['info']['pid']}), which uses camera and autopilot: stop it first "
            "(`sudo systemctl stop uavpose-edge`)"
        )
    log = AttitudeLog()
    with ExitStack() as cleanup:
        with file.blame(*camera_key(config.camera)):
            source, info, opened = open_source(config.camera)
            capture = Capture(source, opened)
            cleanup.callback(capture.stop)
            own_parts = load_own_parts(config.camera, info.image_size_wh)
        with file.blame("mavlink", "endpoints"):
            link = MavlinkLink(config.mavlink, log, info, RequestQueue(), signing_of(config.mavlink))
            cleanup.callback(link.stop)
            link.start()
        capture.start()
        with file.blame(*camera_key(config.camera)):
            tracker = TurnTracker(config.camera.readout_ms * 1e-3)
            sights = _watch(capture, tracker, own_parts, link, log, seconds, until())
        return Collected(info.name, sights, tracker.attempts, log.attitudes(), capture.counters())


def _watch(
    capture: Capture,
    tracker: TurnTracker,
    own_parts: OwnParts | None,
    link: MavlinkLink,
    log: AttitudeLog,
    seconds: float,
    stop: threading.Event,
) -> list[Sight]:
    sights = list[Sight]()
    seen, begun_s, told_s, opened_s = False, None, 0.0, time.monotonic()
    while not stop.is_set():
        # Heartbeats: a router, or an autopilot, may send to nobody who has not spoken first.
        link.set_health(Condition(HealthState.INIT, Activity.WAITING))
        try:
            frame = capture.newest(LOOK_S)
        except EndOfStream:
            break
        now_s = time.monotonic()
        if begun_s is None:
            seen = seen or frame is not None
            if seen and log.heard:
                begun_s = now_s
                say_aside(NOW)
            elif now_s - opened_s > FIRST_S:
                break
        elif now_s - begun_s >= seconds:
            break
        elif now_s - told_s >= TOLD_S:
            told_s = now_s
            _tell(now_s - begun_s, seconds, log, len(sights))
        if frame is not None and begun_s is not None:
            sight = tracker.take(replace(frame, own_parts=own_parts))
            sights += [] if sight is None else [sight]
    if begun_s is None:
        raise UnknownError(_nothing_came(seen, capture))
    if sys.stderr.isatty():
        say_aside("")
    time.sleep(AFTERWARDS_S)
    return sights


def _nothing_came(seen: bool, capture: Capture) -> str:
    if seen:
        return f"no attitude came: {ADVICE_AUTOPILOT}; `uavpose-edge doctor` tests the link"
    said = "".join(f": {one.text}" for one in capture.reasons(time.monotonic_ns()))
    return f"no picture came{said}; `uavpose-edge doctor` tests the camera"


def _tell(passed_s: float, seconds: float, log: AttitudeLog, spans: int) -> None:
    """One line, on a terminal only, that is written over."""
    if sys.stderr.isatty():
        turned_deg = np.rad2deg(log.attitudes().turned_rad())
        turned = ", ".join(f"{axis} {deg:.0f}°" for axis, deg in zip(AXES, turned_deg, strict=True))
        told = f"{passed_s:.0f} of {seconds:.0f} s: turned {turned}; {spans} turns seen by the camera "
        print(f"\r{told}", end="", file=sys.stderr, flush=True)
