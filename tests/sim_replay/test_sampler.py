"""Training windows: reproducible to the bit, and labelled as they look."""

from __future__ import annotations

import hashlib
import multiprocessing as mp
from concurrent.futures import ProcessPoolExecutor

import cv2
import numpy as np
import pytest

from msgs.geometry import so3_log
from sim_replay.airframes import AIRFRAMES
from sim_replay.render.distractors import BIRD_SHARE, WISP_SHARE, Decoy, add_decoy
from sim_replay.render.frame import outline_px, render_frame
from sim_replay.render.placing import (
    FOCAL_PX,
    FRAME_HEIGHT_PX,
    FRAME_WIDTH_PX,
    RANGE_M,
    draw_window,
    frame_scene,
)  # fmt: skip
from sim_replay.render.projection import extents_px
from sim_replay.sample import SampleBatch
from sim_replay.sampler import WindowSampler

SIZE = 96


@pytest.fixture(scope="module")
def sampler() -> WindowSampler:
    return WindowSampler(seed=7, size_px=SIZE)


@pytest.fixture(scope="module")
def batch(sampler: WindowSampler) -> SampleBatch:
    return sampler.batch(0, 96)


def _digest(sample: SampleBatch) -> str:
    digest = hashlib.sha256()
    for name in sorted(vars(sample)):
        digest.update(np.ascontiguousarray(getattr(sample, name)).tobytes())
    return digest.hexdigest()


def _digest_of_six(sampler: WindowSampler) -> str:
    return _digest(sampler.batch(37, 6))


def test_a_window_is_the_same_in_any_batch_and_any_process(sampler: WindowSampler, batch: SampleBatch) -> None:
    again = sampler.batch(37, 6)
    for name, values in vars(again).items():
        np.testing.assert_array_equal(values, getattr(batch, name)[37:43], err_msg=name)
    with ProcessPoolExecutor(1, mp.get_context("spawn")) as elsewhere:
        assert elsewhere.submit(_digest_of_six, sampler).result() == _digest(again)


def test_samplers_of_two_sizes_live_in_one_process(sampler: WindowSampler, batch: SampleBatch) -> None:
    small = WindowSampler(seed=7, size_px=64).batch(0, 4)
    assert small.image_bgr.shape == (4, 64, 64, 3)
    np.testing.assert_array_equal(sampler.batch(0, 4).image_bgr, batch.image_bgr[:4])


def test_coordinates_pose_and_intrinsics_agree(batch: SampleBatch) -> None:
    errors = []
    for k in np.flatnonzero(batch.present):
        inside = cv2.erode(batch.mask[k].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
        rows, columns = np.nonzero(inside)
        if len(rows) < 10:
            continue
        points = batch.noc[k][rows, columns].astype(np.float64) * float(batch.diameter_m[k])
        R, t, K = (a[k].astype(np.float64) for a in (batch.R_cam_target, batch.t_cam_target_m, batch.K))
        pixels = cv2.projectPoints(points, so3_log(R), t, K, None)[0][:, 0]
        errors.append(np.median(np.linalg.norm(pixels - np.stack([columns, rows], axis=-1), axis=1)))
    assert len(errors) > 40
    assert np.max(errors) < 0.75
    assert np.median(errors) < 0.2


def test_boxes_hold_their_masks(batch: SampleBatch) -> None:
    checked = 0
    for k in np.flatnonzero(batch.present):
        x, y = np.flatnonzero(batch.mask[k].any(axis=0)), np.flatnonzero(batch.mask[k].any(axis=1))
        seen = np.array([x[0] - 0.5, y[0] - 0.5, x[-1] + 0.5, y[-1] + 0.5])
        assert np.all(batch.box_xyxy_px[k] >= -0.5)
        assert np.all(batch.box_xyxy_px[k] <= SIZE - 0.5)
        checked += int(np.abs(batch.box_xyxy_px[k] - seen).max() <= 1.5)
    # Hair-thin tips cover less than a mask's share of their pixels, so a few boxes reach further.
    assert checked > 0.9 * batch.present.sum()


def test_without_a_target_labels_are_blank(batch: SampleBatch) -> None:
    absent = ~batch.present
    assert 0.03 < absent.mean() < 0.35
    assert not batch.mask[absent].any()
    assert not batch.noc[absent].any()
    assert np.all(batch.airframe_id[absent] == -1)
    np.testing.assert_array_equal(batch.R_cam_target[absent], np.tile(np.eye(3), (absent.sum(), 1, 1)))
    assert np.all(batch.airframe_id[batch.present] >= 0)


def test_the_target_shows_in_the_picture(sampler: WindowSampler) -> None:
    """The masked pixels differ from their surroundings far more than the background does from itself."""
    sample = sampler.batch(200, 64)
    contrast = []
    for k in np.flatnonzero(sample.present):
        grey = cv2.cvtColor(sample.image_bgr[k], cv2.COLOR_BGR2GRAY).astype(float)
        ring = cv2.dilate(sample.mask[k].astype(np.uint8), np.ones((9, 9))) - sample.mask[k].astype(np.uint8) > 0
        contrast.append(np.abs(grey[sample.mask[k]] - np.median(grey[ring])).mean())
    assert np.median(contrast) > 12


def test_frames_follow_the_benchmark_statistics_but_for_more_small_targets() -> None:
    rng = np.random.default_rng(3)
    share, ranges, longer_px = [], [], []
    for _ in range(500):
        scene = frame_scene(rng, range(len(AIRFRAMES)))
        box = extents_px(outline_px(scene.targets[0], scene.camera))
        assert box is not None
        share.append((box[2] - box[0]) * (box[3] - box[1]) / (FRAME_WIDTH_PX * FRAME_HEIGHT_PX))
        longer_px.append(max(box[2] - box[0], box[3] - box[1]))
        ranges.append(np.linalg.norm(scene.targets[0].t_ned_body_m - scene.camera.t_ned_cam_m))
        fx, fy = scene.camera.K[0, 0], scene.camera.K[1, 1]
        assert FOCAL_PX[0] * 0.98 < min(fx, fy) <= max(fx, fy) < FOCAL_PX[1] * 1.02
        assert abs(np.log(fx / fy)) < 0.03
    assert 0.006 < np.mean(share) < 0.016
    assert 0.06 < np.mean(np.array(longer_px) < 40.0) < 0.2
    assert RANGE_M[0] <= min(ranges) < 110
    assert 500 < max(ranges) <= RANGE_M[1]


def test_windows_show_targets_as_large_as_the_stages_will() -> None:
    track, acquire = [], []
    for index in range(300):
        window = draw_window(1, index, 128, range(len(AIRFRAMES)), 0.3, 0.0)
        box = extents_px(outline_px(window.scene.targets[0], window.scene.camera)) if window.scene.targets else None
        if box is None or window.visible_share < 0.999:
            continue
        side = max(box[2] - box[0], box[3] - box[1]) / window.scene.camera.width_px
        (acquire if window.kind == "acquire" else track).append(side)
    assert 1 / (1.8 * 1.34) < min(track) < 0.47
    assert 0.7 < max(track) < 1 / (1.8 * 0.74)
    assert min(acquire) * 128 < 16
    assert max(acquire) * 128 > 80


def test_whole_frames_are_squashed_with_their_camera() -> None:
    """A whole frame's outline, scaled by hand, is where the squashed picture shows the target."""
    seed, size = 9, 320
    batch = WindowSampler(seed, size, range(3), 1.0, 0.0, acquire_view="frame").batch(0, 16)
    whole = 0
    for index in np.flatnonzero(batch.present):
        window = draw_window(seed, int(index), size, range(3), 1.0, 0.0, acquire_view="frame")
        rng = np.random.default_rng([seed, index, size])
        rng.random(3)  # which stage, whether empty, whether birds are about
        frame = frame_scene(rng, range(3))
        x0, y0, x1, y1 = extents_px(outline_px(frame.targets[0], frame.camera))
        if min(x0, y0) < 0 or x1 > FRAME_WIDTH_PX - 1 or y1 > FRAME_HEIGHT_PX - 1:
            continue
        whole += 1
        by_hand = (np.array([x0, y0, x1, y1]) + 0.5) * ([size / FRAME_WIDTH_PX, size / FRAME_HEIGHT_PX] * 2) - 0.5
        np.testing.assert_allclose(
            extents_px(outline_px(window.scene.targets[0], window.scene.camera)), by_hand, atol=0.01
        )
        y, x = np.nonzero(batch.mask[index])
        np.testing.assert_allclose([x.min(), y.min(), x.max(), y.max()], by_hand, atol=2.0)
    assert whole > 8


def test_most_windows_without_a_target_show_a_decoy_as_large_as_one() -> None:
    sampler = WindowSampler(seed=4, size_px=64, acquire_share=0.0, empty_share=1.0)
    batch = sampler.batch(0, 200)
    assert not batch.present.any()
    decoys = 0
    for index in range(200):
        window = draw_window(4, index, 64, range(len(AIRFRAMES)), 0.0, 1.0)
        if window.decoy is None:
            continue
        decoys += 1
        side = window.scene.camera.width_px
        assert 0.8 / (1.8 * 1.34) < window.decoy.span_px / side < 1.25 / (1.8 * 0.74)
        assert np.all(np.abs(np.array(window.decoy.center_px) / side - 0.5) < 0.18)
    assert 0.65 < decoys / 200 < 0.85


def test_a_decoy_is_drawn_where_it_is_meant_to_be_and_no_two_alike() -> None:
    sky = np.full((96, 96, 3), 180, np.uint8)
    birds_and_wisps = [seed for seed in range(40) if np.random.default_rng(seed).random() < WISP_SHARE + BIRD_SHARE]
    drawn = [add_decoy(sky, Decoy((60.0, 40.0), 40.0), np.random.default_rng(seed)) for seed in birds_and_wisps]
    covers = [np.abs(image.astype(int) - sky).max(axis=2) > 4 for image in drawn]
    for cover in covers:
        rows, columns = np.nonzero(cover)
        assert 40 <= columns.mean() <= 80
        assert 20 <= rows.mean() <= 60
        assert 12 < max(np.ptp(rows), np.ptp(columns)) < 64
    assert len({cover.tobytes() for cover in covers}) == len(birds_and_wisps) > 15


def test_only_the_airframes_asked_for_appear() -> None:
    sample = WindowSampler(seed=2, size_px=64, airframe_ids=(1, 4), empty_share=0.0, acquire_share=0.0).batch(0, 16)
    assert set(sample.airframe_id[sample.present].tolist()) == {1, 4}


def test_a_whole_frame_differs_from_the_next_by_noise_and_exposure_alone() -> None:
    scene = frame_scene(np.random.default_rng(5), [0])
    a, b = (render_frame(type(scene)(scene.camera, scene.targets, scene.environment, 9, frame)) for frame in (0, 1))
    assert a.image_bgr.shape == (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3)
    np.testing.assert_array_equal(a.targets[0].mask_visib, b.targets[0].mask_visib)
    difference = a.image_bgr.astype(np.int16) - b.image_bgr
    assert 0.0 < np.abs(difference).mean() < 12
    assert abs(difference.mean()) < 3
