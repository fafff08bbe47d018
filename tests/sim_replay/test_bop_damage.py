"""Whatever the files of a dataset hold, reading them ends in frames or in a sentence that names the file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_replay.bop import DISTORTION_KEY, BopError
from sim_replay.bop.scene import read_picture_bgr, refuse_broken
from sim_replay.datasets import open_dataset

UNIT = [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
FILES: dict[str, Any] = {
    "test/000001/scene_camera.json": {"3": {"cam_K": [900, 0, 80, 0, 900, 45, 0, 0, 1], DISTORTION_KEY: [0.1] * 5}},
    "test/000001/scene_gt.json": {"3": [{"obj_id": 1, "cam_R_m2c": UNIT, "cam_t_m2c": [0, 0, 2e5]}]},
    "test/000001/scene_gt_info.json": {"3": [{"bbox_visib": [70, 40, 9, 9], "px_count_visib": 50}]},
    "models/models_info.json": {"1": {"diameter": 9e3, "min_x": 0, "min_y": 0, "min_z": 0, "size_x": 9e3}},
    "test_targets_bop19.json": [{"scene_id": 1, "im_id": 3, "obj_id": 1, "inst_count": 1}],
}
numbers = st.integers() | st.floats() | st.just(10**400)
values = st.recursive(
    st.none() | st.booleans() | numbers | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.sampled_from(["3", "1", "size"]), inner, max_size=3),
    max_leaves=6,
)


def places(value: Any, at: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Where each value inside lies: keys and indices from the top."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [at] + [place for key, child in inner for place in places(child, (*at, key))]


def replaced(value: Any, at: tuple[Any, ...], new: Any) -> Any:
    if not at:
        return new
    copy = value.copy()
    copy[at[0]] = replaced(value[at[0]], at[1:], new)
    return copy


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    (folder / "test" / "000001" / "rgb").mkdir(parents=True)
    (folder / "models").mkdir()
    cv2.imwrite(str(folder / "test" / "000001" / "rgb" / "3.png"), np.zeros((90, 160, 3), np.uint8))
    return folder


def write(root: Path, files: dict[str, Any]) -> None:
    for name, value in files.items():
        (root / name).write_text(json.dumps(value))


def test_the_whole_dataset_reads(root: Path) -> None:
    write(root, FILES)
    (frame,) = open_dataset(root, "test").frames()
    assert [target.object_id for target in frame.targets] == [1]


@given(name=st.sampled_from(sorted(FILES)), data=st.data())
@settings(max_examples=150, deadline=None)
def test_one_value_that_is_anything_gives_frames_or_a_sentence(root: Path, name: str, data: st.DataObject) -> None:
    at = data.draw(st.sampled_from(places(FILES[name])))
    write(root, FILES | {name: replaced(FILES[name], at, data.draw(values))})
    try:
        dataset = open_dataset(root, "test")
        frames, models = list(dataset.frames()), dataset.models
    except BopError as error:
        said = str(error)
    else:
        assert all(np.isfinite(target.t_cam_target_m).all() for frame in frames for target in frame.targets)
        assert all(model.diameter_m > 0 for model in models.values())
        return
    assert Path(name).name in said or "rgb" in said


@pytest.mark.parametrize("progressive", [0, 1])
def test_a_jpeg_that_is_cut_short_is_named_and_not_filled_up_with_gray(tmp_path: Path, progressive: int) -> None:
    """A copy that broke off would be a picture without its target; what lies behind a whole one does no harm."""
    image = np.random.default_rng(1).integers(0, 255, (90, 160, 3), np.uint8)
    path, options = tmp_path / "000003.jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive]
    small = cv2.imencode(".jpg", image[:16, :16])[1].tobytes()
    whole = cv2.imencode(".jpg", image, options)[1].tobytes()
    thumbnail = b"\xff\xe1" + (len(small) + 2).to_bytes(2, "big") + small
    with_thumbnail = whole[:2] + thumbnail + whole[2:]
    for coded in (whole, with_thumbnail, whole + b"\xff\xda and a film"):
        path.write_bytes(coded)
        np.testing.assert_array_equal(read_picture_bgr(path), cv2.imdecode(np.frombuffer(whole, np.uint8), 1))
    for length in (len(whole) - 2, len(whole) // 2, 300):
        for torn in (whole[:length], with_thumbnail[: len(thumbnail) + length]):
            path.write_bytes(torn)
            with pytest.raises(BopError, match=r"000003\.jpg is cut short"):
                read_picture_bgr(path)


@pytest.mark.parametrize("kind", [".jpg", ".png", ".bmp", ".tif"])
def test_a_picture_that_is_cut_short_is_refused_before_it_is_drawn(tmp_path: Path, kind: str) -> None:
    """Its header still tells its size; what a camera appends is no damage."""
    image = np.random.default_rng(1).integers(0, 255, (90, 160, 3), np.uint8)
    whole, path = cv2.imencode(kind, image)[1].tobytes(), tmp_path / f"000003{kind}"
    for coded in (whole, whole + b"maker's notes" * 1000):
        path.write_bytes(coded)
        refuse_broken(path)
    for length in (len(whole) - 12, len(whole) // 2):
        path.write_bytes(whole[:length])
        with pytest.raises(BopError, match=rf"000003\{kind} is (cut short|not a readable picture)"):
            refuse_broken(path)


def test_a_picture_that_cannot_be_read_is_named_like_one_that_is_none(tmp_path: Path) -> None:
    """As on a disk that fails, or of another user: what reads it knows BopError alone."""
    (tmp_path / "000003.png").mkdir()
    for name in ("000003.png", "0" * 300):
        with pytest.raises(BopError, match=f"{name} cannot be read"):
            read_picture_bgr(tmp_path / name)
