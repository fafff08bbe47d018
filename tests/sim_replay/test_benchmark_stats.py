"""Statistics are those of the files: a small dataset whose every figure was worked out by hand."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from sim_replay.benchmark.contact_sheet import contact_sheet
from sim_replay.cli import main

# Scene: split, focal length, airframe, flight seed; of each frame the targets' (object id, z in m, box, seen of all).
SCENES: dict[str, tuple[float, str, int, list[list[tuple[int, float, list[int], int, int]]]]] = {
    "train/000000": (1500.0, "male_v_tail", 11, [[(1, 120.0, [10, 20, 64, 36], 100, 100)], []]),
    "train/000001": (2500.0, "light_aircraft", 12, [[(4, 480.0, [0, 0, 32, 18], 40, 80)]]),
    "test/000002": (8000.0, "male_v_tail", 11, [[(1, 300.0, [5, 5, 64, 18], 9, 9), (2, 330.0, [100, 9, 9, 9], 8, 8)]]),
}


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    root = tmp_path / "data"
    for name, (focal, airframe, seed, frames) in SCENES.items():
        folder = root / name
        (folder / "rgb").mkdir(parents=True)
        cameras: dict[str, Any] = {}
        poses: dict[str, Any] = {}
        info: dict[str, Any] = {}
        for k, targets in enumerate(frames):
            image = np.full((180, 320, 3), 90, np.uint8)
            for _, _, (x, y, w, h), _, _ in targets:
                image[y : y + h, x : x + w] = 30
            cv2.imwrite(str(folder / "rgb" / f"{k:06d}.jpg"), image)
            # Level, looking north, NED: in scene 2 down as far as up in the others.
            tilt = -0.1 if name.startswith("test") else 0.1
            c, s = np.cos(tilt), np.sin(tilt)
            cameras[str(k)] = {
                "cam_K": [focal, 0, 159.5, 0, focal, 89.5, 0, 0, 1], "depth_scale": 1.0,
                "cam_R_w2c": [0, 1, 0, s, 0, c, c, 0, -s], "cam_t_w2c": [0, 0, 5e5],
            }  # fmt: skip
            poses[str(k)] = [
                {"obj_id": i, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 1e3 * z]}
                for i, z, *_ in targets
            ]
            info[str(k)] = [
                {"bbox_obj": box, "bbox_visib": box, "px_count_all": whole, "px_count_valid": 0,
                 "px_count_visib": seen, "visib_fract": seen / whole}
                for _, _, box, seen, whole in targets
            ]  # fmt: skip
        for file, content in (("camera", cameras), ("gt", poses), ("gt_info", info)):
            (folder / f"scene_{file}.json").write_text(json.dumps(content))
        (folder / "sequence.toml").write_text(f'airframe = "{airframe}"\nflight_seed = {seed}\n')
    (root / "models").mkdir()
    names = {1: "male_v_tail", 4: "light_aircraft"}
    (root / "models" / "models_info.json").write_text(json.dumps({i: {"name": name} for i, name in names.items()}))
    return root


def test_json_that_nobody_reads_ends_as_a_command_does_whose_reader_had_enough(dataset: Path) -> None:
    read_end, write_end = os.pipe()
    os.close(read_end)  # as `| head` does
    command = [sys.executable, "-u", "-c", "import sys; from sim_replay.launch import main; sys.exit(main())"]
    arguments = ["stats", "--dataset", str(dataset), "--json"]
    done = subprocess.run([*command, *arguments], stdout=write_end, stderr=subprocess.PIPE, text=True, timeout=200)
    os.close(write_end)
    assert (done.returncode, done.stderr) == (141, "")


def test_every_figure_is_that_of_the_files(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stats", "--dataset", str(dataset), "--json"]) == 0
    s = json.loads(capsys.readouterr().out)
    assert s["sequences"] == {"train": 2, "test": 1}
    assert s["frames"] == {"train": 3, "test": 1}
    assert s["pictures"] == {"320x180": 3}
    assert s["range_m"]["min"] == pytest.approx(120.0)
    assert s["range_m"]["mean"] == pytest.approx((120 + 480 + 300 + 330) / 4)
    assert {k: n for k, n in s["range_histogram_m"].items() if n} == {"100-150": 1, "300-350": 2, "450-500": 1}
    share = [64 * 36 / 57600, 32 * 18 / 57600, 64 * 18 / 57600]  # of the first target in each frame that has one
    assert s["box_share"]["mean"] == pytest.approx(np.mean(share))
    assert (s["focal_px"]["min"], s["focal_px"]["median"], s["focal_px"]["max"]) == (1500, 2500, 8000)
    assert s["targets_per_frame"] == {"0": 1, "1": 2, "2": 1}
    assert s["target_free_share"] == pytest.approx(0.25)
    assert s["visible_fraction"]["min"] == pytest.approx(0.5)
    assert s["below_camera_share"] == pytest.approx(0.5)  # both of scene 2
    assert s["partly_hidden_share"] == pytest.approx(0.25)
    assert s["airframes"]["train"] == {"light_aircraft": 1, "male_v_tail": 1}
    assert s["airframes"]["test"] == {"male_v_tail": 1, "object 2": 1}  # models_info.json does not name it
    assert s["airframe_flights_in_two_splits"] == 1  # flight 11, on purpose


def test_what_is_hidden_is_listed_and_not_shown(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """BOP lists a target that something hides, or that lies beyond the edge or behind the camera, in every picture."""

    def statistics() -> Any:
        assert main(["stats", "--dataset", str(dataset), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    before, sheet_before = statistics(), contact_sheet(dataset)
    for folder in sorted(dataset.glob("*/0*")):
        for kind, entry in (
            ("gt", {"obj_id": 3, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, 4.1e5]}),
            ("gt_info", {"bbox_obj": [0, 0, 9, 9], "bbox_visib": [-1] * 4, "px_count_all": 50, "px_count_visib": 0}),
        ):
            path = folder / f"scene_{kind}.json"
            pictures = json.loads(path.read_text())
            path.write_text(json.dumps({key: [entry, *targets] for key, targets in pictures.items()}))
    assert statistics() == before
    np.testing.assert_array_equal(contact_sheet(dataset), sheet_before)
    camera = json.loads((folder / "scene_camera.json").read_text())
    path = folder / "scene_gt.json"
    (folder / "scene_gt_info.json").unlink()  # then nobody says that it is hidden, but where it lies may
    assert statistics()["range_histogram_m"]["400-450"] == len(camera)
    hidden_behind = {"obj_id": 3, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0, 0, -4.1e5]}
    pictures = json.loads(path.read_text())
    path.write_text(json.dumps({key: [hidden_behind, *targets[1:]] for key, targets in pictures.items()}))
    assert statistics()["targets_per_frame"] == before["targets_per_frame"]


def test_labels_without_pixel_counts_tell_of_targets_that_are_seen(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As `generate --labels-only` writes them."""

    def shown() -> list[Any]:
        assert main(["stats", "--dataset", str(dataset), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        return [told[name] for name in ("targets_per_frame", "range_m", "box_share", "airframes")]

    before = shown()
    for path in dataset.glob("*/0*/scene_gt_info.json"):
        info = json.loads(path.read_text())
        for entry in (entry for entries in info.values() for entry in entries):
            entry.update(px_count_all=0, px_count_visib=0, visib_fract=0.0)
        path.write_text(json.dumps(info))
    assert shown() == before


def test_the_table_stands_beside_the_papers(dataset: Path, capsys: pytest.CaptureFixture[str],
                                            monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    monkeypatch.setenv("COLUMNS", "200")
    assert main(["stats", "--dataset", str(dataset)]) == 0
    said = capsys.readouterr().out
    for words in ("161", "15,325", "2.333 %", "about 1.20 %", "1500–8000 px", "25.0 %", "targets below the camera"):
        assert words in said


def test_objects_of_others_are_not_called_by_our_airframes_names(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (dataset / "models" / "models_info.json").write_text('{"1": {"diameter": 9000}, "4": {"diameter": 8000}}')
    assert main(["stats", "--dataset", str(dataset), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["airframes"]["train"] == {"object 1": 1, "object 4": 1}


def test_two_datasets_at_once_keep_their_own_names(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("hawks", "kites"):
        shutil.copytree(dataset, tmp_path / "both" / name)
    (tmp_path / "both/kites/models/models_info.json").write_text('{"1": {"name": "box_kite"}}')
    assert main(["stats", "--dataset", str(tmp_path / "both"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)["airframes"]["train"]
    assert told == {"box_kite": 1, "light_aircraft": 1, "male_v_tail": 1, "object 4": 1}


def test_up_and_down_are_told_only_where_the_axes_of_the_world_are_known(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """BOP leaves them to each dataset; in most of them z points up."""

    def below() -> Any:
        assert main(["stats", "--dataset", str(dataset), "--json"]) == 0
        return json.loads(capsys.readouterr().out)["below_camera_share"]

    (dataset / "test/000002/sequence.toml").unlink()
    assert below() == 0.0  # of the two scenes of training, filmed upwards
    for path in dataset.glob("train/*/sequence.toml"):
        path.unlink()
    assert below() is None


def test_the_size_is_of_the_first_picture_that_is_there(dataset: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (dataset / "train/000000/rgb/000000.jpg").unlink()
    assert main(["stats", "--dataset", str(dataset), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["pictures"] == {"320x180": 3}


def test_a_scene_of_several_cameras_counts_each_picture_by_its_own(
    dataset: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = dataset / "train/000000"
    cv2.imwrite(str(scene / "rgb/000001.jpg"), np.zeros((90, 160, 3), np.uint8))  # the other has 320 x 180
    cameras = json.loads((scene / "scene_camera.json").read_text())
    cameras["1"]["cam_K"][0] = cameras["1"]["cam_K"][4] = 700.0
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    for name in ("scene_gt.json", "scene_gt_info.json"):
        content = json.loads((scene / name).read_text())
        (scene / name).write_text(json.dumps(content | {"1": content["0"]}))
    assert main(["stats", "--dataset", str(scene), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["pictures"] == {"320x180": 1, "160x90": 1}
    assert (told["focal_px"]["min"], told["focal_px"]["max"]) == (700.0, 1500.0)
    shares = (told["box_share"]["min"], told["box_share"]["max"])
    assert shares == pytest.approx((64 * 36 / (320 * 180), 64 * 36 / (160 * 90)))


@pytest.mark.parametrize("text", ["{", "[]", '{"width": "wide", "height": 180}'])
def test_a_camera_file_that_is_damaged_is_named(dataset: Path, capsys: pytest.CaptureFixture[str], text: str) -> None:
    scene = dataset / "test/000002"
    (scene / "rgb/000000.jpg").unlink()
    (scene / "camera.json").write_text(text)
    assert main(["stats", "--dataset", str(dataset)]) == 2
    assert str(scene / "camera.json") in capsys.readouterr().err


def test_a_folder_without_scenes_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["stats", "--dataset", str(tmp_path)]) == 2
    assert str(tmp_path) in capsys.readouterr().err


def test_a_contact_sheet_boxes_the_targets_and_is_small(dataset: Path, tmp_path: Path) -> None:
    out = tmp_path / "sheet.jpg"
    assert main(["sheet", "--dataset", str(dataset), "--out", str(out)]) == 0
    assert out.stat().st_size <= 300_000
    sheet = cv2.imread(str(out)).astype(int)
    assert sheet.shape == (225, 1600, 3)  # four pictures in all
    cyan = (sheet[..., 0] - sheet[..., 2] > 60) & (sheet[..., 1] - sheet[..., 2] > 60)
    # Scene 0's box, x 10..74 and y 20..56 of a 320 pixel wide picture, in a tile of 400.
    expected = np.array([10, 20, 74, 56]) * 1.25 + [-2, -2, 2, 2]
    found = []
    for left in range(0, 1600, 400):
        rows, columns = np.nonzero(cyan[:, left : left + 400])
        if len(rows):
            found.append([columns.min(), rows.min(), columns.max(), rows.max()])
    assert len(found) == 3  # the fourth picture shows no target
    assert min(np.abs(np.array(box) - expected).max() for box in found) <= 2


@pytest.mark.parametrize("seed", ['"abc"', "inf", "1.5"])
def test_a_flight_seed_that_is_no_number_is_told(dataset: Path, seed: str, capsys: pytest.CaptureFixture[str]) -> None:
    path = dataset / "train" / "000000" / "sequence.toml"
    path.write_text(f'airframe = "glider"\nflight_seed = {seed}\n')
    assert main(["stats", "--dataset", str(dataset)]) == 2
    assert f"{path}: flight_seed is not a whole number" in capsys.readouterr().err
