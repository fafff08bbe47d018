"""Plays a sequence with live output: a status line, a summary, score.json, an image and a video."""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.live import Live
from rich.progress import Progress
from rich.table import Table

from edge.estimator.model import load_model
from sim_replay.ground_truth import PlayedSequence
from sim_replay.offline import method_of
from sim_replay.play import PlaySettings, Record, Recording, play
from sim_replay.report.flight_files import RecordedFlight, remove_flight, write_flight
from sim_replay.report.write import write_report
from sim_replay.result import drops_told, frame_of_record, latency_ms, pose_of
from sim_replay.score import match_poses

BUNDLED_SEQUENCE = Path(__file__).parent / "data" / "crossing"
TOLD = ("pose", "direction")  # events of the subscriber
_RATE_WINDOW = 30
_PLAIN_PERIOD_S = 1.0


@dataclass
class LiveFigures:
    """The latest figures of a running replay."""

    sequence: PlayedSequence
    frame: int | None = None
    range_m: float | None = None
    range_error_m: float | None = None
    rotation_error_deg: float | None = None
    latency_ms: float | None = None
    captures_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_RATE_WINDOW))

    def take(self, recording: Recording, record: Record) -> None:
        """Process one record of a peer."""
        if record["event"] == "target_relative":
            self.latency_ms = latency_ms(record, recording)
        elif record["event"] in TOLD:
            self._take_target(recording, record)

    def _take_target(self, recording: Recording, record: Record) -> None:
        captured_ns = recording.capture_ns(record)
        newer = not self.captures_ns or captured_ns > self.captures_ns[-1]
        if newer:
            self.captures_ns.append(captured_ns)
        elif record["event"] == "direction":
            return  # the pose of another target of the same frame tells more
        self.frame = frame_of_record(record, recording, self.sequence)
        self.range_m = self.range_error_m = self.rotation_error_deg = None
        if record["event"] == "direction":
            return
        self.range_m = float(np.linalg.norm(record["t_cam_target_m"]))
        if self.frame is None:
            return
        truths = [truth for truth in self.sequence.scene.truths if truth.frame == self.frame]
        for match in match_poses(truths, [pose_of(record, self.frame)])[0]:
            if match.estimate is not None:
                self.range_error_m = self.range_m - float(np.linalg.norm(match.truth.t_cam_target_m))
                self.rotation_error_deg = match.rotation_error_deg

    @property
    def rate_hz(self) -> float | None:
        """Frames with a pose or direction per second, over the last thirty."""
        if len(self.captures_ns) < 2 or self.captures_ns[-1] <= self.captures_ns[0]:
            return None
        return (len(self.captures_ns) - 1) * 1e9 / (self.captures_ns[-1] - self.captures_ns[0])

    def cells(self) -> dict[str, str]:
        """Text of each column."""
        frames = len(self.sequence.scene.images)
        return {
            "frame": "waiting" if self.frame is None else f"{self.frame + 1}/{frames}",
            "range": "not known" if self.captures_ns and self.range_m is None else _text(self.range_m, "{:.1f} m"),
            "range error": _text(self.range_error_m, "{:+.1f} m"),
            "rotation error": _text(self.rotation_error_deg, "{:.1f}°"),
            "latency": _text(self.latency_ms, "{:.1f} ms"),
            "rate": _text(self.rate_hz, "{:.1f} Hz"),
        }


class LiveView:
    """Shows LiveFigures: a table that is updated in place on a terminal, otherwise a line per second."""

    def __init__(self, console: Console, figures: LiveFigures) -> None:
        self._console = console
        self._figures = figures
        in_place = console.is_terminal and not console.is_dumb_terminal
        self._live = Live(self._table(), console=console, refresh_per_second=10) if in_place else None
        self._printed_s = -np.inf

    def __enter__(self) -> LiveView:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.update(self._table(), refresh=True)
            self._live.stop()

    def on_record(self, recording: Recording, record: Record) -> None:
        self._figures.take(recording, record)
        if record["event"] not in TOLD:
            return
        if self._live is not None:
            self._live.update(self._table())
        elif time.monotonic() - self._printed_s >= _PLAIN_PERIOD_S:
            self._printed_s = time.monotonic()
            cells = self._figures.cells().items()
            self._console.print("  ".join(f"{n} {v}" for n, v in cells), highlight=False, soft_wrap=True)

    def _table(self) -> Table:
        table = Table(title=f"{self._figures.sequence.scene.name}, live", title_justify="left")
        cells = self._figures.cells()
        for name in cells:
            table.add_column(name, justify="right", min_width=10)
        table.add_row(*cells.values())
        return table


def show(settings: PlaySettings, model: Path, console: Console) -> Recording:
    """Play a sequence, store what the peers received in its folder, and write its report there.

    Raises InputError, PlayError, OSError; files of an earlier flight are then already removed.
    """
    sequence, out, loaded = settings.sequence, settings.out, load_model(model, threads=1)
    say = partial(console.print, highlight=False, soft_wrap=True)
    say(f"playing {len(sequence.scene.images)} frames of {sequence.scene.folder}")
    figures = LiveFigures(sequence)
    remove_flight(out)
    with LiveView(console, figures) as view:
        recording = play(settings, view.on_record)
    flight = RecordedFlight(sequence.scene.folder, method_of(loaded), recording)
    write_flight(out, flight)
    if sequence.scene.can_be_scored:
        report_flight(sequence, flight, out, console)
    else:
        told = f"{len(recording.poses)} poses and {len(recording.directions)} directions over zenoh"
        told += f", {len(recording.targets)} poses by MAVLink"
        say(f"{told}, written to {out}; not scored: no ground truth")
    return recording


def report_flight(sequence: PlayedSequence, flight: RecordedFlight, out: Path, console: Console) -> dict[str, Any]:
    """Score a flight, write its report into `out` and print both; returns the score. Raises OSError."""
    say = partial(console.print, highlight=False, soft_wrap=True)
    say(f"scoring {len(sequence.scene.images)} frames and rendering the report")
    with Progress(console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task("rendering", total=len(sequence.scene.images))
        score, files = write_report(sequence, flight, out, lambda: progress.advance(task))
    console.print(summary_table(score))
    if drops := drops_told(sequence, score):
        say(drops)
    say(f"written to {out}: {', '.join(files)}")
    return score


def summary_table(score: dict[str, Any]) -> Table:
    """The figures of a score as a readable table."""
    overall = score["overall"]
    table = Table("metric", "value", title=f"score of {score['sequence']}", title_justify="left")
    rows = {
        "frames / poses received": f"{overall['frames']} / {score['poses']}",
        "directions received, range not known": str(score["directions_received"]),
        "recall": _text(overall["recall"], "{:.1%}"),
        "rotation error, mean / median": _pair(overall["rotation_error_deg"], "{:.2f}°"),
        "translation error, mean / median": _pair(overall["translation_error_m"], "{:.2f} m"),
        "relative depth error, mean": _text(overall["depth_error_rel"]["mean"], "{:.2%}"),
        "Pose@10°/5 %": _text(overall["pose_10deg_5pct"], "{:.1%}"),
        "capture to MAVLink, p50 / p95 / p99": _percentiles(score["latency_ms"]),
        "withheld by MAVLink, too unsure or too old": _text(score["latency_ms"]["tracks_withheld"], "{:d}"),
        "poses that match no target": _text(overall["false_poses"], "{:d}"),
        "frames dropped": _text(score["dropped_frames"], "{:d}"),
    }
    rows["model"] = f"{score['model']['file']} ({score['model']['precision']})"
    for row in rows.items():
        table.add_row(*row)
    return table


def _pair(values: dict[str, float | None], form: str) -> str:
    return f"{_text(values['mean'], form)} / {_text(values['median'], form)}"


def _percentiles(values: dict[str, float | None]) -> str:
    if values["p50"] is None:
        return "–"
    return " / ".join(_text(values[name], "{:.1f}") for name in ("p50", "p95", "p99")) + " ms"


def _text(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)
