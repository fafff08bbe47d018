"""What `play` makes of a video, and what it removes to make room for that: what it made itself, and nothing else."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from rich.console import Console

from edge.errors import InputError
from sim_replay.recorded.opened import open_sequence
from sim_replay.telemetry import Telemetry, write_telemetry
from tests.edge.test_cameras_video import bare_jpeg, turned, write_film

LENS = "{ fx = 300.0, fy = 300.0, cx = 31.5, cy = 23.5, width = 64, height = 48 }"


@pytest.fixture
def film(tmp_path: Path) -> Path:
    video = cv2.VideoWriter(str(tmp_path / "film.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 10.0, (64, 48))
    for _ in range(5):
        video.write(np.full((48, 64, 3), 90, np.uint8))
    video.release()
    values = np.zeros((40, 16))
    values[:, 0] = 1.0
    write_telemetry(tmp_path / "own.csv", Telemetry(np.arange(40) * 20_000_000, values))
    path = tmp_path / "flight.toml"
    path.write_text(f'video = "film.mp4"\ntelemetry = "own.csv"\nintrinsics = {LENS}\n')
    return path


def test_pictures_are_unpacked_again_where_they_were(film: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for _ in range(2):
        assert len(open_sequence(film, out, Console(quiet=True)).scene.images) == 5


@pytest.mark.parametrize("who", ["made by generate", "labelled since", "nobody's"])
def test_a_scene_that_was_not_unpacked_here_is_in_the_way_and_stays(film: Path, tmp_path: Path, who: str) -> None:
    scene = tmp_path / "out" / "sequence"
    if who == "labelled since":
        open_sequence(film, tmp_path / "out", Console(quiet=True))
        (scene / "scene_gt.json").write_text("{}")
    else:
        scene.mkdir(parents=True)
        (scene / "sequence.toml").write_text('command = "generate"\nfps = 30.0\n' if who == "made by generate" else "[")
    before = sorted(path.name for path in scene.rglob("*"))
    with pytest.raises(InputError, match="is in the way"):
        open_sequence(film, tmp_path / "out", Console(quiet=True))
    assert sorted(path.name for path in scene.rglob("*")) == before


def test_a_video_of_a_rate_that_varies_is_refused_unless_its_rate_is_told(film: Path, tmp_path: Path) -> None:
    """Its pictures would be laid beside the own ship of other times."""
    write_film(tmp_path / "film.mp4", [0, 40, 80, 120, 400, 440])
    film.write_text(film.read_text().replace("width = 64, height = 48", "width = 320, height = 180"))
    with pytest.raises(InputError, match="rate that varies"):
        open_sequence(film, tmp_path / "out", Console(quiet=True))
    assert not any((tmp_path / "out").glob("*"))
    film.write_text("fps = 20.0\n" + film.read_text())
    assert len(open_sequence(film, tmp_path / "out", Console(quiet=True)).scene.images) == 6


def test_a_video_is_as_long_as_its_pictures_whatever_duration_its_file_says(film: Path, tmp_path: Path) -> None:
    """That of Matroska counts from time 0, where recorders that join a running stream do not begin."""
    write_film(tmp_path / "film.mkv", list(range(7000, 7400, 40)))
    text = film.read_text().replace("width = 64, height = 48", "width = 320, height = 180")
    film.write_text(text.replace("film.mp4", "film.mkv"))
    assert len(open_sequence(film, tmp_path / "out", Console(quiet=True)).scene.images) == 10
    film.write_text(f"t0_ns = 600000000\n{film.read_text()}")
    with pytest.raises(InputError, match=r"tells of 0\.000 s to 0\.780 s, but the pictures were exposed from 0\.600 s"):
        open_sequence(film, tmp_path / "late", Console(quiet=True))
    assert not any((tmp_path / "late").glob("*"))


@pytest.mark.parametrize("suffix", [".h264", ".mjpeg"])
def test_a_video_that_says_no_rate_is_not_given_one(suffix: str, film: Path, tmp_path: Path) -> None:
    """Without a container there are no times; ffmpeg takes 25 a second for granted."""
    bare = tmp_path / f"film{suffix}"
    write_film(bare, [0, 33, 67, 100], "libx264") if suffix == ".h264" else bare_jpeg(bare)
    text = (
        film.read_text().replace("film.mp4", bare.name).replace("width = 64, height = 48", "width = 320, height = 180")
    )
    film.write_text(text)
    with pytest.raises(InputError, match="fps: is missing"):
        open_sequence(film, tmp_path / "out", Console(quiet=True))
    film.write_text(f"fps = 30.0\n{text}")
    assert open_sequence(film, tmp_path / "out", Console(quiet=True)).fps == 30.0


def test_a_video_s_rolling_shutter_and_own_parts_are_those_of_the_sequence_made_of_it(
    film: Path, tmp_path: Path
) -> None:
    plain = open_sequence(film, tmp_path / "out", Console(quiet=True))
    assert (plain.readout_ms, plain.own_ship_mask) == (0.0, None)
    film.write_text(f'readout_ms = 21.5\nown_ship_mask = "own.png"\n{film.read_text()}')
    with pytest.raises(InputError, match=r"own_ship_mask: .*own\.png does not exist"):
        open_sequence(film, tmp_path / "out", Console(quiet=True))
    (tmp_path / "own.png").write_bytes(b"a mask")
    told = open_sequence(film, tmp_path / "out", Console(quiet=True))
    (tmp_path / "own.png").unlink()
    assert told.readout_ms == 21.5
    assert told.own_ship_mask is not None
    assert told.own_ship_mask.read_bytes() == b"a mask"


def test_a_video_is_unpacked_as_its_sensor_read_it_out(film: Path, tmp_path: Path) -> None:
    """Lens and mount are the sensor's, however the video says it is to be shown."""
    turned(write_film(tmp_path / "film.mp4", [0, 40, 80], bright=np.s_[:60]))
    film.write_text(film.read_text().replace("width = 64, height = 48", "width = 320, height = 180"))
    scene = open_sequence(film, tmp_path / "out", Console(quiet=True)).scene
    image = cv2.imread(str(next((scene.folder / "rgb").iterdir())))
    assert image is not None
    assert image[:60].mean() > 150
    assert image[60:].mean() < 50
