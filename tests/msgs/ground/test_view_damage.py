"""`uavpose-ground view` of what is not as it should be: lenses that are not OpenCV's, recordings with wrong bytes."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from msgs import cdr, topics
from msgs.ground.cli import main
from msgs.ground.errors import InputError
from msgs.ground.view.drawing import project
from msgs.ground.view.recorded import samples as recorded
from msgs.mcap_file import McapFile

from .flight import START_NS, UAV, K, samples, stamps_ns
from .test_view import rows


def write(path: Path, frames: int, coefficients: int, model: str = "plumb_bob") -> None:
    """A flight without pictures, whose camera tells a distortion of so many, of this model."""
    file = McapFile(path)
    for topic, target, payload, log_ns in samples(frames):
        if topic is topics.IMAGE:
            continue
        if topic is topics.CAMERA_INFO:
            info = cdr.CameraInfo.decode(payload)
            lens = {"distortion_model": model, "distortion": np.full(coefficients, 0.01)}
            payload = dataclasses.replace(info, **lens).encode()
        file.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, log_ns, log_ns)
    file.close()


@pytest.mark.parametrize(
    ("coefficients", "model", "drawn"), [(5, "plumb_bob", 10), (6, "plumb_bob", 0), (4, "equidistant", 0), (4, "", 10)]
)
def test_of_a_camera_whose_lens_is_not_known_the_picture_alone_goes_without_targets(
    tmp_path: Path, coefficients: int, model: str, drawn: int
) -> None:
    write(tmp_path / "lens.mcap", 10, coefficients, model)
    path = tmp_path / "lens.rrd"
    assert main(["view", str(tmp_path / "lens.mcap"), "--save", str(path)]) == 0
    for part in ("box", "range_sigma", "sigma", "label"):
        assert len(list(rows(path, f"ned/camera/target/t0/{part}"))) == drawn, part
    for entity in ("ned/target/t0/body", "map/target/t0/place", "zoom/target/t0/box", "plots/range/t0"):
        assert [stamp_ns for stamp_ns, _ in rows(path, entity)] == stamps_ns(10), entity


def test_points_are_projected_through_the_lenses_that_opencv_knows_and_no_other() -> None:
    known = [count for count in range(20) if project([1.0, 2.0, 100.0], K, np.full(count, 1e-3)) is not None]
    assert known == [0, 4, 5, 8, 12, 14]


@pytest.mark.parametrize("flip", [0x01, 0x80, 0xFF])
def test_a_recording_with_a_wrong_byte_is_read_or_a_sentence(tmp_path: Path, flip: int) -> None:
    path = tmp_path / "damaged.mcap"
    write(path, 2, 5)
    whole, said = path.read_bytes(), set[str]()
    for place in range(0, len(whole), 29):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ flip]) + whole[place + 1 :])
        try:
            for _, log_ns in recorded(path):
                assert 0 <= log_ns < 2**63
        except InputError as error:
            said.add(str(error))
    assert said
    assert all(sentence.startswith(f"{path}: ") for sentence in said)


@pytest.mark.parametrize("torn", [b"", bytes(4096), b"\x06" + (9999).to_bytes(8, "little") + bytes(500)])
def test_a_recording_that_is_not_finished_is_drawn_up_to_its_last_complete_chunk(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], torn: bytes
) -> None:
    """Ten frames are on the disk: during a flight, and after a crash that left zeros or part of the next chunk."""
    path, into = tmp_path / "flight.mcap", tmp_path / "flight.rrd"
    file = McapFile(path)
    for topic, target, payload, log_ns in samples(10):
        file.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, log_ns, log_ns)
    file.flush()
    with path.open("ab") as after:
        after.write(torn)
    assert main(["view", str(path), "--save", str(into)]) == 0
    assert [stamp_ns for stamp_ns, _ in rows(into, "ned/target/t0/body")] == stamps_ns(10)
    assert f"{path}: read, as far as it is complete" in capsys.readouterr().err
    file.abandon()


def test_a_recording_of_a_time_that_no_clock_tells_is_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "late.mcap"
    file = McapFile(path)
    topic, target, payload, _ = next(samples(1))
    file.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, 2**63, START_NS)
    file.close()
    assert main(["view", str(path), "--save", str(tmp_path / "late.rrd")]) == 2
    assert f"{path}: is damaged" in capsys.readouterr().err
