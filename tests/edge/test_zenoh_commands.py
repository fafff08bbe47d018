"""Commands over zenoh: what is asked reaches the daemon, and what makes no sense is refused with a sentence."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.config_ground import ZenohSettings
from edge.links.zenoh_commands import COMMANDS, Actions, Refused, answer, parse
from edge.links.zenoh_link import ZenohLink
from edge.requests import WAITING_MAX, RequestQueue, SelectTarget, StopTracking, TrackBox
from msgs.client import connect
from msgs.ground.command import RATE_MAX_HZ, RATE_MIN_HZ, ask
from msgs.recording import Recorder
from msgs.recording_store import RecordingLimits
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .reports import make_report, make_track
from .test_zenoh_link import MOUNT


@dataclass
class Commanded:
    endpoint: str
    link: ZenohLink
    requests: RequestQueue
    recorder: Recorder
    session: zenoh.Session


@contextmanager
def vehicle(folder: Path, **changed: Any) -> Iterator[Commanded]:
    endpoint, requests = free_endpoint(), RequestQueue()
    recorder = Recorder(folder, "uav1", RecordingLimits(free_bytes_min=0), print, on=False)
    link = ZenohLink(ZenohSettings(listen=[endpoint], **changed), "uav1", MOUNT, recorder, requests)
    recorder.start()
    link.start()
    try:
        with connect(endpoint) as session:
            yield Commanded(endpoint, link, requests, recorder, session)
    finally:
        link.stop()
        recorder.stop()


def put(one: Commanded) -> None:
    one.link.publish(make_report(make_track(time.monotonic_ns())))


def answered(one: Commanded, name: str, body: dict[str, Any]) -> dict[str, Any]:
    """Asked again until the link's queryable is there."""
    said: dict[str, Any] = {}

    def turn() -> None:
        said.clear()
        said.update(ask(one.session, "uav1", name, body, timeout_s=2.0))

    until(lambda: bool(said) and "does not answer" not in said.get("error", ""), turn, what="an answer")
    return said


def test_requests_reach_the_loop_in_order_and_a_stop_always(tmp_path: Path) -> None:
    with vehicle(tmp_path) as one:
        box = [0.4, 0.25, 0.5, 1]
        assert answered(one, "track", {"box": box}) == {"ok": True, "command": "track", "done": {"box": box}}
        assert answered(one, "stop", {}) == {"ok": True, "command": "stop", "done": {}}
        assert one.requests.take() == [TrackBox((0.4, 0.25, 0.5, 1.0)), StopTracking()]
        for _ in range(WAITING_MAX):
            assert answered(one, "track", {"box": box})["ok"]
        assert answered(one, "track", {"box": box})["error"] == "too many requests wait; try again"
        assert answered(one, "stop", {})["ok"]
        assert one.requests.take() == [StopTracking()]


def test_a_target_is_selected_by_its_name_if_it_is_tracked(tmp_path: Path) -> None:
    with vehicle(tmp_path) as one:
        assert answered(one, "select", {"target": "t0"})["error"] == "no target t0; there is none"
        now_ns = time.monotonic_ns()
        one.link.publish(make_report(make_track(now_ns), make_track(now_ns, track_id=2)))
        assert answered(one, "select", {"target": "t2"})["done"] == {"target": "t2"}
        assert answered(one, "select", {"target": "t1"})["error"] == "no target t1; there are t0, t2"
        assert answered(one, "select", {"target": "../t1"})["error"] == "target: a target is named t0, t1, …"
        assert one.requests.take() == [SelectTarget(2)]


def test_recording_is_switched_by_command(tmp_path: Path) -> None:
    with vehicle(tmp_path / "r") as one:
        put(one)
        assert answered(one, "record", {"on": True})["done"] == {"recording": True}
        until(lambda: one.recorder.counters()["recorded"] > 0, lambda: put(one), what="recording")
        assert answered(one, "record", {"on": False})["done"] == {"recording": False}
    assert len(list((tmp_path / "r").iterdir())) == 1


def test_the_rate_of_poses_is_capped_and_freed_and_the_recording_keeps_all(tmp_path: Path) -> None:
    with vehicle(tmp_path) as one:
        answered(one, "record", {"on": True})
        assert answered(one, "rate", {"max_hz": 4})["done"] == {"max_hz": 4.0}
        began, before = time.monotonic(), one.link.counters().get("sent_pose", 0)
        reports = one.link.counters().get("sent_detections", 0) + 40

        until(lambda: one.link.counters().get("sent_detections", 0) >= reports, lambda: put(one), what="40 reports")
        sent = one.link.counters()["sent_pose"] - before
        assert 1 <= sent <= 4 * (time.monotonic() - began) + 2
        assert answered(one, "rate", {"max_hz": None})["ok"]
        before = one.link.counters()["sent_pose"]
        until(lambda: one.link.counters()["sent_pose"] >= before + 20, lambda: put(one), what="all poses")
        until(lambda: one.recorder.counters()["recorded"] > 4 * 40, lambda: put(one), what="the recording")


def test_a_higher_rate_holds_at_once_however_low_the_one_before_it_was(tmp_path: Path) -> None:
    with vehicle(tmp_path) as one:
        assert answered(one, "rate", {"max_hz": 0.1})["ok"]
        until(lambda: one.link.counters().get("sent_pose", 0) == 1, lambda: put(one), what="the first pose")
        asked = time.monotonic()
        assert answered(one, "rate", {"max_hz": 20})["ok"]
        until(lambda: one.link.counters()["sent_pose"] >= 3, lambda: put(one), what="poses at the new rate")
        assert time.monotonic() - asked < 1 / 0.1, "it waited for what the old rate had next"


@pytest.mark.parametrize(
    ("name", "body", "error"),
    [
        ("track", b'{"box": [0.1, 0.1, 0.2]}', "box: must have 4 or more items, not 3"),
        (
            "track",
            b'{"box": [0.4, 0.1, 0.2, 0.3]}',
            "a box is [left, top, right, bottom] with left < right and top < bottom",
        ),
        ("track", b'{"box": [0.1, 0.1, 1.2, 0.3]}', "box.2: must be at most 1"),
        ("track", b'{"box": [0.1, 0.1, NaN, 0.3]}', "box.2: must be a finite number"),
        ("track", b"{}", "box: is missing"),
        ("record", b'{"on": "yes"}', "on: must be true or false"),
        ("record", b'{"on": true, "path": "/etc"}', "path: unknown key"),
        ("rate", b'{"max_hz": 1e-300}', "max_hz: must be at least 0.1"),
        ("reload", b'{"file": "/etc/passwd"}', "file: unknown key"),
        ("reload", b"{}", "this vehicle does not reload"),
        ("stop", b"[]", "must hold keys with values"),
        ("stop", b"\xff\x00", "Invalid JSON"),
        ("stop", b" " * 5000, "a body of 5000 bytes is too long"),
        ("self_destruct", b"{}", "no such command; there are track, select, stop, reload, record, rate"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path: Path, name: str, body: bytes, error: str) -> None:
    with vehicle(tmp_path) as one:
        answered(one, "rate", {"max_hz": None})
        (reply,) = one.session.get(f"uavpose/@v1/uav1/cmd/{name}", payload=body, timeout=5.0)
        assert reply.ok is not None
        said = json.loads(reply.ok.payload.to_bytes())
        assert (said["ok"], said["command"]) == (False, name)
        assert error in said["error"]
        assert one.requests.take() == []


def test_the_ground_knows_the_rates_that_a_vehicle_takes() -> None:
    for rate_hz in (RATE_MIN_HZ, RATE_MAX_HZ):
        assert parse("rate", json.dumps({"max_hz": rate_hz}).encode())
    for rate_hz in (0.99 * RATE_MIN_HZ, 1.01 * RATE_MAX_HZ):
        with pytest.raises(Refused, match="max_hz"):
            parse("rate", json.dumps({"max_hz": rate_hz}).encode())


def test_a_command_names_one_vehicle_and_one_command(tmp_path: Path) -> None:
    with vehicle(tmp_path) as one:
        answered(one, "rate", {"max_hz": None})
        for key, command in (("uavpose/@v1/*/cmd/stop", "stop"), ("uavpose/@v1/uav1/cmd/*", "*")):
            (reply,) = one.session.get(key, timeout=5.0)
            assert reply.err is not None
            assert reply.err.encoding == zenoh.Encoding.APPLICATION_JSON
            told = {"ok": False, "command": command, "error": "name one vehicle and one command"}
            assert json.loads(reply.err.payload.to_bytes()) == told
        assert one.requests.take() == []


def test_with_commands_off_nothing_answers(tmp_path: Path) -> None:
    with vehicle(tmp_path, commands=False) as one:
        until(lambda: one.link.counters().get("sent_pose", 0) > 0, lambda: put(one), what="the link")
        assert "does not answer" in ask(one.session, "uav1", "stop", {}, timeout_s=2.0)["error"]


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from([*COMMANDS, "other"]),
    st.binary(max_size=60) | st.from_regex(r'\{"[a-z_]{0,6}": .{0,20}\}').map(str.encode),
)
def test_no_body_does_more_than_be_refused(name: str, body: bytes) -> None:
    answers: list[dict[str, Any]] = []
    answer(name, body, Actions(None, None, lambda _: None, None), answers.append)
    (said,) = answers
    assert said["ok"] is (name == "rate" and said.get("done") is not None)
    assert json.loads(json.dumps(said)) == said


def test_the_ground_s_command_prints_the_answer(tmp_path: Path) -> None:
    with vehicle(tmp_path) as one:
        answered(one, "rate", {"max_hz": None})

        def run(*words: str) -> subprocess.CompletedProcess[str]:
            command = [sys.executable, "-m", "msgs.ground.cli", "command", "-e", one.endpoint, *words]
            return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)

        done = run("uav1", "track", "0.1", "0.2", "0.3", "0.4")
        assert (done.returncode, json.loads(done.stdout)["ok"]) == (0, True)
        assert one.requests.take() == [TrackBox((0.1, 0.2, 0.3, 0.4))]
        refused = run("uav1", "select", "t3")
        assert (refused.returncode, json.loads(refused.stdout)["ok"]) == (1, False)
        nonsense = run("uav1", "record", "maybe")
        assert (nonsense.returncode, nonsense.stdout) == (2, "")
        assert "record on|off" in nonsense.stderr
