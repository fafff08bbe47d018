"""Requests for a reload: one at a time, each carried out once and answered, also if it fails."""

from __future__ import annotations

import logging
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np

from edge.config import ConfigFile, load_config
from edge.estimator.estimator import Estimator
from edge.estimator.model import load_model
from edge.reload import Reloaded, Reloader
from edge.requests import ReloadOutcome
from edge.types import CameraInfo
from sim_replay.ports import free_port
from tests.waiting import until

from .flying import toml
from .test_reload import config_of
from .toy_model import write_toy_model


def test_one_reload_at_a_time() -> None:
    reloader, told = Reloader(), list[ReloadOutcome]()
    assert reloader.ask_for(told.append)
    assert not reloader.ask_for(told.append)
    assert told == []


def at_work() -> int:
    return sum(thread.name == "reload" for thread in threading.enumerate())


def test_a_request_that_comes_during_a_reload_is_obeyed_after_it_and_each_once(
    tmp_path: Path, toy_model: Path, swaying: Path
) -> None:
    (tmp_path / "config.toml").write_text(toml(swaying, toy_model, free_port()))
    flown = load_config(tmp_path / "config.toml")
    estimator, camera = Estimator(load_model(toy_model, 1), 1), CameraInfo("", (640, 480), np.eye(3), None)
    reloader, done = Reloader(), list[Reloaded]()

    def turn() -> None:
        if (made := reloader.take(flown, estimator, camera, lambda *_: None)) is not None:
            done.append(made)
            reloader.switched()
        assert at_work() <= 1

    for _ in range(2):  # the first is at work until the loop has taken what it made
        reloader.ask()
        turn()
    until(lambda: len(done) == 2 and at_work() == 0, turn)
    turn()
    assert (len(done), at_work()) == (2, 0)


def test_a_reload_that_fails_as_nobody_foresaw_is_told_of_and_the_next_is_carried_out(
    tmp_path: Path, toy_model: Path, swaying: Path
) -> None:
    another = write_toy_model(tmp_path / "another.onnx", name="another")
    (tmp_path / "config.toml").write_text(toml(swaying, another, free_port()))
    flown = load_config(tmp_path / "config.toml")
    estimator, camera = Estimator(load_model(toy_model, 1), 1), CameraInfo("", (640, 480), np.eye(3), None)
    reloader, told, events = Reloader(), list[ReloadOutcome](), list[tuple[int, str]]()

    def turn(camera: CameraInfo) -> None:
        if reloader.take(flown, estimator, camera, lambda *said: events.append(said)) is not None:
            reloader.switched()

    no_memory_holds_it = replace(camera, image_size_wh=(10**9, 10**9))
    assert reloader.ask_for(told.append)
    until(lambda: told, lambda: turn(no_memory_holds_it))
    assert reloader.ask_for(told.append)
    until(lambda: len(told) == 2, lambda: turn(camera))
    refused, made = told
    assert (refused.flies, made.flies) == (False, True)
    assert refused.said.startswith("reload refused, flying on as before: ")
    assert refused.model_sha256 == estimator.model.sha256 != made.model_sha256
    assert events == [(logging.ERROR, refused.said)]


def test_who_is_told_how_a_reload_went_may_ask_for_the_next_at_once(tmp_path: Path, toy_model: Path) -> None:
    estimator, camera = Estimator(load_model(toy_model, 1), 1), CameraInfo("", (640, 480), np.eye(3), None)
    gone = ConfigFile(tmp_path / "gone.toml", "", config_of())
    reloader, taken, told = Reloader(), list[bool](), list[ReloadOutcome]()

    def ask_again(outcome: ReloadOutcome) -> None:
        told.append(outcome)
        taken.append(reloader.ask_for(told.append))

    assert reloader.ask_for(ask_again)
    until(lambda: len(told) == 2 or taken == [False], lambda: reloader.take(gone, estimator, camera, lambda *_: None))
    assert taken == [True]
    assert [outcome.flies for outcome in told] == [False, False]
