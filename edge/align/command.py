"""The `align` sub-command of `uavpose-edge`: options and output."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.errors import InputError
from msgs.command_line import say_out

if TYPE_CHECKING:
    from edge.align.fit import Alignment
    from edge.config import ConfigFile

SECONDS = 30.0
SECONDS_MAX = 120.0  # the fit of more would take minutes on a small computer
FOCAL_OFF_MAX = 0.05
CLOCK_SURE_MAX_MS = 10.0  # of the attitudes' stamps; more is told
STEEP_DEG = 85.0  # of pitch, from where roll and yaw are hardly told apart: a matrix is given instead


def register(commands: argparse._SubParsersAction) -> None:
    align = commands.add_parser(
        "align",
        help="measure how the camera is mounted and how late its stamps are, while the vehicle is turned",
        description="Compares how the camera sees the scene turn with the autopilot's attitude. Let the camera see a "
        "far scene full of detail, and turn the vehicle to and fro about all three axes, by 20° and more, unevenly. "
        "Prints the lines for the configuration. Ctrl-C ends the turning early. Exit codes: 0 all is known and the "
        "focal length fits, 1 not, 2 bad input.",
    )
    align.add_argument("--config", type=Path, required=True, help="TOML file")
    align.add_argument("--seconds", type=float, default=SECONDS, help=f"how long to watch (default {SECONDS:g})")
    align.add_argument("--json", action="store_true", help="print one JSON object instead of text")
    align.set_defaults(act=run)


def run(options: argparse.Namespace) -> int:
    """Returns the exit code. Raises InputError."""
    if not 1.0 <= options.seconds <= SECONDS_MAX:
        raise InputError(f"--seconds {options.seconds:g}: must be from 1 to {SECONDS_MAX:g}")
    from edge.align.collect import collect
    from edge.align.fit import UnknownError, align
    from edge.config import load_config
    from edge.doctor import shortfalls
    from msgs.signals import stop_on_signals

    file = load_config(options.config)
    try:
        collected = collect(file, options.seconds, stop_on_signals)
        notes = [text for _, text in shortfalls(collected.counters, None, None)]
        found = align(collected.sights, collected.attempts, collected.attitudes)
    except UnknownError as error:
        say_out(json.dumps({"well": False, "unknown": [str(error)]}) if options.json else f"nothing is known: {error}")
        return 1
    tree = to_tree(found, file)
    say_out(json.dumps(tree | {"notes": notes}) if options.json else "\n".join(report(found, tree, notes, file)))
    return 0 if tree["well"] else 1


def to_tree(found: Alignment, file: ConfigFile) -> dict[str, Any]:
    """What is known, beside what is configured; half widths of 95 % as `sure`."""
    import numpy as np

    from edge.align.fit import AXES, mount_angles_rad
    from msgs.geometry import rotation_angle

    config = file.config
    configured = config.mount.mount().R_body_cam
    angles = {"configured": mount_angles_rad(configured), "measured": mount_angles_rad(found.R_body_cam)}
    degrees = {name: dict(zip(AXES, np.rad2deg(of).tolist(), strict=True)) for name, of in angles.items()}
    latency_ms = getattr(config.camera, "latency_ms", 0.0)
    measured_ms, sure_ms = latency_ms + 1e3 * found.late_s, 1e3 * found.late_sure_s
    mount = {
        **{f"{axis}_deg": deg for axis, deg in degrees["measured"].items()},
        "sure_deg": dict(zip(AXES, np.rad2deg(found.angles_sure_rad).tolist(), strict=True)),
        "R_body_cam": found.R_body_cam.tolist(),
        "configured_deg": degrees["configured"],
        "apart_deg": float(np.rad2deg(rotation_angle(configured, found.R_body_cam))),
        "apart_sure_deg": float(np.rad2deg(found.mount_sure_rad)),
    }
    latency = {
        "ms": measured_ms,
        "sure_ms": sure_ms,
        "of_attitude_ms": 1e3 * found.clock_sure_s,
        "configured_ms": latency_ms,
    }
    off = abs(found.focal_ratio - 1.0)
    focal = {
        "ratio": found.focal_ratio,
        "sure": found.focal_sure,
        "fits": off <= max(FOCAL_OFF_MAX, found.focal_sure),
    }
    known = {"mount": mount, "latency": latency, "focal": focal}
    return {
        "well": not found.wanting and bool(focal["fits"]) and measured_ms >= -sure_ms,
        **{name: None if name in found.wanting else value for name, value in known.items()},
        "unknown": list(found.wanting.values()),
        "turns": found.spans,
        "turned_deg": dict(zip(AXES, np.rad2deg(found.turned_rad).tolist(), strict=True)),
    }


def report(found: Alignment, tree: dict[str, Any], notes: list[str], file: ConfigFile) -> Iterator[str]:
    """The lines for a person."""
    turned = ", ".join(f"{axis} {deg:.0f}°" for axis, deg in tree["turned_deg"].items())
    yield f"{tree['turns']} turns of camera and vehicle compared; in all {turned}. ±: 95 %"
    yield from (f"note: {note}" for note in notes)
    if (mount := tree["mount"]) is not None:
        sure = mount["sure_deg"]
        measured = ", ".join(f"{axis} {mount[f'{axis}_deg']:.2f} ± {sure[axis]:.2f}°" for axis in sure)
        configured = ", ".join(f"{axis} {deg:.2f}°" for axis, deg in mount["configured_deg"].items())
        apart = f"{mount['apart_deg']:.2f} ± {mount['apart_sure_deg']:.2f}° apart"
        yield f"mount: {measured}; configured: {configured}; {apart}"
    if (latency := tree["latency"]) is not None:
        yield f"latency: {latency['ms']:.1f} ± {latency['sure_ms']:.1f} ms; configured: {latency['configured_ms']:g} ms"
        if latency["of_attitude_ms"] > CLOCK_SURE_MAX_MS:
            yield (
                f"note: the autopilot's stamps are known to ± {latency['of_attitude_ms']:.0f} ms only, as it does not "
                "answer TIMESYNC, or late; the latency fits them while its link stays as it is"
            )
    if (focal := tree["focal"]) is not None:
        told = f"focal length: {focal['ratio']:.3f} ± {focal['sure']:.3f} times the configured one"
        yield (
            f"{told}: it fits"
            if focal["fits"]
            else f"{told}: it does not fit, so ranges are wrong: calibrate anew, if all that was seen is far"
        )
    yield from tree["unknown"]
    lines = [*_mount_lines(found, tree, file), *_latency_lines(tree, file)]
    if lines:
        yield f"for {file.path}:"
        yield from lines


def _mount_lines(found: Alignment, tree: dict[str, Any], file: ConfigFile) -> Iterator[str]:
    mount = tree["mount"]
    if mount is None:
        return
    yield "[mount]"
    if file.config.mount.R_body_cam is not None or abs(mount["pitch_deg"]) > STEEP_DEG:
        yield "R_body_cam = [" + ", ".join(f"[{x:.5f}, {y:.5f}, {z:.5f}]" for x, y, z in found.R_body_cam) + "]"
    else:
        yield from (f"{axis}_deg = {mount[f'{axis}_deg']:.2f}" for axis in ("roll", "pitch", "yaw"))


def _latency_lines(tree: dict[str, Any], file: ConfigFile) -> Iterator[str]:
    latency, kind = tree["latency"], file.config.camera.type
    if latency is None:
        return
    if latency["ms"] < -latency["sure_ms"]:
        yield (
            f"# stamps are {-latency['ms']:.1f} ms earlier than the exposure, by the attitude's clock, and no "
            "latency_ms mends that: the camera's clock is slow, or the attitude is late (no TIMESYNC, a slow filter)"
        )
    elif not hasattr(file.config.camera, "latency_ms"):
        yield f'# a camera of type "{kind}" has no latency_ms'
    else:
        yield "[camera]"
        yield f"latency_ms = {max(latency['ms'], 0.0):.1f}"
