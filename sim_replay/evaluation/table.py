"""A score as readable tables: a column for each distance band, then a row for each airframe."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rich.console import Console, Group
from rich.markup import escape
from rich.table import Table

from sim_replay.evaluation.spread import FLIGHTS_LEAST

WIDTH = 130  # of tables that are not written to a terminal
_ROWS: dict[str, Callable[[dict[str, Any]], str]] = {
    "targets": lambda group: str(group["targets"]),
    "recall": lambda group: _text(group["recall"], "{:.1%}"),
    "E_r mean": lambda group: _text(group["rotation_error_deg"]["mean"], "{:.2f}°"),
    "E_r median": lambda group: _text(group["rotation_error_deg"]["median"], "{:.2f}°"),
    "E_t mean": lambda group: _text(group["translation_error_m"]["mean"], "{:.2f} m"),
    "E_t median": lambda group: _text(group["translation_error_m"]["median"], "{:.2f} m"),
    "E_z mean": lambda group: _text(group["depth_error_m"]["mean"], "{:.2f} m"),
    "bearing mean": lambda group: _text(group["bearing_error_deg"]["mean"], "{:.3f}°"),
    "Rot<10°": lambda group: _text(group["rot_10deg"], "{:.1%}"),
    "Depth<5 %": lambda group: _text(group["depth_5pct"], "{:.1%}"),
    "Pose@10°/5 %": lambda group: _text(group["pose_10deg_5pct"], "{:.1%}"),
    "ADD-0.5d": lambda group: _text(group["add_0_5d"], "{:.1%}"),
    "ADD-0.1d": lambda group: _text(group["add_0_1d"], "{:.1%}"),
}
_AIRFRAME_COLUMNS = {
    "targets": "targets",
    "recall": "recall",
    "E_r mean": "E_r",
    "E_t mean": "E_t",
    "Pose@10°/5 %": "Pose",
    "ADD-0.1d": "ADD-0.1d",
}


def table_console(stderr: bool = False) -> Console:
    """Without a terminal, as wide as the tables need: a file cannot be widened."""
    console = Console(stderr=stderr)
    if not console.is_terminal:
        console.width = max(console.width, WIDTH)
    return console


def score_table(score: dict[str, Any]) -> Group:
    """The metrics of a score (sim_replay.evaluation.judge.score_of)."""
    overall = score["overall"]
    title = f"{score['method']['file']} on {score['dataset']}, {overall['frames']} frames"
    if score.get("size_given"):
        title += ", size given"
    false_rate = _text(overall["false_positives_per_1000"], "{:.1f}")
    caption = f"false positives per 1,000 frames without a target: {false_rate}\n{_calibration(overall)}"
    if overall["rotations_not_known"]:
        not_known = overall["rotations_not_known"]
        caption += f"\nposes whose rotation is not known, excluded from E_r and counted as failures: {not_known}"
    if "intervals_95" in score:
        caption += f"\n{_intervals(score['intervals_95'])}"
    if score.get("consistency") is not None:
        caption += f"\n{consistency_line(score['consistency'])}"
    if score.get("filtering") is not None:
        caption += f"\n{_filtering(score['filtering'])}"
    if score.get("directions") is not None:
        caption += f"\n{_directions(score['directions'])}"
    table = Table("", title=escape(title), caption=caption, title_justify="left", caption_justify="left")
    groups = {"all": overall}
    groups |= {f"{band} m": group for band, group in score["by_range"].items() if group["targets"]}
    for name in groups:
        table.add_column(name, justify="right")
    for name, cell in _ROWS.items():
        table.add_row(name, *(cell(group) for group in groups.values()))
    airframes = Table()
    airframes.add_column("airframe", no_wrap=True)
    for header in _AIRFRAME_COLUMNS.values():
        airframes.add_column(header, justify="right", no_wrap=True)
    for name, group in score["by_airframe"].items():
        airframes.add_row(escape(name), *(_ROWS[column](group) for column in _AIRFRAME_COLUMNS))
    return Group(table, airframes)


def _calibration(group: dict[str, Any]) -> str:
    if group["calibration"] is None:
        return "no covariances to evaluate"
    shares = (f"{name} {_text(value['inside_1sigma'], '{:.0%}')}" for name, value in group["calibration"].items())
    return "true values within 1 sigma (68 % expected): " + ", ".join(shares)


def consistency_line(found: dict[str, Any]) -> str:
    told = {name: found[name] for name in ("position", "rotation") if found[name]}
    if not told:
        return f"NEES not available: the covariances of all {found['singular']} poses are singular"
    means = ", ".join(
        "{} {:.2f} ({:.1f} to {:.1f})".format(name, one["nees_mean"], *one["bounds_95"]) for name, one in told.items()
    )
    left_out = f"; {found['singular']} poses with a singular covariance excluded" if found["singular"] else ""
    return f"NEES, mean over {found['flights']} flights (95 % bounds): {means}{left_out}"


def _intervals(intervals: dict[str, tuple[float, float]] | None) -> str:
    if intervals is None:
        return f"95 % confidence intervals not available: fewer than {FLIGHTS_LEAST} flights show a target"
    recall, pose = (
        "{:.0f} to {:.0f} %".format(*(100 * end for end in intervals[name])) for name in ("recall", "pose_10deg_5pct")
    )
    return f"95 % confidence intervals, over flights: recall {recall}, Pose@10°/5 % {pose}"


def _filtering(found: dict[str, Any]) -> str:
    translation_m, rotation_deg = found["translation_error_m"], found["rotation_error_deg"]
    return (
        f"tracker input → output, mean over {found['targets']} targets: "
        f"E_t {translation_m['measured']:.2f} → {translation_m['track']:.2f} m, "
        f"E_r {_text(rotation_deg['measured'], '{:.2f}°')} → {_text(rotation_deg['track'], '{:.2f}°')}"
    )


def _directions(found: dict[str, Any]) -> str:
    error = found["bearing_error_deg"]
    return (
        f"no pose but a direction, the range not being known: {found['targets']} targets, bearing error "
        f"mean {_text(error['mean'], '{:.3f}°')}, median {_text(error['median'], '{:.3f}°')}; "
        f"directions without a target: {found['false']}"
    )


def _text(value: float | None, form: str) -> str:
    return "–" if value is None else form.format(value)
