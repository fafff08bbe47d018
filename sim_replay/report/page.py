"""report.html: one self-contained file with a flight's score and plots."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined, select_autoescape
from markupsafe import Markup

from edge.config import MavlinkSettings
from sim_replay.ground_truth import PlayedSequence
from sim_replay.play import Recording
from sim_replay.report import plots
from sim_replay.report.moments import film, jpeg_url, worst_moments
from sim_replay.report.plots import HealthSample
from sim_replay.result import PEERS, Result, drops_told, told_ages

TEMPLATE = "report.html.j2"
_POSTER_WIDTH_PX = 960


def report_html(sequence: PlayedSequence, result: Result, score: dict[str, Any], drawn: Path) -> str:
    """The page. `drawn` contains overlay.mp4 and overlay.png. Raises InputError on an unreadable image."""
    environment = Environment(
        loader=PackageLoader("sim_replay.report", "."),
        autoescape=select_autoescape(default=True),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["figure"] = _figure
    matches = result.subscriber.matches
    frames, fps, unrecorded = len(sequence.scene.images), sequence.fps, sequence.scene.unrecorded
    video, stills = film(drawn / "overlay.mp4")
    received = zip(PEERS, (result.subscriber, result.autopilot), strict=True)
    ages = {name: told_ages(peer, result.recording) for name, peer in received}
    svg = {
        "pose": plots.pose_over_time(matches, frames, fps, unrecorded),
        "trajectory": plots.trajectory(matches, sequence.scene),
        "ages": plots.ages(ages, fps),
        "timeline": plots.timeline(health_of(result.recording), matches, frames, fps, unrecorded),
        "range": plots.errors_over_range(matches),
    }
    return environment.get_template(TEMPLATE).render(
        score=score,
        peers=score["peers"],
        bands={name: band for name, band in score["by_range"].items() if band["targets"]},
        frames=frames,
        fps=fps,
        mavlink_hz=MavlinkSettings().target_relative_rate_hz,
        svg={name: Markup(text) for name, text in svg.items()},
        video=video,
        poster=_poster(drawn / "overlay.png"),
        stills=stills,
        moments=worst_moments(sequence, matches),
        spoken=spoken(health_of(result.recording)),
        drops=drops_told(sequence, score),
        score_json=json.dumps(score, indent=2),
    )


def health_of(recording: Recording) -> list[HealthSample]:
    """The daemon's diagnostics as received, seconds since frame 0."""
    samples = []
    for record in recording.diagnostics:
        headline, _, reasons = str(record["message"]).partition("; ")
        stamp_ns = int(record["stamp_utc_ns"]) - recording.utc_minus_monotonic_ns - recording.start_at_ns
        values = record["values"]
        rate, dropped = values.get("frame_rate_hz"), values.get("dropped")
        samples.append(
            HealthSample(
                stamp_ns * 1e-9,
                str(values.get("state", headline)),
                headline,
                reasons,
                None if rate is None else float(rate),
                None if dropped is None else int(dropped),
            )
        )
    return samples


def spoken(health: Sequence[HealthSample]) -> list[HealthSample]:
    """Those whose headline or reasons differ from a second before."""
    told = [(sample.headline, sample.reasons) for sample in health]
    changed = [sample for sample, (before, now) in zip(health[1:], pairwise(told), strict=True) if before != now]
    return [*health[:1], *changed]


def _poster(path: Path) -> str | None:
    """Image shown before the video is played; None if there is none."""
    image = cv2.imread(str(path))
    if image is None:
        return None
    scale = min(1.0, _POSTER_WIDTH_PX / image.shape[1])
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return jpeg_url(np.asarray(small, dtype=np.uint8))


def _figure(value: float | None, form: str = "{:.2f}", scale: float = 1) -> str:
    """A number as text; a dash if there is none. Uses the minus sign, not a hyphen."""
    return "–" if value is None else re.sub(r"^-", "−", form.format(scale * value))
