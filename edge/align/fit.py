"""Mount, lateness of stamps and focal length from how camera and vehicle turned. Pure.

A camera that is fixed to the vehicle turns with it: w_cam = R_body_cam^T w_body, for the rotation vectors over the same
time. Stamps that are late shift that time. With a focal length that is wrong by a factor, turns across the optical axis
look too large or too small by it, and those about it do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.align.attitudes import Attitudes
from edge.align.turns import Sight
from edge.tracking.own_ship import ATTITUDE_AHEAD_MAX_NS
from edge.types import Array
from msgs.geometry import R_FORWARD_CAM, euler_from_R, nearest_rotation, skew, so3_exp, so3_log

LATE_RANGE_S = (-0.3, 2.0)
LATE_STEP_S = 0.02
SEEN_MIN, SEEN_MIN_SHARE = 20, 0.3  # of the spans over which points were followed
SEEN_ENOUGH_SHARE, FOCAL_GUESSES = 0.8, (0.8, 1.25, 0.64, 1.56)
TURNED_MIN_DEG = 60.0  # in all
KNOWN_MIN_SHARE = 0.7  # of the turns known for the best-known lateness: with fewer, another fits by chance
UNEXPLAINED_MAX = 0.2  # of a turn: with more left, camera and attitude tell of different motions
RIVAL_APART_S, RIVAL_COST = 0.1, 1.3  # another lateness that fits nearly as well: the motion repeats itself
ROUNDS, ROUNDS_FROM_NEAR = 5, 2  # of least squares, from the grid, and from the solution with all turns
OUTLYING = 2.5  # times the median, from where a residual counts less (Huber)
RENEWALS = 3  # of the camera's turns with the focal length found
FOCAL_RANGE = (0.5, 2.0)
UNTOLD = 1e-9  # keeps what no turn tells of where it is
BLOCKS = 12  # of consecutive turns, left out one at a time for the uncertainty (jackknife)
SURE = 2.2  # standard deviations for 95 %, by Student's distribution for that many blocks
LATE_STD_S = 0.0005  # at least: attitudes are stamped in whole milliseconds
FOCAL_STD, MOUNT_STD_RAD = 0.003, np.deg2rad(0.05)  # at least: no scene is infinitely far, and nothing quite rigid
RATE_OVER_NS = 60_000_000  # attitudes so far apart tell how fast the camera turned
LATE_SURE_MAX_S, MOUNT_SURE_MAX_RAD, FOCAL_SURE_MAX = 0.015, np.deg2rad(1.0), 0.05  # known, if at most this unsure
MISFIT_MIN = 20.0  # variances, that what depends on the turns must explain to be counted; noise does about 5
# About a second axis, at least: what it leaves in squares, times what noise alone does, and turned in all.
SECOND_OVER_NOISE, SECOND_MIN_DEG = 20.0, 20.0
AXES = ("roll", "pitch", "yaw")
TURNED_LITTLE = 0.4  # of the axis that was turned about most


class UnknownError(Exception):
    """Nothing can be said; the text is a sentence that says why, and what to do."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """What was measured, with half widths of 95 % (`*_sure`); what is not known well enough is in `wanting`."""

    R_body_cam: Array  # [3, 3]
    mount_sure_rad: float  # about the worst axis
    angles_sure_rad: Array  # [3] of `mount_angles_rad`
    late_s: float  # stamp minus exposure, with the configured latency already subtracted
    late_sure_s: float
    clock_sure_s: float  # the part of it that is of the attitudes' stamps
    focal_ratio: float  # of the true focal length to the configured one
    focal_sure: float
    spans: int  # for which the turns of both are known
    turned_rad: Array  # [3], sizes of all turns about the body's axes added up
    wanting: dict[str, str]  # of "mount", "latency" and "focal": a sentence on why it is not known


def mount_angles_rad(R_body_cam: Array) -> Array:
    """Roll, pitch and yaw [..., 3] as in [mount], of R_body_cam [..., 3, 3]."""
    return np.stack(euler_from_R(R_body_cam @ R_FORWARD_CAM.T), axis=-1)


def align(sights: Sequence[Sight], attempts: int, attitudes: Attitudes) -> Alignment:
    """`attempts`: number of spans over which points were followed. Raises UnknownError."""
    if attitudes.usual_gap_ns > ATTITUDE_AHEAD_MAX_NS:
        raise UnknownError(
            f"attitude comes only {1e9 / attitudes.usual_gap_ns:.1f} times a second, and the daemon uses none that is "
            f"rarer than {1e9 / ATTITUDE_AHEAD_MAX_NS:.1f}: let the autopilot send it more often"
        )
    attitudes = attitudes.smoothed()
    turns = _first_turns(sights, attempts, attitudes)
    _refuse_unseen(turns, attempts)
    state, alone = _coarse(turns)
    for renewal in range(RENEWALS + 1):
        if renewal:
            turns = _Turns.of(sights, attitudes, state.focal_ratio, state)
            _refuse_unseen(turns, attempts)
        state, left = _solved(turns, state)
        _refuse_few(len(left.w_body), turns)
        _explained(left)
    if not alone:
        raise UnknownError(
            "several latencies of the camera fit alike: turn less evenly, faster and slower, with stops between"
        )
    return _judged(turns, state, left)


@dataclass(frozen=True, eq=False)
class _State:
    late_s: float
    R_body_cam: Array  # [3, 3]
    focal_ratio: float


@dataclass(frozen=True, eq=False)
class _Turns:
    """N turns of the camera beside the attitudes."""

    start_ns: Array  # [N]
    end_ns: Array  # [N]
    w_cam: Array  # [N, 3], rad
    focal_ratio: float  # that they were computed with
    attitudes: Attitudes

    @classmethod
    def of(
        cls, sights: Sequence[Sight], attitudes: Attitudes, focal_ratio: float = 1.0, state: _State | None = None
    ) -> _Turns:
        """`state`: tells how the camera turned while the rows of a picture were exposed; None: as if all at once."""
        rates = [None] * len(sights) if state is None else _rates_cam_radps(sights, attitudes, state)
        turns = [one.turn_cam_rad(focal_ratio, rate) for one, rate in zip(sights, rates, strict=True)]
        seen = [(one.start_ns, one.end_ns, w) for one, w in zip(sights, turns, strict=True) if w is not None]
        start_ns, end_ns = (np.array([one[i] for one in seen], dtype=np.float64) for i in (0, 1))
        return cls(start_ns, end_ns, np.array([w for *_, w in seen]).reshape(-1, 3), focal_ratio, attitudes)

    def w_body(self, late_s: float) -> tuple[Array, NDArray[np.bool_]]:
        """Rotation vectors [N, 3] of the body if stamps are late by this, and which of them are known."""
        R_start, epoch_start = self.attitudes.at(self.start_ns - 1e9 * late_s)
        R_end, epoch_end = self.attitudes.at(self.end_ns - 1e9 * late_s)
        return so3_log(R_start.swapaxes(-1, -2) @ R_end), (epoch_start >= 0) & (epoch_start == epoch_end)

    def only(self, chosen: NDArray[np.bool_]) -> _Turns:
        return _Turns(self.start_ns[chosen], self.end_ns[chosen], self.w_cam[chosen], self.focal_ratio, self.attitudes)


def _rates_cam_radps(sights: Sequence[Sight], attitudes: Attitudes, state: _State) -> Array:
    """How fast the camera turned at start and end of each sight [N, 2, 3]; 0 where that is not known."""
    ends_ns = np.array([(one.start_ns, one.end_ns) for one in sights], dtype=np.float64).ravel() - 1e9 * state.late_s
    before, epoch_before = attitudes.at(ends_ns - 0.5 * RATE_OVER_NS)
    after, epoch_after = attitudes.at(ends_ns + 0.5 * RATE_OVER_NS)
    known = (epoch_before >= 0) & (epoch_before == epoch_after)
    rates = so3_log(before.swapaxes(-1, -2) @ after) / (1e-9 * RATE_OVER_NS)
    return np.asarray(np.where(known[:, None], rates, 0.0) @ state.R_body_cam).reshape(-1, 2, 3)


def _first_turns(sights: Sequence[Sight], attempts: int, attitudes: Attitudes) -> _Turns:
    """The turns of the camera, with another focal length than the configured one where points fit that far better."""
    turns = _Turns.of(sights, attitudes)
    if len(turns.w_cam) >= SEEN_ENOUGH_SHARE * attempts:
        return turns
    others = (_Turns.of(sights, attitudes, focal_ratio) for focal_ratio in FOCAL_GUESSES)
    return max([turns, *others], key=lambda one: len(one.w_cam))


def _coarse(turns: _Turns) -> tuple[_State, bool]:
    """The best of a grid of latenesses, each with its best mount, and whether no other fits as well. Raises
    UnknownError."""
    grid_s = np.arange(LATE_RANGE_S[0], LATE_RANGE_S[1] + LATE_STEP_S / 2, LATE_STEP_S)
    mounted = [_mounted(turns, late_s) for late_s in grid_s]
    most = max(count for *_, count in mounted)
    _refuse_few(most, turns)
    costs = np.array([cost if count >= KNOWN_MIN_SHARE * most else np.inf for *_, cost, count in mounted])
    best = int(np.argmin(costs))
    rival = costs[np.abs(grid_s - grid_s[best]) > RIVAL_APART_S].min()
    alone = 0 < best < len(grid_s) - 1 and rival > RIVAL_COST * costs[best]
    R_body_cam, scale, *_ = mounted[best]
    return _State(float(grid_s[best]), R_body_cam, scale * turns.focal_ratio), alone


def _refuse_unseen(turns: _Turns, attempts: int) -> None:
    seen = len(turns.w_cam)
    if attempts < SEEN_MIN:
        raise UnknownError(f"the camera's turn was seen only {seen} times, of {SEEN_MIN} at least: watch for longer")
    if seen < max(SEEN_MIN, SEEN_MIN_SHARE * attempts):
        raise UnknownError(
            f"the camera's turn was seen in only {seen} of {attempts} attempts to follow points: show it a "
            "far scene full of detail, in good light, with nothing near or moving, and turn more slowly; are [camera] "
            "intrinsics and readout_ms of this camera?"
        )


def _refuse_few(known: int, turns: _Turns) -> None:
    if known < SEEN_MIN:
        raise UnknownError(f"the attitude is known for only {known} of {len(turns.w_cam)} turns of the camera")


def _mounted(turns: _Turns, late_s: float) -> tuple[Array, float, float, int]:
    """If stamps are late by this: the mount [3, 3] and the scale of the camera's turns that leave the least mean
    difference, that in rad, and the number of turns that are known."""
    w_body, known = turns.w_body(late_s)
    if not known.any():
        return np.eye(3), 1.0, np.inf, 0
    body, cam = w_body[known], turns.w_cam[known]
    weights = np.ones(len(body))[:, None]
    for _ in range(4):
        R_body_cam = nearest_rotation((body * weights).T @ cam)
        turned = body @ R_body_cam
        scale = (weights * turned * cam).sum() / max((weights * turned * turned).sum(), 1e-12)
        scale = float(np.clip(scale, *FOCAL_RANGE))
        left_rad = np.linalg.norm(scale * turned - cam, axis=-1)
        weights = 1.0 / np.maximum(left_rad, 1e-4)[:, None]
    return R_body_cam, scale, float(left_rad.mean()), len(body)


def _explained(left: _Left) -> None:
    """Raises UnknownError if the vehicle hardly turned, or its turns are not the camera's."""
    turned_deg = np.rad2deg(np.linalg.norm(left.w_body, axis=-1))
    if turned_deg.sum() < TURNED_MIN_DEG:
        raise UnknownError(
            f"the vehicle turned by only {turned_deg.sum():.0f}° in all: turn it to and fro about all three axes, by "
            "20° and more each time"
        )
    differ_deg, mean_deg = np.rad2deg(left.sizes_rad.mean()), turned_deg.mean()
    if differ_deg > UNEXPLAINED_MAX * mean_deg:
        raise UnknownError(
            f"camera and attitude tell of different turns: they differ by {differ_deg:.1f}° of {mean_deg:.1f}° on "
            "average. Is all that is seen far away, the picture not stabilised, the camera fixed to the vehicle, and "
            "the attitude this vehicle's?"
        )


def _solved(turns: _Turns, state: _State, rounds: int = ROUNDS) -> tuple[_State, _Left]:
    """Least squares from near the solution, with outliers held down."""
    left = _left(turns, state)
    for _ in range(rounds):
        change = np.linalg.solve(left.information, left.pull)
        state = _State(
            float(np.clip(state.late_s + np.clip(change[0], -LATE_STEP_S, LATE_STEP_S), *LATE_RANGE_S)),
            state.R_body_cam @ so3_exp(change[1:4]),
            float(np.clip(state.focal_ratio + change[4], *FOCAL_RANGE)),
        )
        left = _left(turns, state)
    return state, left


@dataclass(frozen=True, eq=False)
class _Left:
    """What is left of the turns, and what it says of (lateness, mount about the camera's axes, focal ratio)."""

    information: Array  # [5, 5], for residuals of variance 1
    pull: Array  # [5]
    variance: float  # of a component of a residual
    sizes_rad: Array  # [n] of the residuals of the turns that are known
    w_body: Array  # [n, 3], these turns of the body, rad
    w_cam: Array  # [n, 3], what they are in cam
    off_cam: Array  # [n, 3], the residuals
    weights: Array  # [n]


def _left(turns: _Turns, state: _State) -> _Left:
    step_s = 0.25 * LATE_STEP_S
    w_body, known = turns.w_body(state.late_s)
    (earlier, before), (later, after) = turns.w_body(state.late_s - step_s), turns.w_body(state.late_s + step_s)
    known = known & before & after
    ratio = state.focal_ratio / turns.focal_ratio
    across = np.array([ratio, ratio, 1.0])
    true_cam = w_body[known] @ state.R_body_cam
    J = np.empty((len(true_cam), 3, 5))
    J[..., 0] = across * ((later - earlier)[known] @ state.R_body_cam) / (2.0 * step_s)
    J[..., 1:4] = across[:, None] * skew(true_cam)
    J[..., 4] = true_cam * (1.0, 1.0, 0.0) / turns.focal_ratio
    off = turns.w_cam[known] - across * true_cam
    sizes_rad = np.linalg.norm(off, axis=-1)
    weights = np.minimum(1.0, OUTLYING * np.median(sizes_rad) / np.maximum(sizes_rad, 1e-12))
    information = np.einsum("n,nki,nkj->ij", weights, J, J)
    information += UNTOLD * np.trace(information) * np.eye(5)
    variance = float((weights * sizes_rad**2).sum()) / max(3 * len(off) - 5, 1)
    pull = np.einsum("n,nki,nk->i", weights, J, off)
    return _Left(information, pull, variance, sizes_rad, w_body[known], true_cam, off, weights)


def _judged(turns: _Turns, best: _State, left: _Left) -> Alignment:
    """The solution, with uncertainties from those with a block left out, or from the residuals if that is more."""
    block = np.arange(len(turns.w_cam)) * BLOCKS // len(turns.w_cam)
    others = [_solved(turns.only(block != left_out), best, ROUNDS_FROM_NEAR)[0] for left_out in range(BLOCKS)]
    formal = left.variance * np.linalg.inv(left.information)
    R_others = np.array([one.R_body_cam for one in others])
    spread = _covariance(so3_log(best.R_body_cam.T @ R_others))
    mount_std_rad = np.inf
    if _about_two_axes(left):
        mount_std_rad = float(np.sqrt(max(np.linalg.eigvalsh(of)[-1] for of in (spread, formal[1:4, 1:4]))))
    apart_rad = mount_angles_rad(R_others) - mount_angles_rad(best.R_body_cam)
    angles_std_rad = np.sqrt(np.diag(_covariance((apart_rad + np.pi) % (2.0 * np.pi) - np.pi)))
    late_std_s = max(_std([one.late_s for one in others]), float(formal[0, 0]) ** 0.5)
    focal_std = max(_std([one.focal_ratio for one in others]), float(formal[4, 4]) ** 0.5)
    turned_rad = np.abs(left.w_body).sum(axis=0)
    misfit_rad = _misfit(left)
    sure = {
        "mount": SURE * float(np.sqrt(mount_std_rad**2 + MOUNT_STD_RAD**2 + misfit_rad**2)),
        "latency": SURE * float(np.hypot(late_std_s, LATE_STD_S)),
        "focal": SURE * float(np.hypot(focal_std, FOCAL_STD)),
    }
    # Stamps of attitudes that are wrong by a constant are the daemon's too: the latency that fits them is of use to it.
    clock_sure_s = SURE * turns.attitudes.clock_std_s
    return Alignment(
        best.R_body_cam,
        sure["mount"],
        SURE * np.sqrt(angles_std_rad**2 + MOUNT_STD_RAD**2 + misfit_rad**2),
        best.late_s,
        float(np.hypot(sure["latency"], clock_sure_s)),
        clock_sure_s,
        best.focal_ratio,
        sure["focal"],
        len(left.sizes_rad),
        turned_rad,
        _wanting(sure, turned_rad, misfit_rad),
    )


def _covariance(others: Array) -> Array:
    """Jackknife: of values [BLOCKS, n], each with a block left out, to [n, n]."""
    off = others - others.mean(axis=0)
    return (len(others) - 1.0) / len(others) * off.T @ off


def _std(others: Sequence[float]) -> float:
    return float(_covariance(np.array(others)[:, None])[0, 0]) ** 0.5


def _misfit(left: _Left) -> float:
    """The share of the turns by which what is left depends on them; 0 if noise explains it.

    It does so where the picture moves otherwise than by a turn of the camera, as with near things in it: then the mount
    is wrong too, about as much.
    """
    root = np.sqrt(left.weights)[:, None]
    map_cam = np.linalg.lstsq(root * left.w_cam, root * left.off_cam, rcond=1e-3)[0]
    explained = float(((root * (left.w_cam @ map_cam)) ** 2).sum())
    if explained < MISFIT_MIN * left.variance:
        return 0.0
    return float(np.sqrt(explained / ((root * left.w_cam) ** 2).sum()))


def _about_two_axes(left: _Left) -> bool:
    """Turns about a single axis leave open how the camera is turned about it, and noise must not decide that."""
    n, second = len(left.w_body), float(np.linalg.eigvalsh(left.w_body.T @ left.w_body)[1])
    return second > SECOND_OVER_NOISE * n * left.variance and np.rad2deg(np.sqrt(n * second)) > SECOND_MIN_DEG


def _wanting(sure: dict[str, float], turned_rad: Array, misfit_rad: float) -> dict[str, str]:
    little = [axis for axis, rad in zip(AXES, turned_rad, strict=True) if rad < TURNED_LITTLE * turned_rad.max()]
    more = f"turn more about {' and '.join(little)}" if little else "turn more, and for longer"
    found = {}
    if SURE * misfit_rad > MOUNT_SURE_MAX_RAD:
        found["mount"] = (
            f"the mount is not known to better than {np.rad2deg(sure['mount']):.1f}°: the picture moves as if part of "
            "what is seen were near, or [camera] intrinsics or readout_ms wrong"
        )
    elif sure["mount"] > MOUNT_SURE_MAX_RAD:
        known_to = f" to better than {np.rad2deg(sure['mount']):.1f}°" if np.isfinite(sure["mount"]) else ""
        found["mount"] = f"the mount is not known{known_to}: {more}"
    if sure["latency"] > LATE_SURE_MAX_S:
        found["latency"] = (
            f"the latency is not known to better than {1e3 * sure['latency']:.0f} ms: turn with sudden starts and stops"
        )
    if sure["focal"] > FOCAL_SURE_MAX:
        found["focal"] = f"the focal length is not known to better than {100 * sure['focal']:.0f} %: {more}"
    return found
