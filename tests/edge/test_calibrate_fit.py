"""Which lens model describes a camera, and what is said where none does, or where the views do not tell: cameras that
are known exactly, seen through points alone."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from edge import calibrate
from edge.calibrate import VIEWS_MAX, report, write_calibration
from edge.calibrate_board import BoardSettings, View
from edge.calibrate_fit import WITHOUT_RAY_MAX, Calibration, Coefficients, Fit, calibration_of, fit, reason_against
from edge.cameras.intrinsics import load_intrinsics
from edge.config_camera import IntrinsicsSettings
from edge.estimator.lens import Lens

SIZE_WH = (1920, 1080)
ORIGIN_PX = np.array([963.0, 536.0])
NOISE_PX = 0.1
BOARD = np.array([[x - 3.5, y - 2.0, 0.0] for y in range(5) for x in range(8)])
Bend = Callable[[np.ndarray], np.ndarray]


def focal_px(view_deg: float) -> float:
    """Of a lens that maps equal angles to equal lengths, as wide ones do, with this horizontal view."""
    return float(SIZE_WH[0] / 2 / np.radians(view_deg / 2))


def equidistant(view_deg: float) -> Bend:
    def bend(points: np.ndarray) -> np.ndarray:
        off_axis = np.arctan2(np.linalg.norm(points[:, :2], axis=1), points[:, 2])
        towards = points[:, :2] / np.linalg.norm(points[:, :2], axis=1)[:, None]
        return focal_px(view_deg) * off_axis[:, None] * towards + ORIGIN_PX

    return bend


def plumb_bob(focal: float, distortion: tuple[float, ...]) -> Bend:
    K = np.array([[focal, 0, ORIGIN_PX[0]], [0, 1.004 * focal, ORIGIN_PX[1]], [0, 0, 1]])

    def bend(points: np.ndarray) -> np.ndarray:
        px, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, np.array(distortion))
        return np.asarray(px).reshape(-1, 2)

    return bend


def views(
    bend: Bend,
    view_deg: float,
    count: int = 20,
    noises_px: tuple[float, ...] = (NOISE_PX,),
    ranges: tuple[float, float] = (8.0, 14.0),
    seed: int = 6,
) -> list[View]:
    """Boards held to all places of the picture, tilted to all sides; the noise of their corners is each in turn's.
    `ranges`: from the nearest to the farthest, in squares."""
    random, found = np.random.default_rng(seed), list[View]()
    while len(found) < count:
        place = np.radians(view_deg) * random.uniform((-0.45, -0.25), (0.45, 0.25))
        turn, _ = cv2.Rodrigues(np.array([-place[1], place[0], 0.0]))
        tilt, _ = cv2.Rodrigues(random.normal(0, 0.4, 3))
        points = (tilt @ turn @ BOARD.T).T + random.uniform(*ranges) * turn[:, 2]
        px = bend(points)
        seen = np.all((px > 2) & (px < np.array(SIZE_WH) - 3), axis=1)
        if seen.sum() >= 20:
            noise = random.normal(0, noises_px[len(found) % len(noises_px)], (seen.sum(), 2))
            ids = np.flatnonzero(seen)
            found.append(View(ids, BOARD[seen].astype(np.float32), (px[seen] + noise).astype(np.float32)))
    return found


def filmed(monkeypatch: pytest.MonkeyPatch, seen: list[View]) -> Calibration:
    """What `calibrate` makes of a video whose frames show these views."""
    frames = [(f"frame {index}", np.zeros((SIZE_WH[1], SIZE_WH[0]), np.uint8)) for index in range(len(seen))]
    monkeypatch.setattr(calibrate, "pictures_of", lambda _: iter(frames))
    remaining = iter(seen)
    detector = SimpleNamespace(detect=lambda _: next(remaining))
    monkeypatch.setattr(calibrate, "detector_of", lambda _: detector)
    return calibrate.calibrate(Path("board.mp4"), BoardSettings("charuco", (9, 6), "5X5_100", 0.75), 5)


def calibrated(seen: list[View], coefficients: Coefficients) -> Calibration | str:
    return calibration_of(seen, SIZE_WH, coefficients, len(seen), len(seen))


def error_deg(found: Calibration, view_deg: float) -> np.ndarray:
    """How far the calibration's rays are off those of the equidistant lens, where it has one [n]."""
    grid = np.stack(np.meshgrid(*(np.linspace(0, side - 1, 25) for side in SIZE_WH)), axis=-1).reshape(-1, 2)
    lens = Lens(np.array(found.K), tuple(found.distortion))
    grid = grid[lens.shows(grid)]
    told = lens.rays(lens.to_pinhole(grid))
    angles = (grid - ORIGIN_PX) / focal_px(view_deg)
    off_axis = np.linalg.norm(angles, axis=1)
    true = np.column_stack([np.sin(off_axis)[:, None] * angles / off_axis[:, None], np.cos(off_axis)])
    cosine = np.sum(told * true, axis=1) / np.linalg.norm(told, axis=1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


@pytest.mark.parametrize("view_deg", [60, 80, 90, 100, 110, 120])
def test_who_follows_the_advice_ends_with_the_camera_however_wide_it_is(view_deg: int, tmp_path: Path) -> None:
    seen = views(equidistant(view_deg), view_deg)
    found = calibrated(seen, 4)
    while isinstance(found, str):
        advice = re.fullmatch(
            r"the reprojection error is ([\d.]+) px with (\d) coefficients, ([\d.]+) px with (\d): "
            r"use --coefficients \4",
            found,
        )
        assert advice is not None, found
        assert float(advice[3]) <= 0.75 * float(advice[1]) + 0.01
        assert advice[4] > advice[2]
        found = calibrated(seen, int(advice[4]))  # type: ignore[arg-type]
    assert found.K[0][0] == pytest.approx(focal_px(view_deg), rel=0.003)
    assert np.median(error_deg(found, view_deg)) < 0.05
    write_calibration(found, "wide", tmp_path / "wide.yaml")
    assert load_intrinsics(IntrinsicsSettings(file=tmp_path / "wide.yaml")).image_size_wh == SIZE_WH


def test_a_wide_lens_seen_in_few_far_views_is_found_from_what_fewer_coefficients_tell() -> None:
    """From a start of OpenCV's own, the fit of these views ends 2.3 px off."""
    found = calibrated(views(equidistant(140), 140, 12, ranges=(18.0, 24.0), seed=43), 8)
    assert isinstance(found, Calibration), found
    assert found.K[0][0] == pytest.approx(focal_px(140), rel=0.005)
    assert found.rms_px < 0.15


@pytest.mark.parametrize("noise_px", [0.0, 0.3])
def test_a_lens_that_four_coefficients_describe_is_not_refused_for_more(noise_px: float) -> None:
    seen = views(plumb_bob(1640, (-0.21, 0.06, 0.0012, -0.0009)), 60, noises_px=(noise_px,))
    found = calibrated(seen, 4)
    assert isinstance(found, Calibration), found
    assert found.K[0][0] == pytest.approx(1640, rel=0.002)


def test_what_no_model_describes_is_refused_and_a_fisheye_is_thought_of() -> None:
    seen = views(equidistant(60), 60, noises_px=(4.0,))
    for coefficients in (4, 5, 8):
        assert re.match(
            r"the reprojection error is \d\.\d\d px; check .*flat, --squares correct, and the lens not a fisheye",
            str(calibrated(seen, coefficients)),  # type: ignore[arg-type]
        )


@pytest.mark.parametrize(("reach_px", "refused"), [(1200, False), (1040, False), (960, True)])
def test_corners_without_a_ray_are_told_when_few_and_refused_when_many(
    tmp_path: Path, reach_px: int, refused: bool
) -> None:
    """A lens whose picture ends in a circle: one coefficient bends what is farther out back inwards."""
    focal = 1640
    used, fits = fit(views(plumb_bob(focal, (-0.2, 0.0, 0.0, 0.0)), 60), SIZE_WH)
    ends_at = 1.5 * reach_px / focal  # r (1 + k1 r^2) is largest where it is 2/3 r
    ending = replace(fits[8], distortion=(-1 / (3 * ends_at**2), 0.0, 0.0, 0.0, 0.0))
    columns, rows = np.meshgrid(np.arange(SIZE_WH[0]), np.arange(SIZE_WH[1]))
    beyond = np.mean(np.hypot(columns - ending.K[0, 2], rows - ending.K[1, 2]) > reach_px)
    share = ending.without_ray(SIZE_WH)
    assert beyond <= share < beyond + 0.01  # the rim itself cannot be told either
    assert (share > WITHOUT_RAY_MAX) == refused
    said = reason_against(8, {**fits, 8: ending}, used, SIZE_WH)
    if refused:
        told = r".* folds .* \(\d\.\d % of it\); show the board there"
        assert re.fullmatch(f"{told}. Or use fewer: --coefficients 5", str(said))
        # Fewer coefficients that describe the views worse are no advice.
        worse = {n: replace(fits[n], rms_px=2 * ending.rms_px) for n in (4, 5)}
        assert str(reason_against(8, {**worse, 8: ending}, used, SIZE_WH)).endswith("; show the board there")
        return
    assert said is None
    found = calibrated(used, 8)
    assert isinstance(found, Calibration)
    found = replace(found, distortion=list(ending.distortion), without_ray=share)
    told = f"{100 * share:.1f} % of the image, in its corners, cannot be undistorted, and nothing is detected there"
    assert any(told in line for line in report(found, tmp_path)) == (share > 0)
    write_calibration(found, "ends", tmp_path / "ends.yaml")
    assert load_intrinsics(IntrinsicsSettings(file=tmp_path / "ends.yaml")).distortion[0] == pytest.approx(
        ending.distortion[0]
    )


def test_a_view_that_does_not_agree_is_left_out_and_those_told_are_those_of_the_fit() -> None:
    moved, poor = 6.0, 0.22
    noises_px = (moved, poor, *[0.05] * 6)
    found = calibrated(views(plumb_bob(1640, (-0.21, 0.06, 0.0, 0.0)), 60, 24, noises_px), 4)
    assert isinstance(found, Calibration), found
    assert found.views == 21
    # The mean square of the noise of 3 poor views and 18 good ones, in x and y.
    assert found.rms_px == pytest.approx(np.sqrt(2 * (3 * poor**2 + 18 * 0.05**2) / 21), rel=0.15)


@pytest.mark.parametrize(("count", "used"), [(9, 9), (10, 8)])
def test_no_view_is_left_out_where_fewer_than_eight_would_remain(count: int, used: int) -> None:
    moved = 3.0
    noises_px = (moved, moved, *[0.05] * (count - 2))
    kept, _ = fit(views(plumb_bob(1640, (-0.21, 0.06, 0.0, 0.0)), 60, count, noises_px), SIZE_WH)
    assert len(kept) == used


def test_a_long_video_is_used_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """A board that is filmed in the middle first, in more places than are used, and then in the corners."""
    lens = plumb_bob(1500, (-0.2, 0.05, 0.001, -0.001))
    middle, everywhere = (views(lens, deg, count, ranges=(18.0, 24.0)) for deg, count in ((16, 600), (65, 75)))
    found = filmed(monkeypatch, [*middle, *everywhere])
    assert found.views <= VIEWS_MAX
    rays = np.array([[x, y, 1.0] for x in (-0.6, 0.0, 0.6) for y in (-0.34, 0.0, 0.34)])
    told, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), np.array(found.K), np.array(found.distortion))
    assert np.abs(told.reshape(-1, 2) - lens(rays)).max() < 2.0
    assert found.covered > 0.9


def test_views_that_do_not_settle_so_many_coefficients_are_told_as_that() -> None:
    seen = views(plumb_bob(1640, (-0.21, 0.06, 0.0, 0.0)), 60)
    used, fits = fit(seen, SIZE_WH)
    assert reason_against(8, fits, used, SIZE_WH) is None
    loose = {**fits, 8: replace(fits[8], focal_sigma=np.inf)}
    assert reason_against(8, loose, used, SIZE_WH) == (
        "the views do not determine 8 coefficients; show the board in more places. Or use fewer: --coefficients 5"
    )
    lost = {**fits, 8: replace(fits[8], rms_px=10.0)}
    assert str(reason_against(8, lost, used, SIZE_WH)).endswith("not a fisheye. Or use fewer: --coefficients 5")
    # What is not settled is no reason to refuse what is.
    assert reason_against(4, {**loose, 8: replace(loose[8], rms_px=0.0)}, used, SIZE_WH) is None


ALIKE = "the views are too similar to separate focal length and distance"
NONE_DESCRIBES = r"check that the board is flat, --squares correct, and the lens not a fisheye"
ENOUGH = (15.1, 15.1, 15.1, 14.9, 0.0)  # degrees: three tilted views are needed
TILTED, SETTLED = (ENOUGH,) * 3, (0.005,) * 3


def described(
    rms_px: tuple[float, float, float],
    focal_sigma: tuple[float, float, float],
    tilts_deg: tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]],
) -> dict[Coefficients, Fit]:
    """Fits of 4, 5 and 8 coefficients, of a lens that bends nothing."""
    K = np.array([[1640.0, 0, 963], [0, 1640, 536], [0, 0, 1]])
    numbers: tuple[Coefficients, ...] = (4, 5, 8)
    return {
        n: Fit(n, K, (0.0,) * max(n, 5), rms, sigma, np.full(len(tilts), rms), np.radians(tilts))
        for n, rms, sigma, tilts in zip(numbers, rms_px, focal_sigma, tilts_deg, strict=True)
    }


@pytest.mark.parametrize(
    ("chosen", "rms_px", "focal_sigma", "tilts_deg", "cells", "said"),
    [
        (4, (1.5, 1.5, 1.5), SETTLED, TILTED, 8, "None"),
        (4, (1.51, 1.51, 1.51), SETTLED, TILTED, 8, f".* is 1.51 px; {NONE_DESCRIBES}"),
        (4, (0.1, 0.1, 0.1), SETTLED, TILTED, 7, "the views cover only 44 % of the image; .*"),
        (4, (0.1, 0.1, 0.1), SETTLED, (ENOUGH[1:],) * 3, 8, rf"{ALIKE} \(2 of 4 are tilted\): .*"),
        (4, (0.1, 0.1, 0.1), (0.0061,) * 3, TILTED, 8, rf"{ALIKE} \(1 sigma 0.6 %\): .*"),
        # Of models that describe the views alike, the one with the fewest tilted; not one that describes them worse.
        (4, (0.1, 0.1, 0.1), SETTLED, (ENOUGH, ENOUGH[2:], ENOUGH), 8, rf"{ALIKE} \(1 of 5 are .*"),
        (8, (1.0, 0.1, 0.1), SETTLED, (ENOUGH[2:], ENOUGH, ENOUGH), 8, "None"),
        # A quarter less, and at least 0.02 px.
        (4, (1.0, 0.76, 0.76), SETTLED, TILTED, 8, "None"),
        (4, (1.0, 0.75, 0.74), SETTLED, TILTED, 8, ".* 1.00 px with 4 .* 0.75 px with 5: .* 5"),
        (4, (1.0, 0.75, 0.5), SETTLED, TILTED, 8, ".* 1.00 px with 4 .* 0.50 px with 8: .* 8"),
        (4, (0.06, 0.041, 0.041), SETTLED, TILTED, 8, "None"),
        (4, (0.06, 0.039, 0.039), SETTLED, TILTED, 8, ".* 0.06 px with 4 .* 0.04 px with 5: .* 5"),
        # No advice: what is as wrong, what is not settled, and fewer coefficients that describe the views worse.
        (4, (4.0, 1.6, 1.6), SETTLED, TILTED, 8, f".* 4.00 px; {NONE_DESCRIBES}"),
        (4, (1.0, 0.5, 0.5), (0.005, 0.0051, np.inf), TILTED, 8, "None"),
        (8, (1.0, 1.6, np.inf), SETTLED, TILTED, 8, f"the fit failed; {NONE_DESCRIBES}. .* fewer: .* 4"),
        (8, (1.0, 1.0, 0.9), (0.005, 0.0051, np.inf), TILTED, 8, ".* determine 8 .*; .*. Or .*: .* 4"),
        (8, (1.0, 1.0, 0.9), (np.inf, np.inf, np.inf), TILTED, 8, ".* 8 coeff.*; show .* in more places"),
    ],
)
def test_each_fault_has_its_limit_and_advice_that_helps(
    chosen: Coefficients,
    rms_px: tuple[float, float, float],
    focal_sigma: tuple[float, float, float],
    tilts_deg: tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]],
    cells: int,
    said: str,
) -> None:
    """`cells`: how many of the image's 16 the board was seen in, to both ends of each."""
    corners = np.array([[480.0 * (k % 4) + x, 270.0 * (k // 4) + x] for k in range(cells) for x in (1.0, 268.0)])
    seen = [View(np.arange(len(corners)), BOARD[: len(corners)], corners)] * len(tilts_deg[0])
    assert re.fullmatch(said, str(reason_against(chosen, described(rms_px, focal_sigma, tilts_deg), seen, SIZE_WH)))
