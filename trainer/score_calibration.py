"""Calibrates scores as probabilities: logistic regression on whole frames, separately for each stage. Pure."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from msgs.contract import ScoreCalibration
from sim_replay.evaluation.candidates import Candidate

SIZE_CAPS_PX = (20.0, 30.0, 45.0, 70.0, 100.0)
LEAST_OF_EACH = 20
_PRIOR = 1e-3  # regularisation, so that a solution exists for perfectly separable peaks
_STEPS = 50


class TooFewCandidates(ValueError):
    """Too few peaks on targets, or elsewhere, for a fit."""


class ScoresTellNothing(ValueError):
    """Higher scores are not of targets more often than lower ones."""


def fit(candidates: Iterable[Candidate]) -> ScoreCalibration:
    """The maximum-likelihood calibration. Raises TooFewCandidates, ScoresTellNothing."""
    seen = list(candidates)
    on = np.array([candidate.is_target for candidate in seen], dtype=bool)
    if min(on.sum(), (~on).sum()) < LEAST_OF_EACH:
        raise TooFewCandidates(
            f"{on.sum()} peaks on targets and {(~on).sum()} elsewhere: at least {LEAST_OF_EACH} of each are needed"
        )
    score = np.clip([candidate.score for candidate in seen], 1e-6, 1.0 - 1e-6)
    logit = np.log(score / (1.0 - score))
    shown = np.maximum([candidate.shown_px for candidate in seen], 1.0)
    fits = []
    for cap in SIZE_CAPS_PX:
        weights, deviance = _logistic(np.column_stack([np.ones(len(on)), logit, np.log(np.minimum(shown, cap))]), on)
        fits.append((deviance, cap, weights))
    _, cap, weights = min(fits, key=lambda one: one[0])
    offset, slope, size_slope = (round(float(weight), 4) for weight in weights)
    if slope <= 0:
        raise ScoresTellNothing("its scores do not separate targets from background: train it longer")
    return ScoreCalibration(offset=offset, slope=slope, size_slope=size_slope, size_cap_px=cap)


def _logistic(X: NDArray[np.float64], y: NDArray[np.bool_]) -> tuple[NDArray[np.float64], float]:
    """Weights and deviance of logistic regression by Newton's method."""
    weights = np.zeros(X.shape[1])
    prior = _PRIOR * np.eye(X.shape[1])
    for _ in range(_STEPS):
        p = 1.0 / (1.0 + np.exp(-np.clip(X @ weights, -30.0, 30.0)))
        weights += np.linalg.solve(X.T @ (X * (p * (1.0 - p))[:, None]) + prior, X.T @ (y - p) - prior @ weights)
    z = X @ weights
    return weights, float(2.0 * np.sum(np.logaddexp(0.0, np.where(y, -z, z))))


def expected_calibration_error(calibration: ScoreCalibration, candidates: Sequence[Candidate], bins: int = 10) -> float:
    """Mean difference between predicted probability and share of actual targets, over bins of that probability."""
    told = np.array([calibration.probability(one.score, one.shown_px) for one in candidates])
    on = np.array([one.is_target for one in candidates], dtype=float)
    which = np.minimum((told * bins).astype(int), bins - 1)
    return float(sum(abs(np.sum(told[which == b] - on[which == b])) for b in range(bins)) / len(on))
