"""`uavpose-ground view --save`: what lies at that name stays until a whole file takes its place."""

from __future__ import annotations

import dataclasses
import resource
import subprocess
import sys
import threading
from contextlib import nullcontext
from pathlib import Path

import pytest
import rerun as rr
from rerun.chunk import RrdReader

from msgs import cdr, topics
from msgs.ground.cli import main
from msgs.ground.errors import InputError
from msgs.ground.view.saving import saved
from msgs.mcap_file import McapFile, Publisher
from sim_replay.ports import free_endpoint

from .flight import PERIOD_NS, UAV, record, samples

OLD = b"an older file"
LIMIT_BYTES = 50_000  # of files: a disk that is full in the middle


@pytest.fixture
def flight(tmp_path: Path) -> Path:
    record(tmp_path / "flight.mcap", 5)
    (tmp_path / "out.rrd").write_bytes(OLD)
    return tmp_path / "flight.mcap"


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_whole_file_takes_the_place_of_the_old_one_and_nothing_else_is_left(flight: Path) -> None:
    out, link = flight.with_name("out.rrd"), flight.with_name("link.rrd")
    link.symlink_to(out)
    assert main(["view", str(flight), "--save", str(link)]) == 0
    assert link.is_symlink()
    assert len(RrdReader(out).recordings()) == 1
    assert out.read_bytes()[-12:].startswith(b"RRF2FOOT")  # the viewer finds its way about by what stands at the end
    assert names(flight.parent) == ["flight.mcap", "link.rrd", "out.rrd"]


def test_the_recording_itself_is_not_overwritten(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    whole, link = flight.read_bytes(), flight.with_name("link.rrd")
    link.symlink_to(flight)
    for save in (flight, flight.parent / "." / flight.name, link):
        assert main(["view", str(flight), "--save", str(save)]) == 2
        assert f"--save {save}: is the same file as the recording {flight}" in capsys.readouterr().err
    assert flight.read_bytes() == whole


@pytest.mark.parametrize(
    ("name", "words"), [("flihgt.mcap", "cannot be read: No such file"), ("out.rrd", "is not a complete")]
)
def test_a_recording_that_does_not_open_is_told_before_anything_is_drawn(
    flight: Path, capsys: pytest.CaptureFixture[str], name: str, words: str
) -> None:
    out, bad = flight.with_name("out.rrd"), flight.with_name("other") / name
    bad.parent.mkdir()
    if name == "out.rrd":
        bad.write_bytes(OLD)
    assert main(["view", str(flight), str(bad), "--save", str(out)]) == 2
    said = capsys.readouterr().err
    assert f"{bad}: {words}" in said
    assert "flight.mcap: read" not in said
    assert out.read_bytes() == OLD


def test_a_damaged_recording_leaves_an_old_file_and_is_a_file_where_there_is_none(flight: Path) -> None:
    whole = flight.read_bytes()
    place = len(whole) // 2
    flight.write_bytes(whole[:place] + bytes([whole[place] ^ 0xFF]) + whole[place + 1 :])
    assert main(["view", str(flight), "--save", str(flight.with_name("out.rrd"))]) == 2
    assert flight.with_name("out.rrd").read_bytes() == OLD
    assert names(flight.parent) == ["flight.mcap", "out.rrd"]
    assert main(["view", str(flight), "--save", str(flight.with_name("new.rrd"))]) == 2
    assert len(RrdReader(flight.with_name("new.rrd")).recordings()) == 1, "what came before the damage"


@pytest.mark.parametrize("old", [True, False])
def test_a_recording_broken_off_replaces_no_old_file_and_a_live_view_does(flight: Path, old: bool) -> None:
    out, stop = flight.with_name("out.rrd"), threading.Event()
    out.unlink() if not old else None
    rec = rr.RecordingStream("broken_off")
    with pytest.raises(InputError, match="the existing file is kept") if old else nullcontext():  # noqa: SIM117
        with saved(rec, out, stop, complete=lambda: False):
            rec.log("a", rr.TextLog("one"))
    assert (out.read_bytes() == OLD) == old
    with saved(rr.RecordingStream("live"), out, stop, complete=lambda: True):
        pass
    assert out.read_bytes() != OLD


def test_a_view_of_nothing_replaces_no_old_file(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = flight.with_name("out.rrd")
    nobody = ["-e", free_endpoint(), "--seconds", "0.2"]
    for heard in (nobody, [str(flight), "--uav", "uav9"]):
        assert main(["view", *heard, "--save", str(out)]) == 2
        assert "nothing was drawn; the existing file is kept" in capsys.readouterr().err
        assert out.read_bytes() == OLD
    assert main(["view", *nobody, "--save", str(flight.with_name("new.rrd"))]) == 0


def test_what_an_unforeseen_end_leaves_is_kept_where_there_was_nothing(flight: Path) -> None:
    new = flight.with_name("new.rrd")

    def end_in_the_middle(path: Path) -> None:
        rec = rr.RecordingStream("ended")
        with saved(rec, path, threading.Event(), lambda: True):
            rec.log("a", rr.TextLog("one"))
            raise RuntimeError("unforeseen")

    for path in (new, flight.with_name("out.rrd")):
        with pytest.raises(RuntimeError, match="unforeseen"):
            end_in_the_middle(path)
    assert len(RrdReader(new).recordings()) == 1
    assert flight.with_name("out.rrd").read_bytes() == OLD


def test_what_is_no_file_is_not_replaced(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = flight.with_name("folder")
    folder.mkdir()
    assert main(["view", str(flight), "--save", str(folder)]) == 2
    assert f"--save {folder}: exists and is not a regular file" in capsys.readouterr().err
    assert main(["view", str(flight), "--save", str(folder / "no" / "out.rrd")]) == 2
    assert "cannot be written: No such file or directory" in capsys.readouterr().err


def test_a_name_that_cannot_be_is_a_sentence(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["view", str(flight), "--save", str(flight.with_name("n" * 300))]) == 2
    assert "cannot be written: File name too long" in capsys.readouterr().err


def test_on_a_full_disk_a_sentence_ends_it_and_no_half_file_is_left(flight: Path) -> None:
    command = [Path(sys.executable).parent / "uavpose-ground", "view", flight, "--save", flight.with_name("out.rrd")]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (LIMIT_BYTES, LIMIT_BYTES)),
    )  # fmt: skip
    assert done.returncode == 2, done.stderr
    assert "out.rrd: cannot be written: File too large" in done.stderr
    assert "Traceback" not in done.stderr
    assert flight.with_name("out.rrd").read_bytes() == OLD
    assert names(flight.parent) == ["flight.mcap", "out.rrd"]


def test_of_two_vehicles_of_one_name_one_is_drawn_from_a_recording_too(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second one's frames are exposed half a period after the first one's."""
    file, late_ns = McapFile(tmp_path / "both.mcap"), PERIOD_NS // 2
    first, second = (Publisher(zenoh_session=name, gid=16 * name) for name in ("0a", "0b"))
    for topic, target, payload, log_ns in samples(10):
        if topic is topics.POSE:
            name, pose = topics.topic_name(topic, UAV, target), cdr.PoseWithCovarianceStamped.decode(payload)
            file.write(name, topic.ros_type, payload, log_ns, log_ns, first)
            late = dataclasses.replace(pose, stamp_ns=pose.stamp_ns + late_ns).encode()
            file.write(name, topic.ros_type, late, log_ns + late_ns, log_ns + late_ns, second)
    file.close()
    out = tmp_path / "both.rrd"
    assert main(["view", str(tmp_path / "both.mcap"), "--save", str(out)]) == 0
    why = "10: another publisher of this target was heard within the last second"
    assert capsys.readouterr().err.splitlines()[-1] == f"10 poses drawn into {out}, 10 samples refused ({why})"
