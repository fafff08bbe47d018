"""`soak`: what grows is told from what wavers, and a real flight of seconds is flat."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from sim_replay.cli import main
from sim_replay.faults.rig import Rig, RigSettings
from sim_replay.ground_truth import read_sequence
from sim_replay.pace import at_speed
from sim_replay.pipeline.flight import Flight
from sim_replay.pipeline.soak import silences, table, trends
from sim_replay.pipeline.usage import Usage
from tests.edge.toy_model import write_toy_model
from tests.sim_replay.toy_flight import write_toy_flight
from tests.waiting import until

MINUTES, FPS = 4.0, 30.0
START_NS, UTC_NS = 7_000_000_000, 1_700_000_000_000_000_000
SECONDS = np.arange(round(MINUTES * 60))


def steady() -> Flight:
    """Four minutes in which everything wavers and nothing grows; the first half minute warms up."""
    chance = np.random.default_rng(3)
    flight = Flight(START_NS - 10**9, START_NS, UTC_NS)
    for second in SECONDS.tolist():
        now_ns = START_NS + second * 10**9
        rss_mb = 180.0 + 40.0 * (1.0 - np.exp(-second / 8.0)) + chance.normal(0.0, 0.7)
        flight.usage.append(
            Usage(now_ns, 0.8 * second, 0.1 * second, rss_mb, 40 + int(chance.integers(3)), 14 + second % 2)
        )
        flight.logged.append((now_ns, 150))
        values = {"dropped": str(second // 60)}
        flight.diagnostics.append({"stamp_utc_ns": now_ns + UTC_NS, "values": values})
        for frame in range(0, 30, 5):
            capture_ns = now_ns + frame * 33_000_000
            age_ns = round(1e6 * (12.0 + chance.gamma(2.0, 3.0)))
            stamp_us = (capture_ns + UTC_NS) // 1000
            flight.targets.append({"capture_utc_us": stamp_us, "received_ns": capture_ns + age_ns})
            flight.poses_ns.append(capture_ns + age_ns)
    return flight


def growing(flight: Flight) -> set[str]:
    return {trend.name for trend in trends(flight, FPS) if trend.grows}


def test_what_wavers_does_not_grow() -> None:
    told = trends(steady(), FPS)
    assert all(trend.grows is False for trend in told), told


def constant() -> Flight:
    """As `steady`, with nothing left to chance, and one frame dropped in each ten seconds."""
    flight = Flight(START_NS - 10**9, START_NS, UTC_NS)
    for second in SECONDS.tolist():
        now_ns = START_NS + second * 10**9
        # The daemon had run and waited before: of that nothing is this flight's.
        flight.usage.append(Usage(now_ns, 500.0 + 0.8 * second, 2000.0 + 0.1 * second, 200.0, 40, 14))
        flight.logged.append((now_ns, 150))
        flight.diagnostics.append({"stamp_utc_ns": now_ns + UTC_NS, "values": {"dropped": str(second // 10)}})
        flight.targets.append({"capture_utc_us": (now_ns + UTC_NS) // 1000, "received_ns": now_ns + 20_000_000})
        flight.poses_ns.append(now_ns + 20_000_000)
    return flight


def test_what_is_allowed_is_told_as_worked_by_hand() -> None:
    """239 s without their first quarter are thirds of 59.75 s: of sixty samples each, and of 1792.5 frames."""
    log = 60 * 150 / (59.75 / 60)
    allowed = {
        "memory": (200.0, 200.0 + 22.0),
        "open descriptors": (40.0, 43.0),
        "threads": (14.0, 16.0),
        "log": (log, 2 * log + 6000.0),
        "frames dropped": (5.0, 2 * 5.0 + 17.925),
        "age at the autopilot, p50": (20.0, 1.5 * 20.0 + 10.0),
    }
    told = trends(constant(), FPS)
    for trend in told:
        early, limit = allowed[trend.name]
        assert (trend.early, trend.late, trend.allowed) == pytest.approx((early, early, limit)), trend.name
        assert trend.grows is False, trend.name
    at_limit, above, unheard = constant(), constant(), constant()
    for flight, more_mb in ((at_limit, 22.0), (above, 22.5)):
        flight.usage = [replace(u, rss_mb=u.rss_mb + more_mb * (k >= 120)) for k, u in enumerate(flight.usage)]
    unheard.targets.clear()
    assert growing(at_limit) == set()
    assert growing(above) == {"memory"}
    lines = [" ".join(line.split()) for line in table(trends(above, FPS), MINUTES).splitlines()]
    assert lines[0] == "4 minutes early late allowed"
    assert lines[1:3] == ["memory 200.0 222.5 222.0 MB GROWS", "open descriptors 40.0 40.0 43.0 flat"]
    assert " ".join(table(trends(unheard, FPS), MINUTES).split()).endswith(
        "age at the autopilot, p50 - - - ms not judged"
    )


def test_pictures_in_flight_are_no_leak() -> None:
    flight = steady()
    waiting = np.random.default_rng(4).integers(0, 8, len(flight.usage))
    flight.usage = [replace(u, rss_mb=u.rss_mb + 6.2 * int(waiting[k]) * (k > 150)) for k, u in enumerate(flight.usage)]
    assert growing(flight) == set()


def test_a_leak_of_some_kilobytes_a_frame_is_found_in_minutes() -> None:
    flight = steady()
    flight.usage = [replace(u, rss_mb=u.rss_mb + 0.2 * k) for k, u in enumerate(flight.usage)]
    assert growing(flight) == {"memory"}


def test_descriptors_and_threads_that_are_never_closed_are_found() -> None:
    flight = steady()
    flight.usage = [replace(u, descriptors=u.descriptors + k // 20) for k, u in enumerate(flight.usage)]
    assert growing(flight) == {"open descriptors"}
    flight = steady()
    flight.usage = [replace(u, threads=u.threads + k // 40) for k, u in enumerate(flight.usage)]
    assert growing(flight) == {"threads"}


def test_a_log_that_swells_drops_that_multiply_and_poses_that_age_are_found() -> None:
    flight = steady()
    flight.logged = [(at_ns, 150 + 10 * max(k - 120, 0)) for k, (at_ns, _) in enumerate(flight.logged)]
    assert growing(flight) == {"log"}
    flight = steady()
    for k, record in enumerate(flight.diagnostics):
        record["values"]["dropped"] = str(max(k - 120, 0))
    assert growing(flight) == {"frames dropped"}
    flight = steady()
    flight.targets = [
        {**record, "received_ns": record["received_ns"] + 100_000 * k} for k, record in enumerate(flight.targets)
    ]
    assert growing(flight) == {"age at the autopilot, p50"}


def test_age_and_drops_of_a_busy_machine_are_not_judged_and_leaks_still_are() -> None:
    flight = steady()
    flight.usage = [replace(u, waited_s=2.0 * u.cpu_s, rss_mb=u.rss_mb + 0.2 * k) for k, u in enumerate(flight.usage)]
    told = {trend.name: trend.grows for trend in trends(flight, FPS)}
    assert told["age at the autopilot, p50"] is told["frames dropped"] is None
    assert told["memory"] is True


@pytest.mark.parametrize("share", [0.1, 0.7])  # in the warm-up, and after it
def test_poses_that_never_came_or_stopped_are_told_of_each_peer(share: float) -> None:
    flight = steady()
    assert silences(flight) == []
    until_ns = START_NS + round(share * MINUTES * 60e9)
    flight.targets = [record for record in flight.targets if record["received_ns"] < until_ns]
    (told,) = silences(flight)
    last_s = round(share * MINUTES * 60)
    assert re.fullmatch(rf"the autopilot received \d+ poses, the last after {last_s} s", told)
    flight.poses_ns.clear()
    assert silences(flight) == [told, "the subscriber received no pose"]


def test_a_target_that_is_found_late_or_lost_at_the_end_is_no_silence() -> None:
    found, lost = steady(), steady()
    found.poses_ns = found.poses_ns[-20:]
    lost.poses_ns = lost.poses_ns[: round(0.8 * len(lost.poses_ns))]
    assert silences(found) == silences(lost) == []


def test_a_flight_of_moments_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["soak", "--minutes", "0.15", "--out", str(tmp_path)]) == 2
    assert "--minutes 0.15: must be at least 0.2" in capsys.readouterr().err


def test_a_soak_without_a_pose_fails(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sky = write_toy_flight(tmp_path / "sky", target=False)
    model = write_toy_model(tmp_path / "toy.onnx")
    flown = ["soak", "--minutes", "0.2", "--fps", "5", "--sequence", str(sky), "--model", str(model)]
    assert main([*flown, "--out", str(tmp_path)]) == 1
    assert "the autopilot received no pose" in capsys.readouterr().out
    assert "the subscriber received no pose" in json.loads((tmp_path / "soak.json").read_text())["silences"]


def test_a_scene_that_is_its_own_output_folder_stays_as_it_was(tmp_path: Path) -> None:
    scene, model = write_toy_flight(tmp_path / "scene"), write_toy_model(tmp_path / "toy.onnx")
    before = {path: path.read_bytes() for path in scene.rglob("*") if path.is_file()}
    flown = ["bench-pipeline", "--minutes", "0.02", "--sequence", str(scene), "--model", str(model)]
    assert main([*flown, "--out", str(scene)]) == 0
    at_speed(read_sequence(scene), 2.0, scene)
    with Rig(RigSettings(scene, scene, model)):
        pass
    assert {path: path.read_bytes() for path in before} == before


def test_an_interrupted_run_does_not_leave_the_report_of_an_earlier_one(tmp_path: Path) -> None:
    for command, report in (("soak", "soak.json"), ("bench-pipeline", "pipeline.json")):
        (tmp_path / report).write_text("{}")
        (tmp_path / "config.toml").unlink(missing_ok=True)
        words = [sys.executable, "-m", "sim_replay.cli", command, "--out", str(tmp_path)]
        with subprocess.Popen(words) as flying:
            until((tmp_path / "config.toml").exists, what="the daemon's configuration")
            flying.send_signal(signal.SIGINT)
        assert flying.returncode == 130
        assert not (tmp_path / report).exists()


def test_the_daemon_holds_on_to_nothing_in_a_minute(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["soak", "--minutes", "1", "--out", str(tmp_path), "--json"])
    told = {trend["name"]: trend for trend in json.loads(capsys.readouterr().out)["trends"]}
    for name in ("memory", "open descriptors", "threads", "log"):
        assert told[name]["grows"] is False, told[name]
    written = json.loads((tmp_path / "soak.json").read_text())
    assert written["trends"] == list(told.values())
    assert code == int(bool(written["silences"]) or any(trend["grows"] is True for trend in told.values()))
