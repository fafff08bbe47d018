"""Mount, latency and focal length from turns of camera and vehicle; SciPy's rotations are the oracle."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from edge.align.attitudes import AttitudeLog, Attitudes
from edge.align.fit import Alignment, UnknownError, align
from edge.align.turns import Sight, TurnTracker
from edge.estimator.own_parts import OwnParts
from edge.types import Array, Frame, FrameMeta

from .panorama import Panorama

FORWARD_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
MOUNT = Rotation.from_euler("ZYX", [20.0, -10.0, 3.0], degrees=True) * Rotation.from_matrix(FORWARD_CAM)
SPAN_S, SPANS = 0.2, 60
SIZE_WH = (320, 180)
K = np.array([[250.0, 0.0, 159.5], [0.0, 250.0, 89.5], [0.0, 0.0, 1.0]])
Motion = Callable[[Array], Rotation]  # at times [N] s


def turned(roll: float = 0.15, pitch: float = 0.12, yaw: float = 0.2, even: bool = False) -> Motion:
    """To and fro about the body's axes, by so many rad; `even`: always alike."""

    def attitude(t_s: Array) -> Rotation:
        waves = ((roll, 0.31, 0.53), (pitch, 0.41, 0.63), (yaw, 0.23, 0.57))
        angles = [
            a * (np.sin(2 * np.pi * (1.0 if even else f) * t_s) + (not even) * np.sin(2 * np.pi * g * t_s + f))
            for a, f, g in waves
        ]
        return Rotation.from_euler("ZYX", np.stack(angles[::-1], axis=-1))

    return attitude


def attitudes(motion: Motion, rate_hz: float = 50.0, noise_rad: float = 2e-4) -> Attitudes:
    t_s = np.arange(-3.0, SPANS * SPAN_S + 1.0, 1.0 / rate_hz)
    noise = Rotation.from_rotvec(np.random.default_rng(1).normal(0.0, noise_rad, (len(t_s), 3)))
    return Attitudes(np.round(t_s * 1e9).astype(np.int64), (motion(t_s) * noise).as_matrix(), np.zeros(len(t_s), int))


def sights(
    motion: Motion,
    mount: Rotation,
    late_s: float,
    focal: float = 1.0,
    readout_s: float = 0.0,
    told_s: float = 0.0,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> list[Sight]:
    """Points of a far scene, some of which move.

    Args:
        focal: Of the pictures' focal length to the one that is believed.
        readout_s: Over which the rows are exposed of pictures that are one focal length high; `told_s`: configured.
        lever: The camera's place on the body, in distances of the points.
    """
    rng, found = np.random.default_rng(2), []
    for t_s in np.arange(SPANS) * SPAN_S:
        before = rng.uniform(-0.5, 0.5, (40, 2))
        rays = np.concatenate([before, np.ones((40, 1))], axis=-1)
        ned = (motion(t_s + readout_s * before[:, 1]) * mount).apply(rays)
        at, then_at = motion(np.array([t_s, t_s + SPAN_S])).apply(lever)
        after = before
        for _ in range(6 if readout_s else 1):  # a point's row tells when it was seen, and that where
            x, y, z = (motion(t_s + SPAN_S + readout_s * after[:, 1]) * mount).inv().apply(ned + at - then_at).T
            after = np.stack([x / z, y / z], axis=-1)
        rows_s = [told_s * points[:, 1] for points in (before, after)]
        before, after = (focal * points + rng.normal(0, 2e-4, (40, 2)) for points in (before, after))
        after[:6] += 0.1
        start_ns, end_ns = (round((s + late_s) * 1e9) for s in (t_s, t_s + SPAN_S))
        found.append(Sight(start_ns, end_ns, before, after, *rows_s, 3e-3))
    return found


def off_deg(found: Alignment, mount: Rotation) -> float:
    return float(np.rad2deg((Rotation.from_matrix(found.R_body_cam).inv() * mount).magnitude()))


@settings(max_examples=5)
@given(
    st.integers(0, 2**32 - 1).map(lambda seed: Rotation.random(random_state=seed)),
    st.floats(-0.2, 1.5),
    st.floats(0.8, 1.25),
)
def test_any_mount_latency_and_focal_length_are_found(mount: Rotation, late_s: float, focal: float) -> None:
    found = align(sights(turned(), mount, late_s, focal), SPANS, attitudes(turned()))
    assert not found.wanting
    assert off_deg(found, mount) < 1.5 * np.rad2deg(found.mount_sure_rad) < 1.0
    assert abs(found.late_s - late_s) < 1.5 * found.late_sure_s < 0.005
    assert abs(found.focal_ratio - focal) < 1.5 * found.focal_sure < 0.02


@pytest.mark.parametrize(
    ("motion", "more"),
    [
        (turned(roll=0.0, pitch=0.0), "roll and pitch"),
        (turned(yaw=0.0, pitch=0.001), "pitch and yaw"),
    ],
)
def test_turning_about_one_axis_leaves_the_mount_unknown(motion: Motion, more: str) -> None:
    found = align(sights(motion, MOUNT, 0.06), SPANS, attitudes(motion))
    assert set(found.wanting) == {"mount"} if more == "roll and pitch" else "mount" in found.wanting
    assert more in found.wanting["mount"]
    assert abs(found.late_s - 0.06) < found.late_sure_s


def test_noise_of_the_attitude_draws_no_latency_between_its_samples() -> None:
    """The camera runs in step with the autopilot, so that all its pictures are taken at samples."""
    found = align(sights(turned(), MOUNT, 0.06), SPANS, attitudes(turned(), noise_rad=4e-3))
    assert not found.wanting
    assert abs(found.late_s - 0.06) < found.late_sure_s < 0.005


def test_two_axes_are_enough() -> None:
    found = align(sights(turned(roll=0.0), MOUNT, 0.06), SPANS, attitudes(turned(roll=0.0)))
    assert not found.wanting
    assert off_deg(found, MOUNT) < np.rad2deg(found.mount_sure_rad)


@pytest.mark.parametrize(
    ("camera", "vehicle", "rate_hz", "why"),
    [
        (turned(even=True), turned(even=True), 50.0, "several latencies"),
        (turned(), turned(roll=0.02, pitch=0.3, yaw=0.02), 50.0, "different turns"),
        (turned(0.001, 0.001, 0.001), turned(0.001, 0.001, 0.001), 50.0, "turned by only"),
        (turned(), turned(), 4.0, "only 4.0 times a second"),
    ],
)
def test_why_nothing_is_known_is_told(camera: Motion, vehicle: Motion, rate_hz: float, why: str) -> None:
    with pytest.raises(UnknownError, match=why):
        align(sights(camera, MOUNT, 0.06), SPANS, attitudes(vehicle, rate_hz))


@pytest.mark.parametrize(("told_s", "least_deg", "most_deg"), [(0.02, 0.0, 0.3), (0.0, 0.5, 180.0)])
def test_rows_that_are_exposed_one_after_the_other(told_s: float, least_deg: float, most_deg: float) -> None:
    found = align(sights(turned(), MOUNT, 0.06, 1.0, 0.02, told_s), SPANS, attitudes(turned()))
    assert least_deg < np.rad2deg(found.mount_sure_rad) < most_deg
    assert off_deg(found, MOUNT) < np.rad2deg(found.mount_sure_rad)
    assert abs(found.late_s - 0.06) < found.late_sure_s


def test_rows_that_are_read_the_other_way_round_are_asked_about() -> None:
    with pytest.raises(UnknownError, match="readout_ms"):
        align(sights(turned(), MOUNT, 0.06, 1.0, 0.02, -0.02), SPANS, attitudes(turned()))


@pytest.mark.parametrize(("lever", "known"), [((0.03, 0.0, 0.01), True), ((0.1, 0.0, 0.05), False)])
def test_near_things_make_the_mount_unsure(lever: tuple[float, float, float], known: bool) -> None:
    """With a camera that is moved while it turns."""
    found = align(sights(turned(), MOUNT, 0.06, lever=lever), SPANS, attitudes(turned()))
    assert ("mount" not in found.wanting) is known
    assert known or "near" in found.wanting["mount"]
    assert 0.2 < off_deg(found, MOUNT) < np.rad2deg(found.mount_sure_rad)


def test_an_attitude_that_jumped_is_not_compared_across_the_jump() -> None:
    log, told = AttitudeLog(), attitudes(turned())
    reset = Rotation.from_euler("z", 1.0)
    for index, (time_ns, R) in enumerate(zip(told.times_ns, told.R_ned_body, strict=True)):
        if index == len(told.times_ns) // 2:
            log.clear(same_autopilot=True)
        after = Rotation.from_matrix(R) if index < len(told.times_ns) // 2 else reset * Rotation.from_matrix(R)
        log.add_attitude(int(time_ns), np.roll(after.as_quat(), 1), np.zeros(3))
    found = align(sights(turned(), MOUNT, 0.06), SPANS, log.attitudes())
    assert not found.wanting
    assert SPANS - 2 <= found.spans < SPANS
    assert off_deg(found, MOUNT) < np.rad2deg(found.mount_sure_rad)


def filmed(motion: Motion, panorama: Panorama, late_s: float, fps: float = 12.0) -> Iterator[tuple[int, NDArray]]:
    for t_s in np.arange(0.0, 9.0, 1.0 / fps):
        yield round((t_s + late_s) * 1e9), panorama.picture(motion(np.array([t_s]))[0] * MOUNT)


def test_pictures_through_a_lens_whose_focal_length_is_not_quite_right() -> None:
    distortion = (-0.3, 0.1, 1e-3, -1e-3)
    believed = K.copy()
    believed[[0, 1], [0, 1]] *= 0.93
    tracker, seen = TurnTracker(), []
    for stamp_ns, image in filmed(turned(), Panorama(K, SIZE_WH, distortion), 0.12):
        seen.append(tracker.take(Frame(FrameMeta(0, stamp_ns, stamp_ns), image, believed, distortion)))
    found = align([one for one in seen if one is not None], tracker.attempts, attitudes(turned()))
    assert not found.wanting
    assert off_deg(found, MOUNT) < 0.3
    assert abs(found.late_s - 0.12) < 0.003
    assert abs(found.focal_ratio - 1.0 / 0.93) < 0.02


def test_pictures_that_show_nothing_give_nothing() -> None:
    tracker = TurnTracker()
    for number in range(60):
        blank = Frame(FrameMeta(number, number * 100_000_000, 0), np.full((180, 320, 3), 200, np.uint8), K)
        assert tracker.take(blank) is None
    with pytest.raises(UnknownError, match=r"seen in only 0 of 59 attempts.*far"):
        align([], tracker.attempts, attitudes(turned()))


@pytest.mark.parametrize("masked", [True, False])
def test_the_own_aircraft_in_the_picture_is_no_scene(masked: bool) -> None:
    wing = np.random.default_rng(3).integers(0, 256, (180, 200, 3), dtype=np.uint8)
    covered = np.zeros((180, 320), np.uint8)
    covered[:, 120:] = 255
    parts = OwnParts.of(covered, SIZE_WH) if masked else None
    tracker, sight = TurnTracker(), None
    panorama = Panorama(K, SIZE_WH)
    for number in range(3):
        image = panorama.picture(Rotation.from_euler("z", 0.02 * number) * MOUNT)
        image[:, 120:] = wing
        sight = tracker.take(Frame(FrameMeta(number, number * 100_000_000, 0), image, K, own_parts=parts))
    assert sight is not None
    w_cam = sight.turn_cam_rad()
    assert w_cam is not None
    true = MOUNT.inv().apply([0.0, 0.0, 0.04])
    assert bool(np.abs(w_cam - true).max() < 1e-3) is masked


def test_unknown_stamps_of_the_attitudes_make_the_latency_unsure_but_not_unknown() -> None:
    found = align(sights(turned(), MOUNT, 0.06), SPANS, replace(attitudes(turned()), clock_std_s=0.02))
    assert not found.wanting
    assert 0.04 < found.clock_sure_s < found.late_sure_s < 0.05


def test_a_glint_does_not_hide_a_hazy_scene() -> None:
    tracker, panorama, seen = TurnTracker(), Panorama(K, SIZE_WH), []
    for number in range(3):
        image = panorama.picture(Rotation.from_euler("z", 0.02 * number) * MOUNT)
        image = (118 + 0.15 * image).astype(np.uint8)
        image[50:54, 50:54], image[54:58, 50:54] = 255, 0
        seen.append(tracker.take(Frame(FrameMeta(number, number * 100_000_000, 0), image, K)))
    w_cam = None if seen[-1] is None else seen[-1].turn_cam_rad()
    assert w_cam is not None
    assert np.abs(w_cam - MOUNT.inv().apply([0.0, 0.0, 0.04])).max() < 1e-3
