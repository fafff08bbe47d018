"""`uavpose-replay score FLIGHT` on a recorded flight, and report.html in a real browser."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from playwright.sync_api import sync_playwright
from rich.console import Console

from edge.health import Activity, Condition, HealthState
from sim_replay.cli import main
from sim_replay.demo import summary_table
from sim_replay.ground_truth import PlayedSequence, read_sequence
from sim_replay.lockstep import command
from sim_replay.lockstep.player import Outputs
from sim_replay.play import PlayError, Recording
from sim_replay.report import moments
from sim_replay.report.flight_files import RecordedFlight, read_flight, remove_flight, write_flight
from sim_replay.report.page import health_of
from sim_replay.report.plots import STATE_COLORS
from sim_replay.report.write import write_report
from sim_replay.result import drops_told, judge, score_json
from sim_replay.telemetry import COLUMNS, Telemetry, write_telemetry

START_NS, UTC_NS, FPS = 50_000_000_000, 1_700_000_000_000_000_000, 30.0
MODEL = {"file": "<b>model</b>.onnx", "sha256": "ab" * 32, "precision": "int8"}
TOO_SLOW = "is sent poses at most 50 times per second"
PLOTS = {"pose", "trajectory", "timeline", "ages", "range"}
BROWSER = next((path for name in ("chromium", "google-chrome") if (path := shutil.which(name))), None)


@pytest.fixture
def flown(dark_spot_scene: Path) -> PlayedSequence:
    """The scene of five frames with all that it takes to have been flown."""
    identity = np.eye(3).tolist()
    settings = f"fps = {FPS}\nt0_ns = 0\nR_body_cam = {identity}\nt_body_cam_m = [0.0, 0.0, 0.0]\n"
    (dark_spot_scene / "sequence.toml").write_text(settings)
    row = np.zeros(len(COLUMNS) - 1)
    row[0] = 1.0
    write_telemetry(dark_spot_scene / "telemetry.csv", Telemetry(np.array([0, 10**9]), np.stack([row, row])))
    return read_sequence(dark_spot_scene)


def recording(sequence: PlayedSequence, frames: set[int], rotation_known: bool = True) -> Recording:
    """Poses of these frames at both peers, 10 m short, with a covariance that allows for it."""
    made = Recording(START_NS, UTC_NS, 14550, "tcp/127.0.0.1:7448", 0, {"dropped": 1})
    for truth in sequence.scene.truths:
        if truth.frame not in frames:
            continue
        capture_ns = START_NS + round(truth.frame * 1e9 / FPS)
        t_m = (truth.t_cam_target_m * 0.95).tolist()
        pose: dict[str, Any] = {"t_cam_target_m": t_m, "q_cam_target_wxyz": [1.0, 0.0, 0.0, 0.0]}
        pose["rotation_known"] = rotation_known
        covariance = np.diag([4.0, 4.0, 100.0, 0.01, 0.01, 0.01]).tolist()
        stamp = {"capture_utc_ns": capture_ns + UTC_NS, "age_ms": 14.0, "covariance": covariance}
        made.take("subscriber", {"event": "pose", "target": "t0", **stamp, **pose})
        times = {"capture_utc_us": (capture_ns + UTC_NS) // 1000, "received_ns": capture_ns + 12_000_000}
        made.take("autopilot", {"event": "target_relative", "target": 0, **times, **pose})
    for second, message in enumerate(("init; waiting for the camera", "tracking")):
        values = {"frame_rate_hz": "30.0", "dropped": "1"}
        stamp_ns = START_NS + UTC_NS + (second - 1) * 10**9
        record = {"event": "diagnostics", "stamp_utc_ns": stamp_ns, "message": message, "values": values}
        made.take("subscriber", record)
    made.take("autopilot", {"event": "summary", "received": {"TARGET_RELATIVE": 2}, "refused": {}})
    return made


@pytest.fixture
def flight(flown: PlayedSequence, tmp_path: Path) -> Path:
    """A recorded flight that lost its target in frame 1."""
    folder = tmp_path / "flight"
    folder.mkdir()
    write_flight(folder, RecordedFlight(flown.scene.folder, MODEL, recording(flown, {0, 2, 3})))
    return folder


def test_a_recorded_flight_reads_back_as_it_was(flown: PlayedSequence, tmp_path: Path) -> None:
    made = recording(flown, {0, 1, 2, 3})
    write_flight(tmp_path, RecordedFlight(flown.scene.folder, {"file": "m"}, made, speed=0.5))
    back = read_flight(tmp_path)
    assert back.recording == made
    assert back.speed == 0.5
    assert back.sequence == flown.scene.folder.resolve()


def test_the_command_scores_what_each_peer_received_and_a_new_flight_removes_that_and_nothing_else(
    flight: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["score", str(flight), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told == json.loads((flight / "score.json").read_text())
    assert told["overall"]["recall"] == 0.75
    for name, age_ms in (("subscriber", 14.0), ("autopilot", 12.0)):
        peer = told["peers"][name]
        assert peer["poses"] == 3
        assert peer["age_ms"]["p50"] == pytest.approx(age_ms, abs=0.01)
        assert peer["range_error_m"]["mean_rel"] == pytest.approx(-0.05)
        assert peer["continuity"]["fragments"] == 1
    assert told["peers"]["subscriber"]["nees"]["pose"]["within_95pct"] == 1.0
    assert told["peers"]["autopilot"]["nees"] is None
    frames = [json.loads(line) for line in (flight / "frames.jsonl").read_text().splitlines()]
    assert [frame["subscriber"]["targets"][0]["track"] for frame in frames[:4]] == ["t0", None, "t0", "t0"]
    assert frames[4]["subscriber"]["targets"] == []
    assert (flight / "report.html").is_file()
    (flight / "recordings").mkdir()
    users = [flight / "recordings/uav1_000003.mcap", flight / "notes.txt", flight / "overlay.mp4.txt"]
    for path in users:
        path.touch()
    remove_flight(flight)
    assert sorted(path for path in flight.rglob("*") if path.is_file()) == sorted(users)


@pytest.mark.parametrize(
    ("full", "words"),
    [
        ("frames.jsonl", ", or standard output: No space left on device"),
        ("overlay.png", "/overlay.png: cannot be written"),
    ],
)
def test_a_full_disk_is_told_with_the_place(
    flight: Path, full: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (flight / full).symlink_to("/dev/full")
    assert main(["score", str(flight)]) == 1
    assert capsys.readouterr().err.splitlines()[-1] == f"{flight}{words}"


def test_in_lock_step_there_is_no_age_and_no_latency_and_a_target_held_throughout_is_without_a_gap(
    flown: PlayedSequence, tmp_path: Path
) -> None:
    made = replace(recording(flown, {0, 1, 2, 3}), zenoh_endpoint="", daemon_counters={})
    flight = RecordedFlight(flown.scene.folder, MODEL, made)
    score, _ = write_report(flown, flight, tmp_path, lambda: None)
    assert set(score["latency_ms"].values()) == {None}
    assert card((tmp_path / "report.html").read_text(), "Gaps").startswith("good:  0 ")
    for peer in score["peers"].values():
        assert (peer["poses"], peer["overall"]["recall"]) == (4, 1.0)
        assert set(peer["age_ms"].values()) == {None}
    frames = [json.loads(line) for line in (tmp_path / "frames.jsonl").read_text().splitlines()]
    assert all(frame[name]["age_ms"] == [] for frame in frames for name in ("subscriber", "autopilot"))
    console = Console(width=100)
    with console.capture() as shown:
        console.print(summary_table(score))
    assert re.search(r"capture to MAVLink, p50 / p95 / p99 +│ – +│", shown.get())


def test_what_mavlink_withheld_is_told_beside_its_latency(flown: PlayedSequence) -> None:
    made = replace(recording(flown, {0, 2}), daemon_counters={"dropped": 1, "mavlink_tracks_withheld": 7})
    score = score_json(flown, judge(flown, made), MODEL)
    assert score["latency_ms"]["tracks_withheld"] == 7
    console = Console(width=100)
    with console.capture() as shown:
        console.print(summary_table(score))
    assert re.search(r"withheld by MAVLink, too unsure or too old +│ 7 ", shown.get())


def test_a_view_with_a_direction_alone_is_told_in_all_that_is_made_of_the_flights_files(
    flown: PlayedSequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = recording(flown, {0, 2})
    captured_ns = START_NS + UTC_NS + round(1e9 / FPS)
    ray_cam = flown.scene.truths[1].t_cam_target_m / np.linalg.norm(flown.scene.truths[1].t_cam_target_m)
    told = {"event": "direction", "target": "t1", "capture_utc_ns": captured_ns, "age_ms": 14.0}
    made.take("subscriber", told | {"ray_cam": ray_cam.tolist()})
    made.take("subscriber", told | {"target": "t2", "ray_cam": [0.6, 0.0, 0.8]})
    write_flight(tmp_path, RecordedFlight(flown.scene.folder, MODEL, made))
    assert read_flight(tmp_path).recording == made
    assert main(["score", str(tmp_path)]) == 0
    assert "4 views, 0 false poses, a direction alone in 1" in card(
        (tmp_path / "report.html").read_text(), "Targets found"
    )
    assert re.search(r"directions received, range not known +│ 2 ", capsys.readouterr().out)
    assert json.loads((tmp_path / "score.json").read_text())["directions"]["targets"] == 1
    frames = [json.loads(line) for line in (tmp_path / "frames.jsonl").read_text().splitlines()]
    assert frames[1]["directions"] == [
        {"track": "t1", "ray_cam": pytest.approx(ray_cam, abs=1e-6), "bearing_error_deg": pytest.approx(0.0, abs=1e-5)},
        {"track": "t2", "ray_cam": [0.6, 0.0, 0.8], "bearing_error_deg": None},
    ]
    assert [frame["directions"] for frame in frames if frame["frame"] != 1] == [[]] * 4


def test_the_report_stands_by_itself_in_a_real_browser(flight: Path) -> None:
    assert main(["score", str(flight)]) == 0
    assert BROWSER is not None, "no chromium: sh deploy/bootstrap.sh dev installs it"
    alone = flight / "elsewhere"
    alone.mkdir()
    page_file = shutil.copy(flight / "report.html", alone)
    complaints, asked = [], []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1360, "height": 900})
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("request", lambda request: asked.append(request.url))
        page.goto(Path(page_file).as_uri())
        page.wait_for_function("document.querySelector('video').readyState >= 2")
        boxes = {plot.get_attribute("data-plot"): plot.bounding_box() for plot in page.locator("svg[data-plot]").all()}
        drawn = [page.locator(f"svg[data-plot={name}] path").count() for name in PLOTS]
        broken = page.evaluate("[...document.images].filter(image => !image.complete || !image.naturalWidth).length")
        sideways = page.evaluate("document.documentElement.scrollWidth - document.documentElement.clientWidth")
        shown, text = page.locator(".moments figure").count(), page.inner_text("body")
        page.screenshot(path=flight / "report.png", full_page=True)
        browser.close()
    assert complaints == []
    assert all(url.startswith(("file:", "data:")) for url in asked), asked
    assert set(boxes) == PLOTS
    assert all(box is not None and box["width"] > 800 and box["height"] > 150 for box in boxes.values()), boxes
    assert min(drawn) > 20
    assert (broken, sideways) == (0, 0)
    assert shown == 1  # five frames last a sixth of a second
    assert "<b>model</b>.onnx" in text
    assert "waiting for the camera" in text
    assert "75.0 %" in text


def test_a_part_that_is_played_where_a_flight_was_does_not_pass_for_it(
    flown: PlayedSequence, flight: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    part = ["play", "--sequence", str(flown.scene.folder), "--start", "0.1", "--out", str(flight)]

    def nothing_came(*_: object) -> Outputs:
        return Outputs([], [], Recording(0, 0, 0, "", 0))

    def dies(*_: object) -> Outputs:
        raise PlayError("the daemon ended in the middle of the sequence")

    monkeypatch.setattr(command, "play_lockstep", nothing_came)
    assert main(part) == 0
    assert sorted(path.name for path in flight.iterdir()) == ["mavlink.jsonl", "poses.jsonl"]
    assert main(["score", str(flight)]) == 2
    assert "flight.json: cannot be read" in capsys.readouterr().err
    monkeypatch.setattr(command, "play_lockstep", dies)
    assert main(part) != 0
    assert list(flight.iterdir()) == []


def card(page: str, label: str) -> str:
    """Tone, value and note of a card, as text."""
    found = re.search(rf'<div class="card (.*?)"><div class="label">{label}</div>(.*?</div>.*?)</div>', page)
    assert found is not None
    return re.sub(r"(<[^>]*>)+", " ", f"{found[1]}: {found[2]}")


def test_frames_that_the_machine_dropped_are_told_apart_from_misses_of_the_model(
    flown: PlayedSequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = recording(flown, {0, 3})
    made.daemon_counters["dropped"] = 2
    write_flight(tmp_path, RecordedFlight(flown.scene.folder, MODEL, made))
    assert main(["score", str(tmp_path)]) == 0
    page = (tmp_path / "report.html").read_text()
    for text in (capsys.readouterr().out, page):
        assert "2 of 5 frames were dropped: this machine was too busy or too slow; each with a target in view" in text
    assert re.match(r"fair:  1 longest time without a pose 0\.10 s", card(page, "Gaps"))
    score = json.loads((tmp_path / "score.json").read_text())
    assert drops_told(flown, score | {"dropped_frames": 0}) is None
    recorded = replace(flown, scene=replace(flown.scene, unrecorded=frozenset({1, 2})))
    assert drops_told(recorded, score) is None  # they were never recorded


def test_frames_that_mavlink_is_too_slow_for_are_told_apart_from_misses_of_the_daemon(
    flown: PlayedSequence, tmp_path: Path
) -> None:
    faster = replace(flown, fps=60.0)
    write_report(faster, RecordedFlight(flown.scene.folder, MODEL, recording(flown, {0, 1})), tmp_path, lambda: None)
    assert (tmp_path / "report.html").read_text().count(TOO_SLOW) == 1


def test_a_report_says_where_no_rotation_was_told_and_ranges_too_far_and_too_near_are_not_right_on_average(
    flown: PlayedSequence, tmp_path: Path
) -> None:
    unturned = recording(flown, {0, 1, 2, 3}, rotation_known=False)
    for k, pose in enumerate(unturned.poses):
        pose["t_cam_target_m"] = [(0.7, 1.3)[k % 2] / 0.95 * metres for metres in pose["t_cam_target_m"]]
    write_report(flown, RecordedFlight(flown.scene.folder, MODEL, unturned), tmp_path, lambda: None)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "rotation <b>not known</b>, range <b>" in page
    assert "not known in 4" in page
    assert "<tr><th>rotation (3)</th>\n<td>–</td>" in page
    assert re.match(r"bad:  30\.0 % mean; bias [+−]0\.", card(page, "Range error"))


def test_a_flight_that_brought_nothing_has_a_report_and_stills_of_too_large_a_film(
    flown: PlayedSequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(moments, "VIDEO_MAX_BYTES", 0)
    monkeypatch.chdir(tmp_path)
    out = Path("14:36")  # ffmpeg would take it for a protocol
    silent = Recording(START_NS, UTC_NS, 14550, "tcp/127.0.0.1:7448", 0, {})
    sequence = replace(flown, fps=50.0)
    score, files = write_report(sequence, RecordedFlight(flown.scene.folder, MODEL, silent), out, lambda: None)
    page = (out / "report.html").read_text()
    assert "report.html" in files
    assert score["overall"]["recall"] == 0.0
    assert "<video" not in page
    assert page.count('alt="still ') == moments.STILLS
    assert "no pose received" in page
    assert TOO_SLOW not in page, "it is fast enough for as many frames as are sent"
    assert card(page, "Time to acquire").startswith("bad: ")
    assert card(page, "Gaps").startswith(":  0 "), "what was never held is no good"
    assert "nan" not in page.split("<details>")[0].split("</svg>")[-1].lower()


def test_an_empty_sky_is_scored_by_the_poses_received_in_it(
    flown: PlayedSequence, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = recording(flown, {0, 2})
    folder = tmp_path / "flight [over:sea:]"
    folder.mkdir()
    write_flight(folder, RecordedFlight(flown.scene.folder, MODEL, made))
    labels = flown.scene.folder / "scene_gt.json"
    labels.write_text("{}")
    assert main(["score", str(folder)]) == 0
    told = capsys.readouterr().out
    assert re.search(r"poses that match no target +│ 2 ", told)
    assert f"written to {folder}: report.html" in told
    score = json.loads((folder / "score.json").read_text())
    assert (score["overall"]["false_poses"], score["overall"]["false_positives_per_1000"]) == (2, 400.0)
    page = (folder / "report.html").read_text()
    assert "0 views, 2 false poses" in page
    assert card(page, "Gaps").startswith(":  0 ")
    labels.unlink()
    assert main(["score", str(folder)]) == 2
    assert "there is no ground truth to score against" in capsys.readouterr().err


def test_a_flight_that_is_none_or_is_damaged_is_named(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (flight / "received.jsonl").write_text('{"peer": "subscriber"}\n')
    spoiled = tmp_path / "spoiled"
    spoiled.mkdir()
    (spoiled / "flight.json").write_text('{"sequence": "x"}')
    endless = tmp_path / "endless"
    endless.mkdir()
    (endless / "flight.json").write_text('{"start_at_ns": Infinity}')
    for arguments, named in (
        ([tmp_path / "nowhere"], "nowhere/flight.json"),
        ([spoiled], "'start_at_ns' is missing"),
        ([endless], "endless/flight.json: not as expected"),
        ([flight], "received.jsonl: line 1"),
        ([], "FLIGHT"),
        ([flight, "--dataset", tmp_path], "FLIGHT"),
    ):
        assert main(["score", *map(str, arguments)]) == 2
        assert named in capsys.readouterr().err


def test_every_state_that_the_daemon_tells_has_its_colour_in_the_timeline(flown: PlayedSequence) -> None:
    made = recording(flown, set())
    for state, activity in product(HealthState, Activity):
        condition = Condition(state, activity)
        message, values = f"{condition.headline}; no frame", {"state": state.value, "activity": activity.value}
        record = {"event": "diagnostics", "stamp_utc_ns": START_NS + UTC_NS, "message": message, "values": values}
        made.take("subscriber", record)
        sample = health_of(made)[-1]
        assert sample.state in STATE_COLORS
        assert (sample.headline, sample.reasons) == (condition.headline, "no frame")
