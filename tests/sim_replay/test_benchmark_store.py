"""A scene folder stopped anywhere stays readable and ends up the same as one made in one go; video keeps its order."""

from __future__ import annotations

import hashlib
import resource
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from sim_replay.benchmark.scene_store import SceneStore, is_finished
from sim_replay.benchmark.video import through_h264
from sim_replay.bop import BopFrame, BopTarget, read_scene

K = np.array([[300.0, 0.0, 31.5], [0.0, 300.0, 23.5], [0.0, 0.0, 1.0]])


def _frame(number: int) -> tuple[BopFrame, np.ndarray, list[np.ndarray]]:
    mask = np.zeros((48, 64), bool)
    mask[10:20, 5 + number : 25 + number] = True
    box = np.array([4.5 + number, 9.5, 24.5 + number, 19.5])
    target = BopTarget(3, np.eye(3), np.array([0.1, 0.2, 200.0 + number]), box, box, int(mask.sum()), int(mask.sum()))
    image = np.full((48, 64, 3), 10 * number + 40, np.uint8)
    return BopFrame(number, K, (target,), np.eye(3), np.array([1.0, 2.0, 3.0])), image, [mask]


def _add(store: SceneStore, number: int) -> None:
    frame, image, masks = _frame(number)
    store.add(frame, image, masks, masks)


def _finish(store: SceneStore) -> None:
    store.finish({"telemetry.csv": lambda path: path.write_text("t\n") and None}, "fps = 30.0\n")


def _digests(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture
def in_one_go(tmp_path: Path) -> Path:
    folder = tmp_path / "whole"
    with SceneStore(folder, 90) as store:
        for number in range(4):
            _add(store, number)
        _finish(store)
    return folder


def test_what_was_added_is_readable_before_the_scene_is_finished(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    with SceneStore(folder, 90) as store:
        for number in (0, 1):
            _add(store, number)
            frames = read_scene(folder).frames
            assert [frame.image_id for frame in frames] == list(range(number + 1))
            assert read_scene(folder).image_bgr(frames[-1]).mean() == pytest.approx(10 * number + 40, abs=2)
        assert not is_finished(folder)


def test_a_stop_in_the_middle_of_a_journal_line_costs_that_frame_alone(tmp_path: Path, in_one_go: Path) -> None:
    folder = tmp_path / "scene"
    with SceneStore(folder, 90) as store:
        for number in range(3):
            _add(store, number)
    journal = folder / ".part" / "journal.jsonl"
    journal.write_bytes(journal.read_bytes()[:-20])
    with SceneStore(folder, 90) as store:
        assert store.done == {0, 1}
        assert [frame.image_id for frame in read_scene(folder).frames] == [0, 1]
        for number in (2, 3):
            _add(store, number)
        _finish(store)
    assert is_finished(folder)
    assert _digests(folder) == _digests(in_one_go)


def test_a_half_written_frame_is_made_again(tmp_path: Path, in_one_go: Path) -> None:
    folder = tmp_path / "scene"
    with SceneStore(folder, 90) as store:
        for number in range(2):
            _add(store, number)
    (folder / "rgb" / "000002.jpg").write_bytes(b"torn")
    shutil.copytree(folder / "mask", folder / ".part" / "frame" / "mask", dirs_exist_ok=True)
    with SceneStore(folder, 90) as store:
        assert store.done == {0, 1}
        for number in (2, 3):
            _add(store, number)
        _finish(store)
    assert _digests(folder) == _digests(in_one_go)


def test_raw_pictures_outlive_a_stop_and_are_gone_in_the_end(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    for number in range(3):
        with SceneStore(folder, 90, keep_raw=True) as store:
            _add(store, number)
    with SceneStore(folder, 90, keep_raw=True) as store:
        assert [int(image.mean()) for image in store.raw_images()] == [40, 50, 60]
        store.replace_images(255 - image for image in store.raw_images())
        _finish(store)
    scene = read_scene(folder)
    means = [scene.image_bgr(frame).mean() for frame in scene.frames]
    np.testing.assert_allclose(means, [215, 205, 195], atol=2)
    assert not (folder / ".part").exists()


def test_labels_alone_need_no_picture(tmp_path: Path) -> None:
    folder = tmp_path / "scene"
    with SceneStore(folder, 90, pictures=False) as store:
        store.add(_frame(7)[0], None)
        _finish(store)
    assert sorted(path.name for path in folder.iterdir()) == [
        "scene_camera.json", "scene_gt.json", "scene_gt_info.json", "sequence.toml", "telemetry.csv",
    ]  # fmt: skip
    assert read_scene(folder).frames[0].targets[0].t_cam_target_m[2] == pytest.approx(207.0)


def _moving_square(count: int) -> Iterator[np.ndarray]:
    texture = np.random.default_rng(2).integers(60, 190, (96, 160, 1), dtype=np.uint8).repeat(3, axis=2)
    for k in range(count):
        image = cv2.GaussianBlur(texture, (0, 0), 1.0)
        image[30:50, 10 + 6 * k : 30 + 6 * k] = 255
        yield np.asarray(image, np.uint8)


def test_video_keeps_number_and_order_and_loses_more_at_a_lower_bitrate() -> None:
    sent = list(_moving_square(12))
    losses = []
    for kbps in (100, 4000):
        got = list(through_h264(iter(sent), 30.0, kbps))
        assert len(got) == 12
        for k, image in enumerate(got):
            bright = np.flatnonzero(image[32:48].mean(axis=(0, 2)) > 235)
            assert bright.mean() == pytest.approx(19.5 + 6 * k, abs=1.5)
        losses.append(np.mean([np.abs(a.astype(int) - b).mean() for a, b in zip(got, sent, strict=True)]))
    assert losses[0] > 2 * losses[1] > 0
    assert abs(np.mean([a.astype(int).mean() - b.mean() for a, b in zip(got, sent, strict=True)])) < 0.5  # no tint
    again = list(through_h264(iter(sent), 30.0, 100))
    first = list(through_h264(iter(sent), 30.0, 100))
    assert all((a == b).all() for a, b in zip(again, first, strict=True))


@contextmanager
def full_disk(free_bytes: int) -> Iterator[None]:
    """No file gets larger than that."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (free_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("keep_raw", [False, True])
def test_a_picture_that_the_disk_has_no_room_for_is_an_error_and_no_frame(tmp_path: Path, keep_raw: bool) -> None:
    noise = np.random.default_rng(4).integers(0, 255, (48, 64, 3), dtype=np.uint8)
    frame, _, masks = _frame(0)
    with SceneStore(tmp_path / "scene", 20 if keep_raw else 100, keep_raw=keep_raw) as store:
        with full_disk(4096), pytest.raises(OSError, match="File too large"):
            store.add(frame, noise, masks, masks)
        assert store.done == frozenset()
    with SceneStore(tmp_path / "scene", 90, keep_raw=keep_raw) as store:
        assert store.done == frozenset()


@pytest.mark.parametrize("torn", [0, 0.5])
def test_a_frame_whose_raw_picture_is_torn_is_made_again(tmp_path: Path, torn: float) -> None:
    folder = tmp_path / "scene"
    with SceneStore(folder, 90, keep_raw=True) as store:
        for number in range(3):
            _add(store, number)
    raw = folder / ".part" / "raw" / "000001.png"
    raw.write_bytes(raw.read_bytes()[: int(torn * raw.stat().st_size)])
    with SceneStore(folder, 90, keep_raw=True) as store:
        assert store.done == {0, 2}
        _add(store, 1)
        assert [int(image.mean()) for image in store.raw_images()] == [40, 50, 60]
