"""What the commands say of a model that flies less well than it should: on another provider, without calibrated
scores."""

from __future__ import annotations

import json
import logging
import os
import queue
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import onnxruntime as ort
import pytest
from zenoh import handlers

from edge.config import load_config
from edge.doctor import _model
from edge.estimator.model import NOT_CALIBRATED, load_model
from edge.status import ask
from edge.types import PROBABLE_SCORE
from msgs.cdr import Log
from msgs.client import connect, subscribe
from sim_replay.ports import free_port

from .conftest import Cli
from .flying import flying, toml
from .toy_model import write_toy_model

# `uavpose-edge` with an ONNX Runtime that has a GPU, which the CPU stands in for until the file BROKEN is there. Then
# it fails, or gives no numbers if the file says so.
WITH_A_GPU = """
import os, sys
import numpy
import onnxruntime
import onnxruntime.capi.onnxruntime_inference_collection as collection
from edge.cli import main

GPU, names, native = "CUDAExecutionProvider", ["CUDAExecutionProvider", "CPUExecutionProvider"], collection.C
broken = lambda: os.path.exists(os.environ["BROKEN"])
real = native.InferenceSession

class Session:
    def __init__(self, *arguments):
        self._session, self._on_gpu = real(*arguments), False

    def initialize_session(self, providers, options, disabled):
        self._on_gpu = GPU in providers
        if self._on_gpu and broken():
            raise RuntimeError("CUDA failure 100: no CUDA-capable device is detected")
        self._session.initialize_session(["CPUExecutionProvider"], [{}], disabled)

    def get_providers(self):
        return names if self._on_gpu else names[1:]

    def get_provider_options(self):
        return {name: {} for name in self.get_providers()}

    def run(self, *arguments):
        outputs = self._session.run(*arguments)
        if not self._on_gpu or not broken():
            return outputs
        if open(os.environ["BROKEN"]).read() == "no numbers":
            return [numpy.full_like(output, numpy.nan) for output in outputs]
        raise native.EPFail("CUDA failure 719: unspecified launch failure")

    def __getattr__(self, name):
        return getattr(self._session, name)

native.InferenceSession = Session
native.get_available_providers = onnxruntime.get_available_providers = lambda: names
sys.exit(main())
"""


@pytest.fixture
def calibrated(tmp_path: Path) -> Path:
    return write_toy_model(tmp_path / "calibrated.onnx", track_score={"offset": 0.1})


def on_the_gpu(text: str) -> str:
    return text.replace("threads = 1", 'threads = 1\nprovider = "cuda"')


@pytest.mark.parametrize(
    ("how", "why"),
    [("", "CUDA failure 719: unspecified launch failure"), ("no numbers", "its scores are not finite")],
)
def test_a_gpu_that_fails_in_flight_is_told_of_and_the_cpu_goes_on(
    tmp_path: Path, swaying: Path, calibrated: Path, how: str, why: str
) -> None:
    port, events, broken = free_port(), queue.Queue[Log](), tmp_path / "broken"
    text, surroundings = on_the_gpu(toml(swaying, calibrated, port)), {"BROKEN": str(broken)}
    with flying(tmp_path, text, surroundings, program=("-c", WITH_A_GPU)) as flight:
        assert any("on cuda, camera" in line for line in flight.lines)
        endpoint = f"tcp/127.0.0.1:{port}"
        with connect(endpoint) as session, subscribe(session, "uav1") as poses:
            heard = handlers.Callback(lambda sample: events.put(Log.decode(sample.payload.to_bytes())), indirect=False)
            subscriber = session.declare_subscriber("*/uav1/events/**", heard)
            (tmp_path / "how").write_text(how)
            (tmp_path / "how").rename(broken)
            reason = f"CUDAExecutionProvider failed: {why}; running on the CPU"
            assert " WARNING " in flight.until(f"model: {reason}")
            while not (event := events.get(timeout=60)).msg.startswith(f"model: {reason}"):
                pass
            assert event.level == logging.WARNING
            for _ in range(3):
                assert next(iter(poses)).target == "t0"
            subscriber.undeclare()
            assert not [later for later in events.queue if later.msg.startswith("model: ")]
        told = ask(endpoint, "uav1")
        assert told is not None
        assert (told["info"]["model_provider"], told["model"]["fallback_reason"]) == ("cpu", reason)


def test_a_gpu_with_room_for_one_of_two_sessions_is_not_used_for_that_one(
    calibrated: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gpu, cpu = "CUDAExecutionProvider", "CPUExecutionProvider"
    lost, on_gpu = threading.Event(), list["Session"]()

    class Session(ort.InferenceSession):
        def __init__(self, content: bytes, options: Any, providers: list[str], enable_fallback: int) -> None:
            if providers[0] == gpu and on_gpu:
                raise RuntimeError("CUDA failure 2: out of memory")
            super().__init__(content, options, providers=[cpu])
            self.wanted = providers
            on_gpu.extend([self] if providers[0] == gpu else [])

        def get_providers(self) -> list[str]:
            return self.wanted

        def run(self, *arguments: Any) -> Any:
            if self.wanted[0] == gpu and lost.is_set():
                raise RuntimeError("CUDA failure 719: unspecified launch failure")
            return super().run(*arguments)

    monkeypatch.setattr(ort, "InferenceSession", Session)
    monkeypatch.setattr(ort, "get_available_providers", lambda: [gpu, cpu])
    model = load_model(calibrated, 1, provider="cuda")
    assert model.provider == "cpu"
    assert str(model.fallback_reason).startswith("CUDAExecutionProvider did not start: CUDA failure 2: out of memory")
    lost.set()
    model.warm_up()


@pytest.mark.parametrize("command", ["doctor", "check"])
def test_a_gpu_that_does_not_start_leaves_standard_output_to_the_command(
    tmp_path: Path, swaying: Path, calibrated: Path, command: str
) -> None:
    (tmp_path / "config.toml").write_text(on_the_gpu(toml(swaying, calibrated, free_port())))
    arguments = [sys.executable, "-c", WITH_A_GPU, command, "--config", str(tmp_path / "config.toml")]
    surroundings = {**os.environ, "BROKEN": "/dev/null"}
    reason = (
        "CUDAExecutionProvider did not start: CUDA failure 100: no CUDA-capable device is detected; running on the CPU"
    )
    if command == "check":
        done = subprocess.run(arguments, capture_output=True, text=True, env=surroundings, check=True)
        assert done.stdout.splitlines()[0].endswith("config.toml: valid")
        assert f"runs on  cpu: {reason}" in done.stdout
        return
    done = subprocess.run([*arguments, "--json"], capture_output=True, text=True, env=surroundings, check=False)
    found: dict[str, Any] = {one["what"]: one for one in json.loads(done.stdout)["findings"]}
    assert (found["provider"]["verdict"], found["provider"]["says"]) == ("wrong", reason)


def test_scores_that_are_not_calibrated_are_told_of_by_every_command(
    cli: Cli, tmp_path: Path, swaying: Path, toy_model: Path, calibrated: Path
) -> None:
    assert [load_model(path, 1).doubtful_below for path in (calibrated, toy_model)] == [PROBABLE_SCORE, 0.0]
    config = tmp_path / "config.toml"
    config.write_text(toml(swaying, calibrated, free_port()))
    assert NOT_CALIBRATED not in cli("check", "--config", config).stdout
    assert "scores" not in {finding.what for finding in _model(load_config(config), None)}
    config.write_text(toml(swaying, toy_model, free_port()))
    assert f"warning  {NOT_CALIBRATED}\n" in cli("check", "--config", config).stdout
    (scores,) = (finding for finding in _model(load_config(config), None) if finding.what == "scores")
    assert (scores.verdict, scores.says) == ("poor", NOT_CALIBRATED)
    assert "`uavpose-trainer calibrate-score`" in scores.advice
    with flying(tmp_path, config.read_text()) as flight:
        assert sum(" WARNING " in line and f"model: {NOT_CALIBRATED}" in line for line in flight.lines) == 1
