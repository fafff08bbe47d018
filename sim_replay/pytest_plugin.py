"""The pytest fixture `uavpose_replay`: a replay test of your own flight in five lines.

    def test_the_target_is_held(uavpose_replay):
        flight = uavpose_replay("flights/over-the-lake")
        assert flight.score["overall"]["recall"] > 0.9
        assert flight.peer("autopilot")["age_ms"]["p99"] < 50.0
        assert flight.peer("subscriber")["continuity"]["identity_switches"] == 0

pytest finds it automatically if this project is installed with its `replay` extra.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from sim_replay.ground_truth import PlayedSequence
    from sim_replay.play import Recording

Replay = Callable[..., "ReplayedFlight"]


@dataclass(frozen=True, eq=False)
class ReplayedFlight:
    """A sequence flown through the real daemon with a simulated autopilot and a zenoh subscriber."""

    sequence: PlayedSequence
    recording: Recording  # every record of both peers, and the daemon's counters
    score: dict[str, Any]  # score.json, described in docs/reports.md
    folder: Path  # daemon.log, config.toml, flight.json, received.jsonl; report.html if requested

    def peer(self, name: str) -> dict[str, Any]:
        """The figures of what `subscriber` or `autopilot` received."""
        found: dict[str, Any] = self.score["peers"][name]
        return found


@pytest.fixture(scope="session")
def uavpose_replay(tmp_path_factory: pytest.TempPathFactory) -> Replay:
    """`uavpose_replay(sequence, model=None, speed=1.0, report=False)`: fly and score it; returns a ReplayedFlight.

    `sequence` is a scene folder with sequence.toml and telemetry.csv; `model` an ONNX file, by default the shipped one;
    `speed` below 1 gives a slow machine more time; `report` also creates overlay.mp4 and report.html. To test several
    properties of one flight, keep it in a fixture of your own. Raises InputError, PlayError.
    """
    # Imported here so that only tests that request a flight pay for it.
    from edge.config import SHIPPED_MODEL
    from edge.estimator.model import load_model
    from sim_replay.ground_truth import read_sequence
    from sim_replay.offline import method_of
    from sim_replay.pace import at_speed
    from sim_replay.play import PlaySettings, play
    from sim_replay.report.flight_files import RecordedFlight, write_flight
    from sim_replay.report.write import write_report
    from sim_replay.result import judge, score_json

    def replay(
        sequence: str | Path, model: str | Path | None = None, speed: float = 1.0, report: bool = False
    ) -> ReplayedFlight:
        model_file = SHIPPED_MODEL if model is None else Path(model)
        folder = tmp_path_factory.mktemp("replay")
        flown = at_speed(read_sequence(Path(sequence)), speed, folder)
        facts = method_of(load_model(model_file, threads=1))
        recording = play(PlaySettings(flown, folder, model_file), lambda _recording, _record: None)
        flight = RecordedFlight(flown.scene.folder, facts, recording, speed)
        write_flight(folder, flight)
        if report:
            score, _ = write_report(flown, flight, folder, lambda: None)
        else:
            score = score_json(flown, judge(flown, recording), facts)
        return ReplayedFlight(flown, recording, score, folder)

    return replay
