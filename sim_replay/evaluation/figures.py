"""Figures of an evaluation: errors by distance, cumulative errors, each sequence over time, the worst frames."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sim_replay import metrics
from sim_replay.bop import Model
from sim_replay.evaluation.judge import JudgedFrame
from sim_replay.evaluation.worst import write_worst
from sim_replay.lettering import lettering
from sim_replay.report.peer import coordinate_errors, coordinates, root_mean_square
from sim_replay.score import Match, stacked

Array = NDArray[np.float64]

SEQUENCES_MAX = 24  # if there are more scenes, this many evenly spread ones are drawn
_OWN_NAMES = re.compile(r"sequence_(?:[\w.-]+_)?\d{6,}\.png|worst_frames\.jpg")
TRUTH_COLOR, ESTIMATE_COLOR = "#0097a7", "#d500a0"
_RATES = {
    "recall": "found",
    "rot_10deg": "Rot<10°",
    "depth_5pct": "Depth<5 %",
    "pose_10deg_5pct": "Pose@10°/5 %",
    "add_0_5d": "ADD-0.5d",
    "add_0_1d": "ADD-0.1d",
}


def write_figures(
    out: Path, score: dict[str, Any], judged: Sequence[JudgedFrame], models: Mapping[int, Model]
) -> list[Path]:
    """Draw everything into `out`, replacing the figures of an earlier evaluation; returns the files.

    Raises BopError if an image can no longer be read.
    """
    out.mkdir(parents=True, exist_ok=True)
    for path in list(out.iterdir()):
        if _OWN_NAMES.fullmatch(path.name):  # of scenes that this evaluation may not have
            path.unlink()
    matches = [match for frame in judged for match in frame.matches]
    files = [out / "error_by_range.png", out / "cumulative_error.png"]
    _save(error_by_range(score), files[0])
    _save(cumulative_error(matches), files[1])
    scenes: dict[str, list[JudgedFrame]] = {}
    for frame in judged:
        scenes.setdefault(_scene_name(frame, score["split"]), []).append(frame)
    chosen = np.linspace(0, len(scenes) - 1, min(SEQUENCES_MAX, len(scenes))).round().astype(int)
    for name in np.array(list(scenes))[chosen]:
        files.append(out / f"sequence_{name}.png")
        _save(sequence(f"{score['dataset']}, scene {name}", scenes[name]), files[-1])
    worst = write_worst(out / "worst_frames.jpg", judged, models)
    return files if worst is None else [*files, worst]


def _scene_name(frame: JudgedFrame, split: str | None) -> str:
    """The scene's number, with its split if the dataset was opened with several."""
    own = frame.picture.scene.split
    prefix = f"{own}_" if split is None and own is not None else ""
    return f"{prefix}{frame.picture.scene_id:06d}"


def error_by_range(score: dict[str, Any]) -> Figure:
    """Mean and median errors and the rates of each distance band that contains a target."""
    bands = {name: group for name, group in score["by_range"].items() if group["targets"]}
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    rotation, translation, rates = figure.subplots(1, 3)
    _bars(rotation, bands, {"E_r mean": ("rotation_error_deg", "mean"), "E_r median": ("rotation_error_deg", "median")})
    rotation.set_ylabel("rotation error, °")
    errors = {"E_t mean": ("translation_error_m", "mean"), "E_z mean": ("depth_error_m", "mean")}
    _bars(translation, bands, errors | {"E_t median": ("translation_error_m", "median")})
    translation.set_ylabel("error, m")
    for key, label in _RATES.items():
        shares = [np.nan if group[key] is None else 100 * group[key] for group in bands.values()]
        rates.plot(range(len(bands)), shares, marker="o", label=label)
    rates.set_xticks(range(len(bands)), list(bands))
    rates.set_ylabel("share of targets, %")
    rates.set_ylim(-3, 103)
    for axes in (rotation, translation, rates):
        axes.set_xlabel("true range, m")
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8, framealpha=0.6)
    _titled(figure, f"{score['method']['file']} on {score['dataset']}")
    return figure


def _bars(axes: Axes, bands: dict[str, Any], curves: dict[str, tuple[str, str]]) -> None:
    width = 0.8 / len(curves)
    for k, (label, (error, kind)) in enumerate(curves.items()):
        heights = [np.nan if group[error][kind] is None else group[error][kind] for group in bands.values()]
        axes.bar(np.arange(len(bands)) + (k - 0.5 * (len(curves) - 1)) * width, heights, width, label=label)
    axes.set_xticks(range(len(bands)), [f"{name}\n{group['targets']} targets" for name, group in bands.items()])


def cumulative_error(matches: Sequence[Match]) -> Figure:
    """Share of all targets with an error below x; a missed target, or one of unknown rotation, never counts."""
    found = [(m.truth, m.estimate) for m in matches if m.estimate is not None]
    _, t_gt = stacked([truth for truth, _ in found])
    _, t_est = stacked([estimate for _, estimate in found])
    turn_deg = np.array([m.rotation_error_deg for m in matches if m.rotation_error_deg is not None])
    add = np.array([m.add_m / m.truth.diameter_m for m in matches if m.add_m is not None])
    modelled = sum(m.truth.points_body_m is not None for m in matches)
    curves = (
        ("rotation error E_r, °", turn_deg, len(matches), 180.0, (10.0,)),
        ("translation error / range, %", 100 * metrics.translation_error_rel(t_est, t_gt), len(matches), 30.0, (5.0,)),
        ("depth error / depth, %", 100 * metrics.depth_error_rel(t_est, t_gt), len(matches), 30.0, (5.0,)),
        ("ADD / diameter", add, modelled, 2.0, (0.1, 0.5)),
    )
    figure = Figure(figsize=(13, 3.8), layout="constrained")
    for axes, (label, errors, total, limit, marks) in zip(figure.subplots(1, 4), curves, strict=True):
        x = np.concatenate([[0.0], np.sort(errors)])
        share = 100.0 * np.arange(len(x)) / max(total, 1)
        axes.step([*x, max(limit, x[-1])], [*share, share[-1]], where="post")
        for mark in marks:
            axes.axvline(mark, color="gray", linestyle="--", linewidth=1)
        axes.set(xlabel=label, xlim=(0, limit), ylim=(0, 102))
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("share of all targets, %")
    return figure


def sequence(title: str, frames: Sequence[JudgedFrame]) -> Figure:
    """X, Y, Z in `cam` and roll, pitch, yaw against the camera's axes, true and estimated, with RMSE, over the frames.

    Roll, pitch and yaw are zero for a target that flies straight away from the camera, wings along the rows.
    """
    figure = Figure(figsize=(14, 7), layout="constrained")
    panels = figure.subplots(2, 3).ravel()
    targets = max((len(frame.matches) for frame in frames), default=0)
    errors: list[list[Array]] = [[] for _ in panels]
    for k in range(targets):
        seen = [(f.picture.image_id, f.matches[k]) for f in frames if len(f.matches) > k]
        found = [(image_id, m.truth, m.estimate) for image_id, m in seen if m.estimate is not None]
        true = coordinates([m.truth for _, m in seen])
        estimated = coordinates([estimate for _, _, estimate in found])
        error = coordinate_errors([(truth, estimate) for _, truth, estimate in found])
        for column, axes in enumerate(panels):
            label = {"label": "truth"} if k == 0 else {}
            axes.plot([i for i, _ in seen], true[:, column], ".", ms=4, color=TRUTH_COLOR, **label)
            label = {"label": "estimate"} if k == 0 else {}
            axes.plot([i for i, _, _ in found], estimated[:, column], ".", ms=3, color=ESTIMATE_COLOR, **label)
            errors[column].append(error[:, column])
    names = ("X", "Y", "Z", "roll", "pitch", "yaw")
    for axes, name, unit, parts in zip(panels, names, [" m"] * 3 + ["°"] * 3, errors, strict=True):
        rms = root_mean_square(np.concatenate([*parts, np.zeros(0)]))
        told = "nothing found" if rms is None else f"RMSE {rms:.2f}{unit}"
        axes.set(title=f"{name}: {told}", ylabel=f"{name}, {unit.strip()}")
        axes.grid(alpha=0.3)
    for axes in panels[3:]:
        axes.set_xlabel("image")
    if targets:
        panels[0].legend(fontsize=8)
    _titled(figure, title)
    return figure


def _titled(figure: Figure, title: str) -> None:
    (shown,), style = lettering([title])
    figure.suptitle(shown, **style)


def _save(figure: Figure, path: Path) -> None:
    figure.savefig(path, dpi=110)
