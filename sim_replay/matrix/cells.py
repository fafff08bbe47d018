"""One cell of the matrix: a sequence at a speed, either flown completely and scored, or with a fault timeline."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from edge.estimator.model import Model
from sim_replay.faults.judge import ages_ms, violations
from sim_replay.faults.messages import AUTOPILOT
from sim_replay.faults.rig import Rig, RigSettings
from sim_replay.faults.run import play_timeline
from sim_replay.faults.timeline import Timeline
from sim_replay.ground_truth import PlayedSequence
from sim_replay.matrix.verdict import wrong_poses
from sim_replay.offline import method_of
from sim_replay.pace import at_speed
from sim_replay.play import PlayError, PlaySettings, play
from sim_replay.report.flight_files import RecordedFlight, remove_flight, write_flight
from sim_replay.report.peer import percentiles
from sim_replay.result import judge, score_json

NO_FAULT = "none"
RIG_FPS = 10.0  # of a rig at speed 1, as in `faults`


@dataclass(frozen=True)
class Cell:
    """Result of a cell; None where unknown. With faults the own ship hovers, so errors are not evaluated."""

    sequence: str
    speed: float
    fault: str
    wrong: tuple[str, ...]  # empty: as expected
    poses: int = 0  # at the autopilot
    found: float | None = None  # share of the visible targets
    rotation_error_deg: float | None = None  # median
    range_error_rel: float | None = None  # mean of the signed error, a bias
    age_p50_ms: float | None = None  # at the autopilot
    age_max_ms: float | None = None
    dropped: int | None = None  # frames, by the daemon


def fly_cell(sequence: PlayedSequence, speed: float, model: Model, out: Path) -> Cell:
    """Play it once; if that fails, the reason is in `wrong`. Raises InputError."""
    name = sequence.scene.name
    out.mkdir(parents=True, exist_ok=True)
    flown = at_speed(sequence, speed, out)
    remove_flight(out)
    try:
        recording = play(PlaySettings(flown, out, model.path), lambda _recording, _record: None)
    except PlayError as error:
        return Cell(name, speed, NO_FAULT, (str(error),))
    facts = method_of(model)
    write_flight(out, RecordedFlight(sequence.scene.folder, facts, recording, speed))
    result = judge(flown, recording)
    score = score_json(flown, result, facts)
    peer = score["peers"]["autopilot"]
    return Cell(
        name,
        speed,
        NO_FAULT,
        wrong_poses(flown, result),
        peer["poses"],
        peer["overall"]["recall"],
        peer["overall"]["rotation_error_deg"]["median"],
        peer["range_error_m"]["mean_rel"],
        peer["age_ms"]["p50"],
        peer["age_ms"]["max"],
        score["dropped_frames"],
    )


def break_cell(sequence: PlayedSequence, speed: float, fault: str, timeline: Timeline, model: Path, out: Path) -> Cell:
    """Play a timeline on a rig that shows the sequence's images; `wrong` has what was not as expected.

    Timelines expect poses: the sequence must show a target. One with a volume needs a host where `can_mount`.
    Raises InputError.
    """
    name = sequence.scene.name
    out.mkdir(parents=True, exist_ok=True)
    settings = RigSettings(
        out, sequence.scene.folder, model, fps=RIG_FPS * speed, volume=timeline.volume, signed=timeline.signed
    )
    try:
        with Rig(settings) as rig:
            outcome = play_timeline(rig, timeline, lambda _: None)
    except PlayError as error:
        return Cell(name, speed, fault, (str(error),))
    received = ages_ms(rig.witness, AUTOPILOT)
    age = percentiles(received)
    dropped = rig.witness.counters.get("dropped")
    wrong = (*outcome.wrong, *violations(rig.witness))
    return Cell(name, speed, fault, wrong, len(received), age_p50_ms=age["p50"], age_max_ms=age["max"], dropped=dropped)
