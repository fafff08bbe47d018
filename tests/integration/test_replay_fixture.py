"""The fixture `uavpose_replay`, as an integrator meets it: from a test file of their own, found by pytest alone."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.pytest_plugin import Replay, ReplayedFlight
from sim_replay.report.flight_files import read_flight
from tests.sim_replay.toy_flight import write_toy_flight

OWN_TESTS = """
def test_the_target_is_held(uavpose_replay):
    flight = uavpose_replay({sequence!r}, model={model!r})
    assert flight.peer("subscriber")["continuity"]["identity_switches"] == 0
    assert flight.score["overall"]["frames"] == 1  # the sequence has more


def test_the_sky_is_empty(uavpose_replay):
    flight = uavpose_replay({sequence!r}, model={model!r}, report=True)
    assert (flight.folder / "report.html").is_file()
"""


@pytest.fixture(scope="module")
def flight(uavpose_replay: Replay) -> ReplayedFlight:
    """Slowly: what is tested is the way of a pose, not the machine."""
    return uavpose_replay(BUNDLED_SEQUENCE, speed=0.5)


def test_both_peers_are_scored_by_what_they_received(flight: ReplayedFlight) -> None:
    for name in ("subscriber", "autopilot"):
        peer = flight.peer(name)
        assert peer["poses"] > 0
        assert 0.0 < peer["overall"]["recall"] <= 1.0
        assert peer["age_ms"]["p50"] > 0.0
    assert flight.peer("subscriber")["nees"]["pose"]["mean"] > 0.0


def test_the_daemon_counts_no_fewer_poses_than_came(flight: ReplayedFlight) -> None:
    counters = flight.recording.daemon_counters
    assert counters["zenoh_sent_pose"] >= flight.peer("subscriber")["poses"] > 0
    assert counters["mavlink_sent_TARGET_RELATIVE"] >= flight.peer("autopilot")["poses"] > 0


def test_the_flight_can_be_scored_again_from_its_folder(flight: ReplayedFlight) -> None:
    assert read_flight(flight.folder).recording.poses == flight.recording.poses


def test_a_test_of_five_lines_flies_where_warnings_are_errors_and_its_last_line_can_fail(
    tmp_path: Path, toy_model: Path
) -> None:
    sequence = write_toy_flight(tmp_path / "sky", target=False, labelled=True)
    (tmp_path / "test_own.py").write_text(OWN_TESTS.format(sequence=str(sequence), model=str(toy_model)))
    command = [sys.executable, "-m", "pytest", "-q", "-W", "error", "-p", "no:cacheprovider", "--rootdir", "."]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert "assert 30 == 1" in done.stdout, done.stdout + done.stderr
    assert "1 failed, 1 passed" in done.stdout
