"""How much of each image an evaluation searches: as much as the daemon does in a frame of its camera."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from sim_replay.datasets import open_dataset
from sim_replay.evaluation.tracked import tracker_answers
from sim_replay.offline import estimator_answers, load_model
from tests.edge.toy_model import write_toy_model
from tests.edge.toy_scene import draw_faint

IMAGES = 5


@pytest.fixture
def faint_scene(dark_spot_scene: Path) -> Path:
    """A scene whose images show a target in their last tile only."""
    for path in (dark_spot_scene / "rgb").iterdir():
        path.unlink()
    for image in range(IMAGES):
        cv2.imwrite(str(dark_spot_scene / "rgb" / f"{image:06d}.png"), draw_faint())
    return dark_spot_scene


def test_a_single_image_is_searched_everywhere(faint_scene: Path, tmp_path: Path) -> None:
    answer = estimator_answers(load_model(write_toy_model(tmp_path / "toy.onnx"), threads=1))
    assert [len(answer(i, picture).poses) for i, picture in enumerate(open_dataset(faint_scene).frames())] == [1] * 5


@pytest.mark.parametrize(
    ("fps", "seen"),
    [
        (30.0, [0, 0, 0, 0, 0]),  # one of ten regions a frame
        (1.0, [0, 1, 1, 1, 1]),  # all of them, as soon as the camera's rate is known
    ],
)
def test_a_sequence_is_searched_as_much_as_its_frame_rate_allows(
    faint_scene: Path, tmp_path: Path, fps: float, seen: list[int]
) -> None:
    (faint_scene / "sequence.toml").write_text(f"fps = {fps}\n")
    answer = tracker_answers(load_model(write_toy_model(tmp_path / "toy.onnx"), threads=1))
    answers = [answer(i, picture) for i, picture in enumerate(open_dataset(faint_scene).frames())]
    assert [len(one.measured or ()) for one in answers] == seen
