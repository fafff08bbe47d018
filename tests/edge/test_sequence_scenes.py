"""BOP scenes of others as a camera: gray pictures, gaps in the numbers, lenses with distortion, broken indices."""

from __future__ import annotations

import json
import threading
import time
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.cameras.capture import Capture
from edge.cameras.folder import FolderSource
from edge.cameras.sequence import DISTORTION_KEY, SequenceSource
from edge.config_camera import FolderCamera, IntrinsicsSettings, SequenceCamera
from edge.errors import InputError
from edge.types import Frame
from tests.waiting import until

from .pictures import play

SIZE_WH = (320, 180)
LENS = (-0.25, 0.08, 0.002, -0.001, -0.01)
# Points on a plane 10 m ahead, well apart in the picture.
POINTS_CAM_M = np.array([[x, y, 10.0] for x in (-4.0, -1.5, 1.5, 4.0) for y in (-2.0, 0.5, 2.0)])


def camera(focal_px: float) -> np.ndarray:
    return np.array([[focal_px, 0.0, 159.5], [0.0, focal_px, 89.5], [0.0, 0.0, 1.0]])


def dots(K: np.ndarray, lens: tuple[float, ...]) -> np.ndarray:
    """A gray picture [H, W] with a soft dot where the lens puts each point."""
    pixels, _ = cv2.projectPoints(POINTS_CAM_M, np.zeros(3), np.zeros(3), K, np.array(lens))
    x, y = np.meshgrid(np.arange(SIZE_WH[0]), np.arange(SIZE_WH[1]))
    apart2 = ((np.stack([x, y], axis=-1)[:, :, None] - pixels.reshape(-1, 2)) ** 2).sum(axis=-1)
    return (255 * np.exp(-apart2 / 8.0)).sum(axis=-1).clip(0, 255).astype(np.uint8)


def centroid(image_bgr: np.ndarray, near_px: np.ndarray) -> np.ndarray:
    left, top = np.round(near_px).astype(int) - 5
    weight = image_bgr[top : top + 11, left : left + 11, 0].astype(float)
    y, x = np.mgrid[0:11, 0:11]
    return np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum() + (left, top)


def frames_of(folder: Path, intrinsics: IntrinsicsSettings | None = None) -> list[Frame]:
    return play(SequenceSource(SequenceCamera(type="sequence", path=folder, fps=4, intrinsics=intrinsics)))


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Pictures 7, 20 and 21, gray, by another lens each; a camera for picture 3 too, that is not there."""
    folder = tmp_path / "000012"
    (folder / "gray").mkdir(parents=True)
    cameras = {}
    for image_id, focal_px, lens in ((7, 300.0, LENS), (20, 300.0, None), (21, 320.0, LENS), (3, 300.0, None)):
        K = camera(focal_px)
        cameras[str(image_id)] = {"cam_K": K.ravel().tolist()} | ({} if lens is None else {DISTORTION_KEY: lens})
        if image_id != 3:
            suffix = "TIF" if image_id == 20 else "tif"
            cv2.imwrite(str(folder / "gray" / f"{image_id:04d}.{suffix}"), dots(K, lens or (0.0,) * 5))
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    return folder


def test_every_frame_is_as_on_disk_and_says_what_its_lens_does(scene: Path) -> None:
    frames = frames_of(scene)
    assert [frame.K[0, 0] for frame in frames] == [300.0, 300.0, 320.0]
    for frame in frames:
        lens = np.array(frame.distortion or (0.0,) * 5)
        seen, _ = cv2.projectPoints(POINTS_CAM_M, np.zeros(3), np.zeros(3), frame.K, lens)
        for expected in seen.reshape(-1, 2):
            np.testing.assert_allclose(centroid(frame.image_bgr, expected), expected, atol=0.25)


@pytest.mark.parametrize(("scale", "dark"), [(16, True), (257, False)])
def test_pictures_of_a_deep_camera_that_were_not_scaled_are_warned_of(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, scale: int, dark: bool
) -> None:
    pixels = dots(camera(300.0), LENS)
    cv2.imwrite(str(tmp_path / "0.png"), pixels.astype(np.uint16) * scale)
    plain = IntrinsicsSettings(fx=310, fy=310, cx=159.5, cy=89.5, width=SIZE_WH[0], height=SIZE_WH[1])
    (frame,) = play(FolderSource(FolderCamera(type="folder", path=tmp_path, fps=4, intrinsics=plain)))
    np.testing.assert_array_equal(frame.image_bgr[:, :, 0], pixels.astype(np.uint16) * scale >> 8)
    assert ("do not use the upper two" in caplog.text) == dark


def test_what_macos_writes_beside_a_folder_s_pictures_is_none_of_them(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "0.png"), dots(camera(300.0), LENS))
    (tmp_path / "._0.png").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        ")
    plain = IntrinsicsSettings(fx=310, fy=310, cx=159.5, cy=89.5, width=SIZE_WH[0], height=SIZE_WH[1])
    assert len(play(FolderSource(FolderCamera(type="folder", path=tmp_path, fps=4, intrinsics=plain)))) == 1


def test_a_calibration_of_ones_own_takes_the_place_of_the_scenes(scene: Path) -> None:
    plain = IntrinsicsSettings(fx=310, fy=310, cx=159.5, cy=89.5, width=SIZE_WH[0], height=SIZE_WH[1])
    frames = frames_of(scene, plain)
    assert [(frame.K[0, 0], frame.distortion) for frame in frames] == [(310.0, ())] * 3
    # Its lens has no distortion, so the pixels stay what they are on disk.
    np.testing.assert_array_equal(frames[0].image_bgr[:, :, 0], dots(camera(300.0), LENS))


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({}, r"scene_camera\.json: '7' has no 'cam_K'"),
        ({"cam_K": [1, 0, 0]}, r"'cam_K' of '7' is not 9 finite numbers"),
        ({"cam_K": [float("nan")] * 9}, r"'cam_K' of '7' is not 9 finite numbers"),
        ({"cam_K": [300, 0, 160, 0, "3OO", 90, 0, 0, 1]}, r"'cam_K' of '7' is not 9 finite numbers"),
        ({"cam_K": [300, 0, 160, 0, -300, 90, 0, 0, 1]}, r"'cam_K' of '7' has no positive focal lengths"),
        ({"cam_K": camera(300.0).T.ravel().tolist()}, r"scene_camera\.json: 'cam_K' of '7' is not, row by row"),
        ({"cam_K": [300, 0, 160, 0, 300, 90, 0, 0, 0]}, r"scene_camera\.json: 'cam_K' of '7' is not, row by row"),
        ({"cam_K": [300, 0, 160, 5, 300, 90, 0, 0, 1]}, r"scene_camera\.json: 'cam_K' of '7' is not, row by row"),
        ({"cam_K": np.eye(3).ravel().tolist(), DISTORTION_KEY: [0.1, "a"]}, rf"'{DISTORTION_KEY}' of '7' is not 5"),
    ],
)
def test_a_broken_index_is_told_with_file_and_key(scene: Path, entry: dict[str, object], said: str) -> None:
    (scene / "scene_camera.json").write_text(json.dumps({"7": entry}))
    with pytest.raises(InputError, match=said):
        SequenceSource(SequenceCamera(type="sequence", path=scene)).open()


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.0])
def test_a_camera_for_pictures_of_another_size_is_warned_of(
    scene: Path, scale: float, caplog: pytest.LogCaptureFixture
) -> None:
    cameras = json.loads((scene / "scene_camera.json").read_text())
    for entry in cameras.values():
        entry["cam_K"][:6] = [scale * value for value in entry["cam_K"][:6]]
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    with closing(SequenceSource(SequenceCamera(type="sequence", path=scene))) as source:
        source.open()
    assert ("unless they were cropped, its cam_K is for another size" in caplog.text) == (scale != 1.0)


def test_a_picture_without_a_camera_is_told(scene: Path) -> None:
    cameras = json.loads((scene / "scene_camera.json").read_text())
    del cameras["20"]
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    with pytest.raises(InputError, match="no camera for picture 20"):
        SequenceSource(SequenceCamera(type="sequence", path=scene)).open()


def test_a_number_left_out_of_what_was_recorded_is_a_frame_that_was_dropped(scene: Path) -> None:
    (scene / "sequence.toml").write_text('source = "flight.mcap"\nfps = 100.0\n')
    now_ns = time.monotonic_ns()
    began_ns = now_ns - 20 * 86_400 * 1_000_000_000  # many rounds ago
    settings = SequenceCamera(type="sequence", path=scene, fps=100, loop=True, start_at_ns=began_ns)
    with closing(SequenceSource(settings)) as source:
        source.open()
        frames = [source.read(threading.Event()) for _ in range(4)]
        assert abs(frames[0].meta.capture_ns - now_ns) < 2_000_000_000
        # Of 15 frames a round, pictures 7, 20 and 21.
        assert {frame.meta.sequence % 15 for frame in frames} <= {0, 13, 14}
        apart = frames[1].meta.sequence - frames[0].meta.sequence
        assert frames[1].meta.capture_ns - frames[0].meta.capture_ns == pytest.approx(apart * 1e7, abs=1)
        shown = source.exposed_now(13, 0).image_bgr
        np.testing.assert_array_equal(shown[:, :, 0], dots(camera(300.0), (0.0,) * 5))
        np.testing.assert_array_equal(source.exposed_now(15 + 13, 1).image_bgr, shown)
        with pytest.raises(InputError, match="no picture 12 among its 15 frames"):
            source.exposed_now(12, 2)
    (scene / "sequence.toml").write_text("fps = 100.0\n")  # not recorded: any numbers, one after the other
    assert [frame.meta.sequence for frame in frames_of(scene)] == [0, 1, 2]


def test_a_gap_counts_as_dropped_frames_and_not_as_a_frozen_camera(scene: Path) -> None:
    (scene / "sequence.toml").write_text('source = "flight.mcap"\nfps = 20.0\n')
    source = SequenceSource(SequenceCamera(type="sequence", path=scene, fps=20))
    source.open()
    capture = Capture(source, opened=True)
    capture.start()
    try:
        counted = capture.counters
        until(lambda: counted()["captured"] + counted()["dropped_at_source"] == 15, what="the last frame")
    finally:
        capture.stop()
    assert counted()["captured"] <= 3
    assert counted()["frozen"] == 0


@pytest.mark.parametrize("text", ["fps = ", "\xff"])
def test_a_sequence_toml_that_cannot_be_read_is_told(text: str, scene: Path) -> None:
    (scene / "sequence.toml").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"000012/sequence\.toml: cannot be read"):
        SequenceSource(SequenceCamera(type="sequence", path=scene)).open()
