"""What `uavpose-edge doctor` says of processor, clock, disk and devices, to whom they are not accessible too."""

from __future__ import annotations

import os
import pwd
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from edge.config import Config
from edge.doctor_machine import clock_finding, cpu_finding, disk_finding, machine_findings
from sim_replay.faults.rig import can_mount


def configured(**sections: Any) -> Config:
    return Config.model_validate({"camera": {"type": "sequence", "path": "scene"}, **sections})


@pytest.mark.parametrize(
    ("cpuinfo", "machine", "verdict", "said"),
    [
        ("flags\t\t: fpu avx2 avx512_vnni\n", "x86_64", "good", "with avx512_vnni:"),
        ("flags\t\t: fpu avx2 avx_vnni\n", "x86_64", "good", "with avx_vnni:"),
        ("flags\t\t: fpu avx2\n", "x86_64", "poor", "without avx512_vnni or avx_vnni"),
        ("Features\t: fp asimd asimddp\n", "aarch64", "good", "with asimddp:"),  # Cortex-A76, Raspberry Pi 5
        ("Features\t: fp asimd\n", "aarch64", "poor", "without asimddp or i8mm"),  # Cortex-A72, Raspberry Pi 4
        ("Features\t: fp asimd\n", "riscv64", "poor", "without 8-bit dot products"),
    ],
)
def test_the_processor_s_eight_bit_instructions_are_looked_for(
    cpuinfo: str, machine: str, verdict: str, said: str
) -> None:
    found = cpu_finding(cpuinfo, machine)
    assert (found.verdict, said in found.says) == (verdict, True), found.says


@pytest.mark.parametrize(("threads", "verdict", "advice"), [(1, "good", ""), (2, "poor", "set [model] threads = 1")])
def test_more_threads_than_cores_are_told(threads: int, verdict: str, advice: str) -> None:
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        found = {one.what: one for one in machine_findings(configured(model={"threads": threads}))}["cores"]
    finally:
        os.sched_setaffinity(0, cores)
    assert (found.verdict, found.advice) == (verdict, advice)
    assert found.says.startswith("1 available to this process")


@pytest.mark.parametrize(("governor", "told"), [("powersave", True), ("conservative", True), ("schedutil", False)])
def test_a_governor_that_keeps_the_processor_slow_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, governor: str, told: bool
) -> None:
    (tmp_path / "governor").write_text(f"{governor}\n")
    monkeypatch.setattr("edge.doctor_machine.GOVERNOR", tmp_path / "governor")
    says = [one.says for one in machine_findings(configured()) if one.what == "governor"]
    assert says == ([f"the CPU frequency governor is '{governor}'"] if told else [])


def test_the_clock_is_judged_by_what_the_kernel_says() -> None:
    assert clock_finding(0).verdict == "good"
    assert "chrony" in clock_finding(5).advice
    assert clock_finding(-1).verdict == "poor"


@pytest.mark.parametrize(
    ("recorder", "zenoh", "looked_at"),
    [
        ({"enabled": True}, {"enabled": False}, True),
        ({"enabled": True}, {"commands": False}, True),
        ({}, {}, True),  # the ground may start recordings
        ({}, {"commands": False}, False),
        ({}, {"enabled": False}, False),
    ],
)
def test_the_disk_is_looked_at_where_something_may_be_recorded(
    recorder: dict[str, bool], zenoh: dict[str, bool], looked_at: bool
) -> None:
    found = machine_findings(configured(recorder=recorder, zenoh=zenoh))
    assert ("disk" in {one.what for one in found}) == looked_at


def test_a_disk_without_room_is_wrong(tmp_path: Path) -> None:
    enough = disk_finding(tmp_path / "not" / "yet", 0, from_start=True)
    recorder = {"enabled": True, "folder": tmp_path, "free_min_mb": 1e9}
    (full,) = (one for one in machine_findings(configured(recorder=recorder)) if one.what == "disk")
    assert (enough.verdict, full.verdict) == ("good", "wrong")
    assert full.says.endswith(" MB free, at least 1000000000 MB must stay free")
    free_gb = 1e-9 * shutil.disk_usage(tmp_path).free
    for found, unit, gb in ((enough, "GB", 1.0), (full, "MB", 1e-3)):
        told = re.search(rf": ([\d.]+) {unit} free", found.says)
        assert told is not None, found.says
        assert float(told[1]) * gb == pytest.approx(free_gb, rel=0.2, abs=0.1)
    file = tmp_path / "file"
    file.write_text("")
    found = disk_finding(file / "folder", 0, from_start=True)
    assert (found.verdict, "cannot be written" in found.says) == ("wrong", True)


NO_ROOT_LOOKS = """
import os
from pathlib import Path
from edge.doctor_machine import disk_finding
from edge.findings import device_fault
if os.geteuid() == 0:  # who may everything
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
print(*(device_fault(Path("{path}"), "video") or ["may be used"]), sep="\\n")
print(disk_finding(Path("{path}"), 0, from_start=True).line())
"""


def nobody() -> str:
    """Who looks in `looked_at_by_nobody`."""
    return pwd.getpwuid(os.geteuid() or 65534).pw_name


def looked_at_by_nobody(folder: Path, path: str) -> str:
    """What is said of `path`, from `folder`, as a device and as a folder for recordings."""
    folder.chmod(0o755)
    command = [sys.executable, "-c", NO_ROOT_LOOKS.replace("{path}", path)]
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder).stdout


@pytest.mark.parametrize(
    ("mode", "words"),
    [(0o000, "usermod -aG video {user},"), (0o444, "is not readable and writable"), (0o666, "may be used")],
)
def test_a_device_without_permission_names_the_group_and_who_lacks_it(tmp_path: Path, mode: int, words: str) -> None:
    """With `sudo -u uavpose`, $USER of the person who follows the advice is another."""
    device = tmp_path / "video0"
    device.touch()
    device.chmod(mode)
    assert words.format(user=nobody()) in looked_at_by_nobody(tmp_path, "video0")


@pytest.mark.parametrize("path", ["home/rec", "home/rec/deep", "home/none", "link"])
def test_what_lies_in_a_folder_that_may_not_be_entered_is_told_as_forbidden(tmp_path: Path, path: str) -> None:
    (tmp_path / "home" / "rec").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "home" / "rec")
    (tmp_path / "home").chmod(0o000)
    said = looked_at_by_nobody(tmp_path, path)
    (tmp_path / "home").chmod(0o755)  # or pytest, where it is not root, cannot remove it
    assert f"{path} is not readable" in said
    assert f"namei -l {path}" in said
    assert f"WRONG  disk         {path} cannot be written by this user" in said


ADVICE_FOLDER = "`sudo install -d -o {user} 'my rec'`"


@pytest.mark.parametrize(
    ("mode", "path", "words"),
    [
        (0o777, "my rec", "GB free"),
        (0o555, "my rec", ADVICE_FOLDER),
        (0o333, "my rec", ADVICE_FOLDER),
        (0o333, "my rec/new", "GB free"),  # what is made there can be looked into
    ],
)
def test_a_recorder_s_folder_must_be_one_to_write_and_to_look_into(
    tmp_path: Path, mode: int, path: str, words: str
) -> None:
    folder = tmp_path / "my rec"
    folder.mkdir()
    folder.chmod(mode)
    said = looked_at_by_nobody(tmp_path, path)
    folder.chmod(0o755)
    assert words.format(user=nobody()) in said


ON_A_READ_ONLY_DISK = 'mount -t tmpfs -o ro tmpfs "$1" && exec "$2" -c "$3" "$1"'
LOOK_AT_DISK = """
import sys
from pathlib import Path
from edge.doctor_machine import disk_finding
print(disk_finding(Path(sys.argv[1]) / "rec", 0, from_start=True).line())
"""


def test_a_disk_that_is_mounted_read_only_is_not_taken_for_one_that_others_own(tmp_path: Path) -> None:
    if not can_mount(tmp_path):
        pytest.skip("this host does not let a user mount a file system (unshare --map-root-user --mount)")
    mounting = ["unshare", "--map-root-user", "--mount", "sh", "-c", ON_A_READ_ONLY_DISK, "sh", str(tmp_path)]
    said = subprocess.run([*mounting, sys.executable, LOOK_AT_DISK], capture_output=True, text=True, check=True).stdout
    assert f"WRONG  disk         {tmp_path}/rec is on a disk that is mounted read-only" in said
    assert "$USER" not in said
