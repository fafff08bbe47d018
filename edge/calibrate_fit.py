"""Fits all lens models to views of a board and judges whether a model describes the camera and the views determine it.

The fit is OpenCV's (Z. Zhang, "A flexible new technique for camera calibration", 2000).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from edge.calibrate_board import Size, View
from edge.estimator.lens import Lens
from edge.types import Array

Coefficients = Literal[4, 5, 8]

VIEWS_MIN = 8
RMS_MAX_PX = 1.5
OUTLIER_FACTOR = 3.0
FOCAL_SIGMA_MAX = 0.005  # relative; above it the views do not determine the focal length
# Views of a board that faces the camera cannot separate focal length and distance, whatever the fit's sigma says.
TILT_MIN_RAD, TILTED_MIN = np.deg2rad(15.0), 3
COVERED_MIN = 0.5  # share of the image's 4x4 cells with a corner in any view
# If more coefficients reduce the reprojection error by this much, fewer do not describe the lens; below this many
# pixels, the error is not a lens model's.
GAIN_MIN, GAIN_MIN_PX = 0.25, 0.02
# The fit does not determine the outermost corners, where no board was seen; an image is usable without them.
WITHOUT_RAY_MAX = 0.02
FLAGS: dict[Coefficients, int] = {4: cv2.CALIB_FIX_K3, 5: 0, 8: cv2.CALIB_RATIONAL_MODEL}  # fewest first
MODEL: dict[Coefficients, str] = {4: "plumb_bob", 5: "plumb_bob", 8: "rational_polynomial"}
_GRID_POINTS = 129  # per side of the image, checked for being the image of exactly one ray


@dataclass(frozen=True)
class Calibration:
    """A camera as fitted."""

    image_size_wh: Size
    K: list[list[float]]  # 3x3, pixel centres at integers
    distortion: list[float]  # k1 k2 p1 p2 k3 [k4 k5 k6]
    model: str
    rms_px: float  # reprojection error of all corners
    focal_sigma: float  # relative 1-sigma of the focal length
    covered: float  # share of the image in which boards were seen
    tilted: int  # views of a board that does not face the camera
    without_ray: float  # share of the image, in its corners, where the distortion cannot be inverted
    views: int  # used
    boards: int  # pictures that showed the board
    pictures: int  # examined


@dataclass(frozen=True, eq=False)
class Fit:
    """One lens model, fitted."""

    coefficients: Coefficients
    K: Array  # [3, 3]
    distortion: tuple[float, ...]  # k1 k2 p1 p2 k3 [k4 k5 k6]
    rms_px: float  # inf: the fit failed
    focal_sigma: float  # relative; inf: the views do not determine it
    errors_px: Array  # [views]
    tilts_rad: Array  # [views], of the board relative to the sensor

    @property
    def settled(self) -> bool:
        return self.focal_sigma <= FOCAL_SIGMA_MAX

    def gains_on(self, fewer: Fit) -> bool:
        """Whether it fits the views so much better that the model of fewer coefficients does not describe the lens."""
        least_px = min((1.0 - GAIN_MIN) * fewer.rms_px, fewer.rms_px - GAIN_MIN_PX)
        return self.settled and self.rms_px <= least_px

    def without_ray(self, size_wh: Size) -> float:
        """Share of an image's pixels that are not the image of exactly one ray."""
        sides = [np.linspace(0, side - 1, _GRID_POINTS) for side in size_wh]
        grid = np.stack(np.meshgrid(*sides), axis=-1)
        return 1.0 - float(np.mean(Lens(self.K, self.distortion).shows(grid)))


def fit(views: list[View], size_wh: Size) -> tuple[list[View], dict[Coefficients, Fit]]:
    """The views used, and every lens model fitted to them, fewest coefficients first.

    Views that disagree with the best-fitting model are left out: the board moved while it was filmed.
    """
    fits = _each_model(views, size_wh)
    errors_px = _best(fits).errors_px
    agreeing = [view for view, e in zip(views, errors_px, strict=True) if e <= OUTLIER_FACTOR * np.median(errors_px)]
    if VIEWS_MIN <= len(agreeing) < len(views):
        views, fits = agreeing, _each_model(agreeing, size_wh)
    return views, fits


def calibration_of(
    views: list[View], size_wh: Size, coefficients: Coefficients, boards: int, pictures: int
) -> Calibration | str:
    """The camera that fits the views, or why it cannot be determined and what to do: the end of a sentence."""
    used, fits = fit(views, size_wh)
    reason = reason_against(coefficients, fits, used, size_wh)
    if reason is not None:
        return reason
    chosen = fits[coefficients]
    return Calibration(
        image_size_wh=size_wh,
        K=chosen.K.tolist(),
        distortion=list(chosen.distortion),
        model=MODEL[coefficients],
        rms_px=chosen.rms_px,
        focal_sigma=chosen.focal_sigma,
        covered=_covered(used, size_wh),
        tilted=_tilted(fits),
        without_ray=chosen.without_ray(size_wh),
        views=len(used),
        boards=boards,
        pictures=pictures,
    )


def reason_against(
    coefficients: Coefficients, fits: dict[Coefficients, Fit], views: list[View], size_wh: Size
) -> str | None:
    """Why the model with this number of coefficients, of all that were fitted, must not be used, and what to do; None:
    it may. Faults of the views come before faults of the model."""
    chosen = fits[coefficients]
    return (
        _no_model(chosen, fits)
        or _poor_views(_covered(views, size_wh), _tilted(fits), len(views))
        or _better_model(chosen, fits)
        or _unsettled(chosen, fits)
        or _folded(chosen, fits, size_wh)
    )


def _each_model(views: list[View], size_wh: Size) -> dict[Coefficients, Fit]:
    """Each fit starts from the previous one's result: for wide lenses, without it, they end in other minima."""
    fits: dict[Coefficients, Fit] = {}
    start: Fit | None = None
    for coefficients in FLAGS:
        start = fits[coefficients] = _fitted(views, size_wh, coefficients, start)
    return fits


def _fitted(views: list[View], size_wh: Size, coefficients: Coefficients, start: Fit | None) -> Fit:
    flags, K_begin, begin = FLAGS[coefficients], np.eye(3), np.zeros(8)
    if start is not None and np.isfinite(start.rms_px) and _holds(size_wh, start.K):
        flags, K_begin = flags | cv2.CALIB_USE_INTRINSIC_GUESS, start.K.copy()
        begin[: len(start.distortion)] = start.distortion
    try:
        rms_px, K, distortion, rvecs, _, sigma, _, errors_px = cv2.calibrateCameraExtended(
            [view.board for view in views], [view.pixels for view in views], size_wh, K_begin, begin, flags=flags
        )
    except cv2.error:  # a view that does not determine a plane
        nothing = np.full(len(views), np.nan)
        return Fit(coefficients, np.eye(3), (), np.inf, np.inf, nothing, nothing)
    told = np.asarray(distortion, dtype=np.float64).reshape(-1)[: 8 if coefficients == 8 else 5]
    sound = np.all(np.isfinite([*np.ravel(K), *told, rms_px]))
    focal_sigma = np.max(np.abs(np.asarray(sigma).reshape(-1)[:2] / np.diag(K)[:2]))
    return Fit(
        coefficients=coefficients,
        K=np.asarray(K, dtype=np.float64),
        distortion=tuple(float(value) for value in told),
        rms_px=float(rms_px) if sound else np.inf,
        focal_sigma=float(focal_sigma) if np.isfinite(focal_sigma) else np.inf,
        errors_px=np.asarray(errors_px, dtype=np.float64).reshape(-1),
        tilts_rad=np.array([np.arccos(np.clip(abs(cv2.Rodrigues(rvec)[0][2, 2]), 0.0, 1.0)) for rvec in rvecs]),
    )


def _holds(size_wh: Size, K: Array) -> bool:
    """Whether OpenCV accepts K as a start: its principal point must lie in the image."""
    return bool(np.all(K[:2, 2] >= 0) and np.all(K[:2, 2] < size_wh) and np.all(np.diag(K) > 0))


def _best(fits: dict[Coefficients, Fit]) -> Fit:
    return min(fits.values(), key=lambda one: one.rms_px)


def _tilted(fits: dict[Coefficients, Fit]) -> int:
    """Number of views of a tilted board: the least of the models that describe the views, because a focal length that
    is far too long makes a board that faces the camera look tilted."""
    best = _best(fits)
    return min(int(np.sum(one.tilts_rad > TILT_MIN_RAD)) for one in fits.values() if not best.gains_on(one))


def _covered(views: list[View], size_wh: Size) -> float:
    return len({tuple(cell) for view in views for cell in np.floor(4 * view.pixels / size_wh).astype(int)}) / 16


def _no_model(chosen: Fit, fits: dict[Coefficients, Fit]) -> str | None:
    if chosen.rms_px <= RMS_MAX_PX or _better_model(chosen, fits) is not None:
        return None
    found = f"the reprojection error is {chosen.rms_px:.2f} px" if np.isfinite(chosen.rms_px) else "the fit failed"
    fewer = _or_fewer(_no_worse(chosen, fits))
    return f"{found}; check that the board is flat, --squares correct, and the lens not a fisheye{fewer}"


def _poor_views(covered: float, tilted: int, views: int) -> str | None:
    if covered < COVERED_MIN:
        return f"the views cover only {100 * covered:.0f} % of the image; show the board in the corners too"
    if tilted < TILTED_MIN:
        return _too_alike(f"{tilted} of {views} are tilted")
    return None


def _too_alike(how: str) -> str:
    return (
        f"the views are too similar to separate focal length and distance ({how}): "
        "tilt the board by 30 degrees or more, in all directions"
    )


def _better_model(chosen: Fit, fits: dict[Coefficients, Fit]) -> str | None:
    better = chosen
    for more in fits.values():
        if more.coefficients > chosen.coefficients and more.rms_px <= RMS_MAX_PX and more.gains_on(better):
            better = more
    if better is chosen:
        return None
    return (
        f"the reprojection error is {chosen.rms_px:.2f} px with {chosen.coefficients} coefficients, "
        f"{better.rms_px:.2f} px with {better.coefficients}: use --coefficients {better.coefficients}"
    )


def _unsettled(chosen: Fit, fits: dict[Coefficients, Fit]) -> str | None:
    if chosen.settled:
        return None
    if np.isfinite(chosen.focal_sigma):
        return _too_alike(f"1 sigma {100 * chosen.focal_sigma:.1f} %")
    advice = _or_fewer([less for less in _no_worse(chosen, fits) if less.settled])
    return f"the views do not determine {chosen.coefficients} coefficients; show the board in more places{advice}"


def _folded(chosen: Fit, fits: dict[Coefficients, Fit], size_wh: Size) -> str | None:
    without_ray = chosen.without_ray(size_wh)
    if without_ray <= WITHOUT_RAY_MAX:
        return None
    whole = [less for less in _no_worse(chosen, fits) if less.without_ray(size_wh) <= WITHOUT_RAY_MAX]
    share = f"in its corners ({100 * without_ray:.1f} % of it)"
    return f"the fitted distortion folds the image over itself {share}; show the board there{_or_fewer(whole)}"


def _no_worse(chosen: Fit, fits: dict[Coefficients, Fit]) -> list[Fit]:
    """Models of fewer coefficients that describe the views as well."""
    fewer = [less for less in fits.values() if less.coefficients < chosen.coefficients]
    return [less for less in fewer if less.rms_px <= RMS_MAX_PX and not chosen.gains_on(less)]


def _or_fewer(choice: list[Fit]) -> str:
    return f". Or use fewer: --coefficients {choice[-1].coefficients}" if choice else ""
