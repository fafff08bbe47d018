"""Faults on real processes: each timeline ends in recovery or a clear stop, and no peer is ever told anything stale.

One rig for all of them, so that each finds the daemon as the one before left it. The closing report says how long each
recovery took, `pytest -s` each step.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sim_replay.faults.judge import faults_since, violations
from sim_replay.faults.messages import AUTOPILOT, KINDS, SUBSCRIBER
from sim_replay.faults.rig import Rig, RigSettings, can_mount
from sim_replay.faults.run import TIMELINES, Outcome, play_timeline
from sim_replay.faults.timeline import Flood, Timeline, load_timeline

WORD_S = 5.0
SHORT = {"mavlink-cut", "flood"}  # the same as mavlink-cut-30s and flood-10mb, and less of it
NEED_VOLUME = {"disk-full"}
SIGNED = ("signed-replay", "signed-reboot")
SIGNED_BYTES = 1_000_000  # of each flood at them: what the autopilot said, again and again; more is the same once more
LAST = ["daemon-alone", "daemon-killed"]  # what ends the daemon comes last: those before share one
NAMES = sorted({path.stem for path in TIMELINES.glob("*.toml")} - SHORT - NEED_VOLUME - set(SIGNED) - set(LAST)) + LAST

TELEMETRY = ["ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"]
LASTING = ("link cut", "telemetry stopped", "camera away", "router killed")
CLOCK_JUMP = "clock jump"
SEED = 23  # three of them at once, and the ground hears of most


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory, small_scene: Path, toy_model: Path) -> Iterator[Rig]:
    out = tmp_path_factory.mktemp("faults") / "out"
    out.mkdir()
    with Rig(RigSettings(out, small_scene, toy_model, volume=can_mount(out))) as rig:
        yield rig
    assert violations(rig.witness) == []
    assert set(KINDS) <= {message.kind for message in rig.witness.messages} <= {*KINDS, "direction"}


@pytest.fixture
def nothing_stale(rig: Rig) -> Iterator[None]:
    """Looks at each pose, and each other message about a target, that a peer receives during a test."""
    poses, messages = len(rig.witness.poses), len(rig.witness.messages)
    yield
    assert {pose.peer for pose in rig.witness.poses[poses:]} == {AUTOPILOT, SUBSCRIBER}
    assert {message.peer for message in rig.witness.messages[messages:]} == {AUTOPILOT, SUBSCRIBER}
    # What a peer received may be heard before the camera's word that it has exposed that frame.
    rig.witness.wait_for(lambda: not faults_since(rig.witness, poses, messages), WORD_S)
    assert faults_since(rig.witness, poses, messages) == []


@pytest.fixture
def volume(rig: Rig) -> None:
    if not rig.settings.volume:
        pytest.skip("this host does not let a user mount a file system (unshare --map-root-user --mount)")


def played(rig: Rig, name: str, tell_recovery: Callable[[str], None]) -> Outcome:
    timeline = load_timeline(TIMELINES / f"{name}.toml")
    if name in SIGNED:
        timeline = less_flooded(timeline, SIGNED_BYTES)
    outcome = play_timeline(rig, timeline, print)
    tell_recovery(f"{name}: {outcome.recovery()}")
    return outcome


def less_flooded(timeline: Timeline, bytes_max: int) -> Timeline:
    steps = [
        step.model_copy(update={"total_bytes": min(step.total_bytes, bytes_max)}) if isinstance(step, Flood) else step
        for step in timeline.step
    ]
    return timeline.model_copy(update={"step": steps})


@pytest.mark.timeout(400)
@pytest.mark.usefixtures("nothing_stale")
@pytest.mark.parametrize("name", NAMES)
def test_the_daemon_comes_through(rig: Rig, name: str, tell_recovery: Callable[[str], None]) -> None:
    assert played(rig, name, tell_recovery).wrong == []


@pytest.mark.timeout(400)
@pytest.mark.usefixtures("volume", "nothing_stale")
@pytest.mark.parametrize("name", sorted(NEED_VOLUME))
def test_the_daemon_comes_through_on_a_disk_of_its_own(
    rig: Rig, name: str, tell_recovery: Callable[[str], None]
) -> None:
    assert played(rig, name, tell_recovery).wrong == []


def test_a_daemon_that_signs_comes_through(
    tmp_path: Path, small_scene: Path, toy_model: Path, tell_recovery: Callable[[str], None]
) -> None:
    reboots = []
    with Rig(RigSettings(tmp_path, small_scene, toy_model, signed=True)) as rig:
        for name in SIGNED:
            outcome = played(rig, name, tell_recovery)
            assert outcome.wrong == []
            reboots.append(rig.witness.counters["mavlink_reboots"])
    assert violations(rig.witness) == []
    assert reboots == [0, 1]


def overlapping(seed: int) -> Timeline:
    """Each of the quick faults once, in a random order; those that last end at random, so that several overlap."""
    chance, wrong, steps = random.Random(seed), set[str](), list[dict[str, Any]]()
    to_come = chance.sample([*LASTING, CLOCK_JUMP], len(LASTING) + 1)
    while to_come or wrong:
        begins = bool(to_come) and (not wrong or chance.random() < 0.6)
        fault = to_come.pop() if begins else chance.choice(sorted(wrong))
        if fault != CLOCK_JUMP:
            wrong ^= {fault}
        steps += [act_of(fault, wrong), *reactions(fault, wrong)]
    return Timeline.model_validate({"title": f"Faults that overlap, seed {seed}", "step": steps})


def act_of(fault: str, wrong: set[str]) -> dict[str, Any]:
    """What begins the fault if it is in `wrong`, and otherwise ends it."""
    if fault == CLOCK_JUMP:
        return {"do": "start", "who": "autopilot", "clock_ahead_s": 5.0}
    if fault in ("camera away", "router killed"):
        who = fault.split()[0]
        return {"do": "signal", "who": who, "name": "KILL"} if fault in wrong else {"do": "start", "who": who}
    drop = TELEMETRY if "telemetry stopped" in wrong else []
    return {"do": "link", "which": "mavlink", "cut": "link cut" in wrong, "drop": drop}


def reactions(fault: str, wrong: set[str]) -> list[dict[str, Any]]:
    """What must be seen after the act while the faults `wrong` last."""
    steps: list[dict[str, Any]] = []
    if "router killed" not in wrong:  # else nobody hears of states and counters
        if "camera away" in wrong:
            state = "fault.*no frame"
        elif wrong & {"link cut", "telemetry stopped"}:
            state = "degraded.*no own attitude"
        else:
            state = "^(?!.*(no frame|no own attitude))"
        steps.append({"do": "expect_state", "pattern": state})
        if fault == CLOCK_JUMP and "link cut" not in wrong:
            steps.append({"do": "expect_counter", "name": "mavlink_timesync_jumps"})
    poses = {"do": "expect_silence", "for_s": 0.5} if "camera away" in wrong else {"do": "expect_poses"}
    cut_off_by = {AUTOPILOT: "link cut", SUBSCRIBER: "router killed"}
    return steps + [{**poses, "at": peer} for peer, cutting in cut_off_by.items() if cutting not in wrong]


@pytest.mark.timeout(400)
@pytest.mark.usefixtures("nothing_stale")
def test_one_daemon_comes_through_faults_that_overlap(rig: Rig, tell_recovery: Callable[[str], None]) -> None:
    """Each fault alone says nothing of one that begins, or ends, while others last."""
    outcome = play_timeline(rig, overlapping(SEED), print)
    tell_recovery(f"overlapping: {outcome.recovery()}")
    assert outcome.wrong == []
