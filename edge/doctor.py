"""`uavpose-edge doctor`: check everything the daemon needs on this machine, and advise on each fault."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from edge.cameras import open_source
from edge.cameras.capture import Capture
from edge.cameras.own_ship_mask import load_own_parts
from edge.cameras.source import EndOfStream
from edge.config import ConfigFile
from edge.doctor_links import (
    CAMERA_REASONS,
    STARTING,
    config_findings,
    is_starting,
    link_findings,
    running_daemon,
    told_reasons,
)
from edge.doctor_machine import machine_findings
from edge.errors import InputError
from edge.estimator.model import NOT_CALIBRATED, Model
from edge.findings import Finding, device_fault, good, poor, wrong
from edge.fixed_places import FIXED
from edge.health import percentiles_ms
from edge.picture_watch import DARK, WHITE, PictureWatch
from edge.reload import load_configured
from msgs.command_line import say_out

FRAME_S = 8.0
TIMED_RUNS = 10
LIVE_FRAMES = 20
WATCHED_S = 2.0  # at least: the first images of many cameras come irregularly
PERIOD_NS_MIN = 1_000_000  # no camera is faster
RATED_NS = 1_000_000_000  # less says little about the rate
RATE_SHARE_MIN, BAD_SHARE_MAX = 0.8, 0.1
DAMAGED = "camera_damaged"
STAMPS, UNSTAMPED, UNDECODABLE, SLOW = "camera_stamps", "camera_unstamped", "camera_undecodable", "camera_slow"
LATE = "camera_late"
# A busy machine may cause these too; there are images nevertheless.
USABLE = {STAMPS, LATE, UNSTAMPED, UNDECODABLE, SLOW, DARK.kind, WHITE.kind}
ADVICE = {  # by the kind of edge.health.Reason, or of a shortfall
    STAMPS: "see docs/cameras.md on timestamps; images that arrive in bursts also cause this",
    LATE: "see docs/cameras.md on timestamps; if its clock is not this computer's, keep both together by PTP",
    UNSTAMPED: "see docs/cameras.md on timestamps; arrival is later than exposure, so measure [camera] latency_ms",
    UNDECODABLE: "check cable, USB port or radio link; zenoh: also that images are JPEG or PNG with 8 bits a channel",
    SLOW: "ask for a rate and a format that the camera has, give it more light, or stop other programs",
    DAMAGED: 'set [camera] rtsp_transport = "tcp", or improve the link; with more key frames, a stream recovers sooner',
    DARK.kind: "take the cap off, give it light, or let it expose longer ([camera] exposure_ms, of a V4L2 device)",
    WHITE.kind: "let it expose less ([camera] exposure_ms, of a V4L2 device)",
    FIXED: "wipe the lens; hide parts of the own aircraft, and what is written into pictures: [camera] own_ship_mask",
    "camera_size": "set the camera to the mode that it was calibrated in, and start the daemon again",
    "camera_contested": "let only the camera publish on its topic, or give each camera a topic of its own",
    "camera_frozen": "point it at something that moves; if it stays frozen, unplug it and plug it in again",
}
ADVICE_CAMERA = "check that it is powered, plugged in and reachable from this computer"
ADVICE_NO_IMAGE = "check that it is powered, plugged in, not used by another program, and reachable from this computer"
ADVICE_NO_STREAM = (
    "check that it is on and reachable from this computer; with OPENCV_FFMPEG_LOGLEVEL=24 before this command, ffmpeg "
    "says what the server answers"
)


def doctor(file: ConfigFile, as_json: bool) -> int:
    """Print a line for each finding as it is made; 1 if something is wrong, else 0."""
    found = []
    for finding in findings(file):
        found.append(finding)
        if not as_json:
            say_out(finding.line())
    failed = [finding for finding in found if finding.verdict == "wrong"]
    if as_json:
        say_out(json.dumps({"well": not failed, "findings": [asdict(finding) for finding in found]}))
    else:
        say_out(f"{len(failed)} failed" if failed else "no check failed")
    return 1 if failed else 0


def findings(file: ConfigFile) -> Iterator[Finding]:
    """All checks in order; none raises because of what it finds."""
    yield from machine_findings(file.config)
    answer = running_daemon(file.config)
    running = None if answer is None else answer["info"]
    if answer is not None:
        yield from config_findings(file.config, answer["config"])
    frame_ms: float | None = None
    for finding, rate_hz in _camera(file) if running is None else camera_as_told(running):
        frame_ms = 1e3 / rate_hz if rate_hz else frame_ms
        yield finding
    yield from _model(file, frame_ms)
    yield from link_findings(file.config, running)


def camera_as_told(running: Mapping[str, Any]) -> Iterator[tuple[Finding, float | None]]:
    """Findings as reported by the running daemon: a camera serves one program at a time."""
    if is_starting(running):
        yield poor("camera", *STARTING), None
        return
    of_camera = [(kind, text) for kind, text in told_reasons(running) if kind.startswith(CAMERA_REASONS)]
    if of_camera:
        said = "; ".join(text for _, text in of_camera)
        yield wrong("camera", f"reported by the running daemon: {said}", _advice(of_camera)), None
        return
    rate_hz = running.get("frame_rate_hz")
    rate = f", {rate_hz:.0f} a second" if rate_hz else ""
    yield good("camera", f"{running['camera']}{rate} (reported by the running daemon)"), rate_hz


def _camera(file: ConfigFile) -> Iterator[tuple[Finding, float | None]]:
    """Open the camera as the daemon does and wait for pictures; with each finding the frame rate measured."""
    camera = file.config.camera
    device = getattr(camera, "device", None)
    if device is not None and (fault := device_fault(Path(device), "video")) is not None:
        yield wrong("camera", *fault), None
        return
    try:
        source, info, opened = open_source(camera)
        load_own_parts(camera, info.image_size_wh)
    except InputError as error:
        yield wrong("camera", str(error), "correct this in [camera]"), None
        return
    name = info.name
    capture = Capture(source, opened)
    watch = PictureWatch()
    capture.start()
    try:
        seen_ns, size_wh = _see_frames(capture, watch)
        reasons = [(one.kind, one.text) for one in (*capture.reasons(time.monotonic_ns()), *watch.reasons())]
        counters = capture.counters()
    except InputError as error:
        yield wrong("camera", str(error), "correct this in [camera]"), None
        return
    finally:
        capture.stop()
    if size_wh is None:
        said = "; ".join(text for _, text in reasons)
        not_there = ADVICE_NO_STREAM if camera.type == "stream" else ADVICE_NO_IMAGE
        advice = ADVICE[DAMAGED] if DAMAGED in dict(reasons) else not_there
        why = f": {said}" if said else ""
        yield wrong("camera", f"{name}: no image within {FRAME_S:.0f} s{why}", advice), None
        return
    # Stamps may all be the same, of a driver that gives whole seconds, but for new measurements of UTC, or jump back.
    took_ns = seen_ns[-1] - seen_ns[0]
    came = len(seen_ns) - 1 + counters["dropped_overtaken"]
    rate_hz = came / (took_ns / 1e9) if len(seen_ns) > 2 and took_ns > came * PERIOD_NS_MIN else None
    asked_hz = getattr(camera, "fps", None) if took_ns >= RATED_NS else None
    reasons += shortfalls(counters, rate_hz, asked_hz)
    rate = f", {rate_hz:.0f} a second" if rate_hz else ""
    text = f"{name}: {size_wh[0]}x{size_wh[1]}{rate}"
    if not reasons:
        yield good("camera", text), rate_hz
        return
    said = "; ".join(text for _, text in reasons)
    # A camera that is frozen or lost again gives no usable frames.
    bad = poor if all(kind in USABLE for kind, _ in reasons) else wrong
    yield bad("camera", f"{text}; {said}", _advice(reasons)), rate_hz


def shortfalls(counters: Mapping[str, int], rate_hz: float | None, asked_hz: float | None) -> Iterator[tuple[str, str]]:
    """Kind and text of each fault of a camera that gives images nevertheless. `counters`: of Capture; `asked_hz`: None
    if no rate is configured, or too little was seen to judge it."""
    captured = counters["captured"]
    unstamped, undecodable = counters.get("camera_unstamped", 0), counters.get("camera_undecodable", 0)
    if unstamped > BAD_SHARE_MAX * captured:
        yield UNSTAMPED, f"{unstamped} impossible timestamps replaced by the arrival time, {captured} images captured"
    if undecodable > BAD_SHARE_MAX * captured:
        yield UNDECODABLE, f"{undecodable} images could not be decoded, {captured} could"
    if rate_hz is not None and asked_hz is not None and rate_hz < RATE_SHARE_MIN * asked_hz:
        yield SLOW, f"[camera] fps is {asked_hz:g}, but only {rate_hz:.1f} a second arrive"


def _advice(reasons: Iterable[tuple[str, str]]) -> str:
    """Advice for the first of these kinds that has any."""
    return next((ADVICE[kind] for kind, _ in reasons if kind in ADVICE), ADVICE_CAMERA)


def _see_frames(capture: Capture, watch: PictureWatch) -> tuple[list[int], tuple[int, int] | None]:
    """Exposure times of the first frames received, and the size of the last; None: no frame. Raises InputError."""
    until_s, seen_ns, size_wh = time.monotonic() + FRAME_S, list[int](), None
    enough_s = until_s
    while (now_s := time.monotonic()) < until_s and (len(seen_ns) < LIVE_FRAMES or now_s < enough_s):
        try:
            frame = capture.newest(0.2)
        except EndOfStream:
            break
        if frame is not None:
            if not seen_ns:
                enough_s = time.monotonic() + WATCHED_S
            seen_ns.append(frame.meta.capture_ns)
            size_wh = frame.size_wh
            watch.seen(frame)
    return seen_ns, size_wh


def _model(file: ConfigFile, frame_ms: float | None) -> Iterator[Finding]:
    try:
        model = load_configured(file)
    except InputError as error:
        yield wrong("model", str(error), "set [model] path to a file written by `uavpose-trainer export`, or omit it")
        return
    if model.fallback_reason is not None:
        yield wrong("provider", model.fallback_reason, 'install what is missing, or set [model] provider = "cpu"')
    contract = model.contract
    if not contract.scores_calibrated:
        advice = "calibrate them by `uavpose-trainer calibrate-score`, on images it was not trained on"
        yield poor("scores", NOT_CALIBRATED, advice)
    sizes = {"acquire": contract.acquire_size_wh, "track": contract.track_size_wh}
    times = {stage: _time_ms(model, size) for stage, size in sizes.items() if size is not None}
    told = ", ".join(f"{stage} {ms:.1f} ms" for stage, ms in times.items())
    text = f"{contract.name} {contract.precision} {model.sha256[:12]} on {model.provider}: {told}"
    steady_ms = times.get("track", times["acquire"])
    if frame_ms is not None and steady_ms > frame_ms:
        advice = "lower [camera] fps, raise [model] threads, use the INT8 model, or stop other programs"
        yield poor("model", f"{text}; frames arrive every {frame_ms:.0f} ms", advice)
    else:
        yield good("model", text)


def _time_ms(model: Model, size_wh: tuple[int, int]) -> float:
    width, height = size_wh
    image = np.zeros((1, height, width, 3), dtype=np.uint8)
    K = np.array([[[float(width), 0.0, width / 2], [0.0, float(width), height / 2], [0.0, 0.0, 1.0]]])
    model.take_runs_ns()
    for _ in range(TIMED_RUNS):
        model.run(image, K)
    return percentiles_ms(end_ns - begin_ns for begin_ns, end_ns in model.take_runs_ns()).p50
