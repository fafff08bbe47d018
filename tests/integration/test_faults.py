"""Faults on real processes: each timeline ends in recovery or a clear stop, and no peer is ever given a stale pose.

One rig for all of them, so that each finds the daemon as the one before left it. `pytest -s` prints what took how long.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from sim_replay.faults.judge import pose_faults, violations
from sim_replay.faults.rig import Rig, RigSettings, can_mount
from sim_replay.faults.run import TIMELINES, play_timeline
from sim_replay.faults.timeline import load_timeline
from sim_replay.faults.witness import AUTOPILOT, SUBSCRIBER

SLOW = {"mavlink-cut-30s", "flood-10mb"}  # the same as a shorter one; played by hand
NEED_VOLUME = {"disk-full"}
SIGNED = {"signed-replay"}
LAST = ["daemon-killed"]  # what ends the daemon comes last: those before share one
NAMES = sorted({path.stem for path in TIMELINES.glob("*.toml")} - SLOW - NEED_VOLUME - SIGNED - set(LAST)) + LAST


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory, small_scene: Path, toy_model: Path) -> Iterator[Rig]:
    out = tmp_path_factory.mktemp("faults") / "out"
    out.mkdir()
    with Rig(RigSettings(out, small_scene, toy_model, volume=can_mount(out))) as rig:
        yield rig
    assert violations(rig.witness) == []


@pytest.fixture
def no_stale_pose(rig: Rig) -> Iterator[None]:
    """Looks at each pose that a peer receives during a test."""
    before = len(rig.witness.poses)
    yield
    received = rig.witness.poses[before:]
    assert {pose.peer for pose in received} == {AUTOPILOT, SUBSCRIBER}
    assert pose_faults(received, rig.witness.frames) == []


@pytest.mark.timeout(400)
@pytest.mark.usefixtures("no_stale_pose")
@pytest.mark.parametrize("name", NAMES)
def test_the_daemon_comes_through(rig: Rig, name: str) -> None:
    outcome = play_timeline(rig, load_timeline(TIMELINES / f"{name}.toml"), print)
    assert outcome.wrong == []


@pytest.mark.timeout(400)
@pytest.mark.usefixtures("no_stale_pose")
@pytest.mark.parametrize("name", sorted(NEED_VOLUME))
def test_the_daemon_comes_through_on_a_disk_of_its_own(rig: Rig, name: str) -> None:
    if not rig.settings.volume:
        pytest.skip("this host does not let a user mount a file system (unshare --map-root-user --mount)")
    outcome = play_timeline(rig, load_timeline(TIMELINES / f"{name}.toml"), print)
    assert outcome.wrong == []


@pytest.mark.parametrize("name", sorted(SIGNED))
def test_a_daemon_that_signs_comes_through(tmp_path: Path, small_scene: Path, toy_model: Path, name: str) -> None:
    with Rig(RigSettings(tmp_path, small_scene, toy_model, signed=True)) as rig:
        outcome = play_timeline(rig, load_timeline(TIMELINES / f"{name}.toml"), print)
    assert outcome.wrong == []
    assert violations(rig.witness) == []
    assert rig.witness.counters["mavlink_reboots"] == 0
