from __future__ import annotations

import hashlib
import json
import logging
import queue
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
from hypothesis import given
from hypothesis import strategies as st
from zenoh import handlers

from edge import clock
from edge.config import SHIPPED_MODEL, Config
from edge.health import HealthState
from edge.links.signing_key import write_new_key
from edge.reload import Reloaded, needs_restart, with_live_keys
from edge.status import ask
from msgs.cdr import Log
from msgs.client import connect, subscribe
from msgs.contract import ModelContract
from msgs.ground.keys import init_authority, issue
from sim_replay.ports import free_port
from tests.certificates import redate
from tests.waiting import until

from .flying import Flight, flying, toml
from .looping import HELD, Gated, frame, looping
from .toy_model import CONTRACT, ONE_PICTURE_GRAPH, write_toy_model


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
def flight(tmp_path: Path, swaying: Path, port: int) -> Iterator[Flight]:
    write_toy_model(tmp_path / "flown.onnx")
    with flying(tmp_path, toml(swaying, tmp_path / "flown.onnx", port)) as flight:
        yield flight


def model_hash(port: int) -> str:
    answer = ask(f"tcp/127.0.0.1:{port}", "uav1")
    assert answer is not None
    assert answer["model"]["sha256"] == answer["info"]["model_sha256"]
    return str(answer["info"]["model_sha256"])


def sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_a_new_model_takes_over_between_frames_and_the_track_lives_on(
    flight: Flight, tmp_path: Path, swaying: Path, port: int
) -> None:
    model, config = tmp_path / "flown.onnx", tmp_path / "config.toml"
    before = sha256(model)
    with connect(f"tcp/127.0.0.1:{port}") as session, subscribe(session, "uav1") as poses:
        first = next(iter(poses))
        assert model_hash(port) == before
        write_toy_model(model, name="another")
        config.write_text(toml(swaying, model, port, "[estimator]\nacquire_every_n = 50\n", fps=11))
        flight.process.send_signal(signal.SIGHUP)
        said = flight.until("reloaded: ")
        last = next(iter(poses))
    after = sha256(model)
    assert f"model {before[:12]} replaced by another {after[:12]}" in said
    assert "taken over: [estimator] acquire_every_n" in said
    assert "needs a restart: [camera] fps" in said
    assert model_hash(port) == after != before
    assert last.target == first.target
    assert not re.search("searching|init|coasting", "".join(flight.lines).partition("reload: reading")[2])


def test_the_target_s_size_is_flown_by_from_the_start_and_when_it_changes(
    tmp_path: Path, swaying: Path, toy_model: Path, port: int
) -> None:
    """The toy's aircraft, seen from behind, is 120 pixels wide for a lens of 2000, and 235.7 m away by the toy's word.
    It is so sure that wings of 14 or 16 m, which would be at 221 and 254 m, move it little, and 60 m are not believed.
    """
    config = tmp_path / "config.toml"
    told_m = {}
    text = toml(swaying, toy_model, port, fps=11)
    with (
        flying(tmp_path, text + "[target]\nwingspan_m = 14.0\nlength_m = 10.0\n") as flight,
        connect(f"tcp/127.0.0.1:{port}") as session,
        subscribe(session, "uav1") as poses,
    ):
        depths_m = (one.pose.t_cam_target_m[2] for one in poses)
        told_m[14] = next(depths_m)
        config.write_text(text + "[target]\nwingspan_m = 16.0\nlength_m = 10.0\n")
        flight.process.send_signal(signal.SIGHUP)
        assert "taken over: [target] wingspan_m" in flight.until("reloaded: ")
        told_m[16] = next(depth_m for depth_m in depths_m if depth_m > 236.2)
        config.write_text(text + "[target]\nwingspan_m = 60.0\nlength_m = 40.0\n")
        flight.process.send_signal(signal.SIGHUP)
        said = flight.until("the target appears to be")
    assert told_m[14] < 235.2
    assert told_m[16] < 240.0
    assert "0.25 times as large as [target] says" in said


def test_what_is_wrong_changes_nothing_and_is_named(flight: Flight, tmp_path: Path, swaying: Path, port: int) -> None:
    model, config = tmp_path / "flown.onnx", tmp_path / "config.toml"
    before, good = sha256(model), toml(swaying, model, port)
    torn, other, single, backwards = (tmp_path / f"{name}.onnx" for name in ("torn", "other", "single", "backwards"))
    torn.write_bytes(model.read_bytes()[:300])
    write_toy_model(other, metadata=json.dumps({"version": 99}))
    write_toy_model(single, graph=ONE_PICTURE_GRAPH)
    # A contract that the daemon would divide by, or find nothing within.
    spans = json.loads(ModelContract(**CONTRACT).model_dump_json()) | {"trained_box_px": [0.0, 0.0]}
    write_toy_model(backwards, metadata=json.dumps(spans))
    for text, words in (
        (good.replace(str(model), str(torn)), "[model] path: model"),
        (good.replace(str(model), str(other)), "contract version 99"),
        (good.replace(str(model), str(single)), "with several pictures at once"),
        (good.replace(str(model), str(backwards)), "contract key trained_box_px: takes two numbers above 0"),
        (good.replace(str(model), str(tmp_path / "none.onnx")), "No such file"),
        (good + "[health]\nmood = 3\n", "[health] mood: unknown key"),
        ("[camera", "not valid TOML"),
    ):
        config.write_text(text)
        flight.process.send_signal(signal.SIGHUP)
        said = flight.until("reload refused, flying on as before: ")
        assert str(config) in said
        assert words in said
    with connect(f"tcp/127.0.0.1:{port}") as session, subscribe(session, "uav1") as poses:
        assert next(iter(poses)).target == "t0"
    assert model_hash(port) == before
    config.write_text(good)
    flight.process.send_signal(signal.SIGHUP)
    assert "nothing has changed" in flight.until("reloaded: ")


def test_a_provider_that_a_new_model_falls_back_from_is_warned_of(
    flight: Flight, tmp_path: Path, swaying: Path, port: int
) -> None:
    text = toml(swaying, tmp_path / "flown.onnx", port)
    (tmp_path / "config.toml").write_text(text.replace("threads = 1", 'threads = 1\nprovider = "openvino"'))
    events: queue.Queue[Log] = queue.Queue()
    with connect(f"tcp/127.0.0.1:{port}") as session:
        heard = handlers.Callback(lambda sample: events.put(Log.decode(sample.payload.to_bytes())), indirect=False)
        subscriber = session.declare_subscriber("*/uav1/events/**", heard)
        flight.process.send_signal(signal.SIGHUP)
        sentence = "model: this ONNX Runtime was built without OpenVINO"
        assert " WARNING " in flight.until(sentence)
        while not (event := events.get(timeout=60)).msg.startswith(sentence):
            pass
        subscriber.undeclare()
    assert event.level == logging.WARNING


def test_a_calibration_made_anew_in_the_same_file_is_named(tmp_path: Path, swaying: Path, port: int) -> None:
    calibration, model = tmp_path / "camera.yaml", tmp_path / "flown.onnx"
    write_toy_model(model)
    matrix = "camera_matrix:\n  rows: 3\n  cols: 3\n  data: [{f}, 0, 500, 0, {f}, 400, 0, 0, 1]\n"
    matrix += "distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}\n"
    numbers = "image_width: {w}\nimage_height: {h}\n" + matrix
    height, width = cv2.imread(str(swaying / "rgb" / "000000.png")).shape[:2]
    calibration.write_text(numbers.format(w=width, h=height, f=900))
    text = toml(swaying, model, port).replace(
        "loop = true\n", f'loop = true\nintrinsics = {{ file = "{calibration}" }}\n'
    )
    with flying(tmp_path, text) as flight:
        for focal_px, words in ((910, "needs a restart: [camera] intrinsics"), (900, "nothing has changed")):
            calibration.write_text(numbers.format(w=width, h=height, f=focal_px))
            flight.process.send_signal(signal.SIGHUP)
            assert words in flight.until("reloaded: ")


def test_a_certificate_or_a_key_made_anew_in_the_same_file_is_named(tmp_path: Path, swaying: Path, port: int) -> None:
    model, key = tmp_path / "flown.onnx", tmp_path / "mavlink.key"
    write_toy_model(model)
    write_new_key(key)
    init_authority(tmp_path)
    issue(tmp_path, "uav1")
    tls = '{ root_ca = "ca.pem", certificate = "uav1.pem", private_key = "uav1.key" }'
    text = toml(swaying, model, port, 'signing_key = "mavlink.key"\n')
    with flying(tmp_path, text.replace("[mavlink]\n", f"tls = {tls}\n[mavlink]\n")) as flight:
        redate(tmp_path, "uav1", begins_days=-1, ends_days=90)
        flight.process.send_signal(signal.SIGHUP)
        assert flight.until("reloaded: ").endswith("reloaded: needs a restart: [zenoh] tls\n")
        key.unlink()
        write_new_key(key)
        flight.process.send_signal(signal.SIGHUP)
        assert flight.until("reloaded: ").endswith("reloaded: needs a restart: [zenoh] tls, [mavlink] signing_key\n")


def commanded(port: int, *words: str) -> dict[str, Any]:
    """What `uavpose-ground command` prints; its exit code must agree."""
    command = [sys.executable, "-m", "msgs.ground.cli", "command", "-e", f"tcp/127.0.0.1:{port}", "uav1", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    said = json.loads(done.stdout)
    assert done.returncode == (0 if said["ok"] else 1)
    return dict(said)


def test_the_ground_commands_a_reload_and_is_told_how_it_went(
    flight: Flight, tmp_path: Path, swaying: Path, port: int
) -> None:
    model, config = tmp_path / "flown.onnx", tmp_path / "config.toml"
    good = toml(swaying, model, port)
    write_toy_model(model, name="another")
    config.write_text(toml(swaying, model, port, "[estimator]\nacquire_every_n = 50\n", fps=11))
    said = commanded(port, "reload")
    assert said["ok"], said
    assert said["done"]["model_sha256"] == sha256(model) == model_hash(port)
    assert said["done"]["taken_over"] == ["[estimator] acquire_every_n"]
    assert said["done"]["needs_restart"] == ["[camera] fps"]
    config.write_text(good + "[health]\nmood = 3\n")
    said = commanded(port, "reload")
    assert not said["ok"]
    assert "reload refused, flying on as before: " in said["error"]
    assert "[health] mood: unknown key" in said["error"]
    assert flight.process.poll() is None


def test_a_daemon_that_is_stopped_while_it_loads_a_model_ends_well(tmp_path: Path, swaying: Path, port: int) -> None:
    text = toml(swaying, SHIPPED_MODEL, port)
    for _ in range(3):  # the library may come back at any time while the interpreter is taken down
        with flying(tmp_path, text) as flight:
            (tmp_path / "config.toml").write_text(text.replace("[model]", "[model]\nspinning = true"))
            flight.process.send_signal(signal.SIGHUP)
            flight.until("reload: reading")
            flight.process.terminate()
            assert flight.process.wait(timeout=60) == 0


def test_reload_after_reload_the_daemon_does_not_grow(tmp_path: Path, swaying: Path, port: int) -> None:
    """glibc keeps what the old models held, and the service is ended at 1 GB."""
    text = toml(swaying, SHIPPED_MODEL, port, fps=3)

    def memory_mb(pid: int) -> float:
        kib = re.search(r"^VmRSS:\s+(\d+)", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
        assert kib is not None
        return int(kib[1]) / 1000

    with flying(tmp_path, text) as flight:
        before_mb = memory_mb(flight.process.pid)
        for count in (2, 1) * 3:
            (tmp_path / "config.toml").write_text(text.replace("threads = 1", f"threads = {count}"))
            flight.process.send_signal(signal.SIGHUP)
            assert "replaced by" in flight.until("reloaded: ")
        until(lambda: memory_mb(flight.process.pid) < before_mb + 170, what="memory to be returned", within_s=10)


def test_what_is_taken_over_is_flown_by(tmp_path: Path, gated: Gated, stepped: int) -> None:
    another = write_toy_model(tmp_path / "another.onnx", name="another")
    (tmp_path / "config.toml").write_text(
        f'[camera]\ntype = "sequence"\npath = "/scene"\n[model]\npath = "{another}"\nthreads = 1\n'
        "[zenoh]\nenabled = false\n[mavlink]\nenabled = false\n"
        "[estimator]\nacquire_every_n = 1\n[health]\nno_frame_s = 60\n"
    )
    gated.refused["size"] = 3
    with looping(gated) as (loop, ear, _):
        board = loop._board
        board.file = replace(board.file, path=tmp_path / "config.toml")
        loop._process(frame(0, HELD))
        loop._reloader.ask()
        until(lambda: board.model.contract.name == "another", loop._take_reload)
        (held,) = loop._tracker._targets
        assert held.range_doubted, "what the other model said of its range"
        for index in range(1, 4):  # with 5, as it was, no search would begin
            loop._process(frame(index, HELD))
            until(lambda count=index: loop.search.counters()["searches"] == count, what="a search")
        clock.step_to(stepped + 30_000_000_000)
        loop.supervisor.turn()
        snapshot = loop.supervisor.snapshot()
    assert snapshot.condition.state is not HealthState.FAULT, "no frame for 30 s, but 60 are allowed now"
    assert snapshot.counters["refused_size"] == 3
    assert board.config()["config"]["health"]["no_frame_s"] == 60.0
    (said,) = [(level, text) for level, text in ear.events if text.startswith("reloaded: ")]
    assert said[0] == logging.INFO
    assert "taken over: [estimator] acquire_every_n, [health] no_frame_s" in said[1]


def test_the_old_model_is_let_go_only_after_the_loop_flies_the_new_one(
    tmp_path: Path, gated: Gated, toy_model: Path, swaying: Path, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the loop would free it, which takes time, and its memory would not be returned for ten minutes."""
    another = write_toy_model(tmp_path / "another.onnx", name="another")
    flown, switching_s = list[str](), sys.getswitchinterval()
    with looping(gated) as (loop, _, _):
        take = loop._reloader.take

        def take_and_be_interrupted(*flying: Any) -> Reloaded | None:
            new = take(*flying)
            for _ in range(0 if new is None else 2_000_000):
                pass
            return new

        monkeypatch.setattr(loop._reloader, "take", take_and_be_interrupted)
        monkeypatch.setattr("edge.reload.return_memory", lambda: flown.append(loop._estimator.model.contract.name))
        loop._board.file = replace(loop._board.file, path=tmp_path / "config.toml")
        sys.setswitchinterval(1e-6)
        try:
            for model in (another, toy_model, another):
                (tmp_path / "config.toml").write_text(toml(swaying, model, port))
                loop._reloader.ask()
                before = len(flown)
                until(lambda count=before: len(flown) > count, loop._take_reload)
        finally:
            sys.setswitchinterval(switching_s)
    assert flown == ["another", "toy", "another"]


def config_of(**sections: dict[str, object]) -> Config:
    return Config.model_validate({"camera": {"type": "sequence", "path": "/scene"}, **sections})


@given(st.integers(1, 64), st.integers(1, 99), st.floats(0.5, 50), st.integers(1, 4), st.booleans())
def test_a_change_is_either_taken_over_or_named(
    threads: int, every_n: int, no_frame_s: float, targets: int, mavlink: bool
) -> None:
    old = config_of()
    new = config_of(
        model={"threads": threads},
        estimator={"acquire_every_n": every_n, "max_targets": targets},
        health={"no_frame_s": no_frame_s},
        mavlink={"enabled": mavlink},
    )
    named = needs_restart(old, new)
    flown = with_live_keys(old, new)
    assert ("[estimator] max_targets" in named) == (targets != old.estimator.max_targets)
    assert ("[mavlink] enabled" in named) == (mavlink != old.mavlink.enabled)
    assert flown.model == new.model
    assert flown.estimator.acquire_every_n == every_n
    assert flown.health.no_frame_s == no_frame_s
    assert flown.estimator.max_targets == old.estimator.max_targets
    assert (flown == new) == (not named)
