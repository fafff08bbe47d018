"""What is flown has a rate, evenly spaced pictures and telemetry of all of them, or a sentence says why not."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from sim_replay.cli import main
from sim_replay.ground_truth import read_scene_truth, read_sequence
from sim_replay.play import Recording
from sim_replay.result import judge, score_json
from tests.sim_replay.toy_flight import write_toy_flight

FRAMES = 30


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    return write_toy_flight(tmp_path / "flight", FRAMES)


def change(folder: Path, before: str, after: str) -> None:
    path = folder / "sequence.toml"
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


def refusal(folder: Path, capsys: pytest.CaptureFixture[str]) -> str:
    """What `play` says of a sequence that it does not take."""
    assert main(["play", "--sequence", str(folder), "--out", str(folder.parent / "out")]) == 2
    return capsys.readouterr().err


@pytest.mark.parametrize("t0_ns", [-1_200_000_000, 1_300_000_000, 900_000_000_000])
def test_telemetry_that_does_not_span_the_pictures_is_refused(
    t0_ns: int, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change(flight, "t0_ns = 0", f"t0_ns = {t0_ns}")
    told = refusal(flight, capsys)
    assert f"{flight / 'telemetry.csv'}: tells of -1.000 s to 3.980 s" in told
    assert f"from {t0_ns * 1e-9:.3f} s to {t0_ns * 1e-9 + (FRAMES - 1) / 10:.3f} s" in told


@pytest.mark.parametrize("from_s", [0.0, 0.08])
def test_telemetry_may_begin_with_the_pictures_or_a_row_later(from_s: float, tmp_path: Path) -> None:
    assert read_sequence(write_toy_flight(tmp_path / "flight", FRAMES, from_s=from_s)).frame0_ns == 0


def test_a_gap_in_the_numbers_of_a_flown_sequence_is_refused(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in (11, 12):
        (flight / "rgb" / f"{number:06d}.png").unlink()
    assert "picture 13 follows picture 10, but 1 follows 0" in refusal(flight, capsys)
    assert len(read_scene_truth(flight).images) == FRAMES - 2  # as stills they are taken


def test_what_labels_do_not_say_of_who_is_seen_is_seen_by_the_model_as_evaluate_does(dark_spot_scene: Path) -> None:
    """A target 200 m away and 120 m aside is in front of the camera, and outside its picture."""
    gt = dark_spot_scene / "scene_gt.json"
    poses = json.loads(gt.read_text())
    poses["1"][0]["cam_t_m2c"][0] = 120_000.0
    gt.write_text(json.dumps(poses))
    assert [truth.visible for truth in read_scene_truth(dark_spot_scene).truths] == [True, False, True, True]
    seen = {"bbox_visib": [9, 9, 9, 9], "px_count_visib": 60}
    (dark_spot_scene / "scene_gt_info.json").write_text(json.dumps({"1": [seen]}))  # what is said counts
    assert all(truth.visible for truth in read_scene_truth(dark_spot_scene).truths)


def test_the_pictures_of_a_recording_keep_their_times_and_its_labels_their_pictures(
    flight: Path, dark_spot_scene: Path
) -> None:
    change(flight, "fps = 10.0", 'fps = 10.0\nsource = "flight.mcap"')
    for number in (11, 12):
        (flight / "rgb" / f"{number:06d}.png").unlink()
    scene = read_sequence(flight).scene
    assert [len(listed) for listed in (scene.images, scene.K, scene.distortions, scene.cameras_world)] == [FRAMES] * 4
    assert [path.stem for path in scene.images[9:15]] == [f"{number:06d}" for number in (9, 10, 10, 10, 13, 14)]
    assert scene.unrecorded == {11, 12}

    for name in ("telemetry.csv", "sequence.toml"):
        shutil.copyfile(flight / name, dark_spot_scene / name)
    (dark_spot_scene / "rgb" / "000002.jpg").unlink()
    sequence = read_sequence(dark_spot_scene)
    assert [truth.frame for truth in sequence.scene.truths] == [0, 1, 3]
    score = score_json(sequence, judge(sequence, Recording(0, 0, 1, "tcp/127.0.0.1:1")), {})
    assert (score["overall"]["frames"], score["overall"]["targets"]) == (4, 3)


def test_every_other_picture_is_a_sequence(flight: Path) -> None:
    for number in range(1, FRAMES, 2):
        (flight / "rgb" / f"{number:06d}.png").unlink()
    change(flight, "fps = 10.0", "fps = 5.0")
    assert len(read_sequence(flight).scene.images) == FRAMES // 2


@pytest.mark.parametrize("fps", ["0", "0.0", "-30.0", "nan", "inf"])
def test_a_rate_that_is_none_is_refused(fps: str, flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change(flight, "fps = 10.0", f"fps = {fps}")
    assert f"{flight / 'sequence.toml'}: fps is {float(fps):g}; it must be a number above 0" in refusal(flight, capsys)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ("t0_ns = 0", "t0_ns = inf", "not as expected"),
        ("fps = 10.0", "fps = 1" + "0" * 400, "not as expected"),
        ("fps = 10.0", "fps = 1e-320", "it must be a number above 0, at least 0.001"),
    ],
)
def test_a_number_that_no_clock_counts_to_is_refused(
    before: str, after: str, words: str, flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    change(flight, before, after)
    told = refusal(flight, capsys)
    assert f"{flight / 'sequence.toml'}: " in told
    assert words in told
