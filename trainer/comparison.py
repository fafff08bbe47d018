"""Comparison of model files of one network on the same windows, and warnings about what they find."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from trainer.data import TrainingBatch
from trainer.evaluate import Predictions, difference, measure, sigma_shortfall, tell_of_poses

RECALL_LEAST = 0.5  # of a stage: below it a file is of little use in flight


class Views(NamedTuple):
    """Rendered windows of the kind each stage processes; `track` is empty for a model without that stage."""

    track: list[TrainingBatch]
    acquire: list[TrainingBatch]


class Tolerance(NamedTuple):
    """Largest allowed deviation of INT8 from FP32 on the comparison windows of either stage."""

    rotation_deg: float = 2.0  # median angle between the two
    depth_percent: float = 2.0  # median
    pose_points: float = 5.0  # loss of Pose@10°/5 %; a few hundred windows measure it to within a few points
    sigma_percent: float = 10.0  # decrease of sigma, median
    recall_points: float = 5.0  # loss of recall at the promised thresholds


class Measured(NamedTuple):
    """One model file's predictions on the comparison windows."""

    track: Predictions | None
    acquire: Predictions


class Strayed(NamedTuple):
    """Differences in the worse stage: medians, loss of Pose@10°/5 % in points, decrease of sigma, loss of recall."""

    rotation_deg: float = 0.0
    depth_percent: float = 0.0
    pose_points: float = 0.0
    sigma_percent: float = 0.0
    recall_points: float = 0.0

    def refusal(self, tolerance: Tolerance) -> str | None:
        """Text for the first difference that exceeds its tolerance; None if none does."""
        told = (
            ("median rotation differs from FP32's by {:.4g} degrees, more than --tolerance {:g}"),
            ("median depth differs from FP32's by {:.4g} %, more than --tolerance-depth {:g}"),
            ("Pose@10°/5 % is {:.4g} points worse than FP32's, more than --tolerance-pose {:g}"),
            ("median sigma is smaller than FP32's by {:.4g} %, more than --tolerance-sigma {:g}"),
            ("recall is {:.4g} points worse than FP32's, more than --tolerance-recall {:g}"),
        )
        pairs = zip(told, self, tolerance, strict=True)
        return next((text.format(value, limit) for text, value, limit in pairs if not value <= limit), None)


def comparison_table(
    views: Views, title: str, a: Measured, b: Measured, thresholds: tuple[float, float]
) -> tuple[str, Strayed]:
    """Differences of `a` from `b` as text, and the larger of both stages; `thresholds` of acquire and track.

    False alarms are only told: there are too few windows without a target for a tolerance.
    """
    columns = ("rotation deg", "depth %", "centre px", "sigma %", "score", "Pose@10°/5 %", "recall %", "false alarms %")
    lines = [f"{title:24}" + "".join(f"{column:>18}" for column in columns)]
    worst = Strayed()
    acquire_min, track_min = thresholds
    stages = (
        ("track", a.track, b.track, views.track, track_min),
        ("acquire", a.acquire, b.acquire, views.acquire, acquire_min),
    )
    for stage, one, other, batches, score_min in stages:
        if one is None or other is None:
            continue
        present = np.concatenate([batch.present for batch in batches])
        d = difference(one, other, present)
        measured = [measure(predicted, batches, score_min) for predicted in (one, other)]
        shares = {k: [100 * m[k] for m in measured] for k in ("pose_10deg_5pct", "recall", "false_alarms")}
        tells = tell_of_poses(batches)
        lost = {k: of_other - of_one if tells else 0.0 for k, (of_one, of_other) in shares.items()}
        smaller = 100 * sigma_shortfall(one, other, present)
        strayed = Strayed(
            d["rotation_deg_median"], 100 * d["depth_rel_median"], lost["pose_10deg_5pct"], smaller, lost["recall"]
        )
        worst = Strayed(*(np.maximum(x, y) for x, y in zip(worst, strayed, strict=True)))  # keeps NaN
        scales = {"rotation_deg": 1, "depth_rel": 100, "center_px": 1, "sigma_rel": 100, "score": 1}
        cells = [f"{s * d[f'{k}_median']:8.3f} /{s * d[f'{k}_p95']:8.3f}" for k, s in scales.items()]
        cells += ["{:9.1f} /{:7.1f}".format(*of_both) for of_both in shares.values()]
        lines.append(f"  {stage:22}" + "".join(cells))
    told = "differences: median / 95th percentile over windows with a target; the last three columns: both values"
    return "\n".join([*lines, f"  ({told})"]), worst


def too_blind(metrics: Mapping[str, float]) -> list[str]:
    """A warning for each stage that finds less than RECALL_LEAST of the targets, from a contract's metrics."""
    recalls = {stage: metrics.get(f"{stage}_recall", 1.0) for stage in ("track", "acquire")}
    return [
        f"WARNING: the {stage} stage finds {100 * recall:.0f} % of the targets in held-out windows: not fit to fly; it "
        "needs more training, or training data that resemble what it is validated on"
        for stage, recall in recalls.items()
        if recall < RECALL_LEAST
    ]
