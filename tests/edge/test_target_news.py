"""A confirmed target that is lost is told with its number and how long it was held."""

from __future__ import annotations

import json
import logging
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.target_news import TargetNews
from edge.types import TrackState
from msgs import topics
from msgs.cdr import Log
from msgs.client import connect
from sim_replay.ports import free_port

from .flying import flying, toml
from .reports import make_report as report
from .reports import make_track as track
from .reports import rangeless
from .toy_scene import K, draw

FRAME_NS = 33_000_000
SEEN, COASTING = TrackState.CONFIRMED, TrackState.COASTING


def test_coming_and_going_are_told_once_and_held_counts_to_the_last_measurement() -> None:
    news, told = TargetNews(), []
    states = [TrackState.TENTATIVE] * 3 + [SEEN] * 31 + [COASTING] * 60 + [None] * 5
    for frame, state in enumerate(states):
        now_ns = frame * FRAME_NS
        measured_ns = min(frame, 33) * FRAME_NS
        t_m = np.array([0.0, 0.0, 100.0 + frame])
        one = [] if state is None else [track(now_ns, state=state, measured_ns=measured_ns, t_cam_target_m=t_m)]
        told += [(frame, *words) for words in news.words(report(*one))]
    assert told == [
        (3, logging.INFO, "target 0 acquired at 103 m"),
        (94, logging.WARNING, "target 0 lost: held for 1.0 s, last seen at 133 m"),
    ]


def test_a_number_that_is_used_again_is_another_target() -> None:
    news = TargetNews()
    assert [text for _, text in news.words(report(track(0, track_id=2)))] == ["target 2 acquired at 240 m"]
    (lost,) = news.words(report(track(FRAME_NS, track_id=2, state=TrackState.TENTATIVE)))
    assert lost[1].startswith("target 2 lost")
    assert [text for _, text in news.words(report(track(2 * FRAME_NS, track_id=2)))] == ["target 2 acquired at 240 m"]


@pytest.mark.parametrize(
    ("scores", "calibrated", "chosen", "told"),
    [
        ((0.6, 0.6, 0.7), True, False, []),
        ((0.6, 0.9, 0.6, 0.6, 0.6), True, False, ["target 0 acquired at 240 m", "target 0 lost: held for 0.1 s"]),
        ((0.6, 0.6, 0.7), True, True, ["target 0 acquired at 240 m", "target 0 lost: held for 0.1 s"]),
        ((0.6, 0.6, 0.7), False, False, ["target 0 acquired at 240 m", "target 0 lost: held for 0.1 s"]),
    ],
)
def test_what_is_no_aircraft_is_neither_acquired_nor_lost(
    scores: tuple[float, ...], calibrated: bool, chosen: bool, told: list[str]
) -> None:
    news = TargetNews()
    seen = [report(track(frame * FRAME_NS, score=score)) for frame, score in enumerate(scores)]
    judged = {"doubtful_below": 0.8 if calibrated else 0.0, "chosen_id": 0 if chosen else None}
    reports = [replace(one, **judged) for one in [*seen, report()]]
    assert [text.split(",")[0] for one in reports for _, text in news.words(one)] == told


def test_no_range_is_told_that_is_too_uncertain_to_be_sent() -> None:
    """1-sigma of 0.8 and then of 0.3 times the range: poses are withheld above 0.5."""
    news, told = TargetNews(), []
    for frame, share in enumerate((0.8, 0.8, 0.3)):
        covariance = np.diag([0.09, 0.09, (share * 240.0) ** 2, 0.01, 0.01, 0.01])
        seen = track(frame * FRAME_NS, t_cam_target_m=np.array([0.0, 0.0, 240.0]), covariance=covariance)
        told.append([text for _, text in news.words(report(seen))])
    assert told == [["target 0 acquired, range unknown"], [], []]
    assert news.words(report())[0][1].endswith("last seen at 240 m")
    news.words(report(rangeless(track(0))))
    assert news.words(report()) == [(logging.WARNING, "target 0 lost: held for 0.0 s, range unknown")]


def test_several_at_once_are_told_in_the_order_of_their_numbers() -> None:
    news, both = TargetNews(), [track(0, track_id=number) for number in (8, 1)]
    told = [text.partition(" at ")[0] for one in (report(*both), report()) for _, text in news.words(one)]
    assert told[:2] == ["target 1 acquired", "target 8 acquired"]
    assert [text.split(":")[0] for text in told[2:]] == ["target 1 lost", "target 8 lost"]


def test_the_ground_hears_that_a_target_is_lost(tmp_path: Path, toy_model: Path) -> None:
    scene = tmp_path / "000001"
    (scene / "rgb").mkdir(parents=True)
    seen, empty = draw((500.5, 420.5)), np.full_like(draw((500.5, 420.5)), draw((500.5, 420.5))[0, 0])
    for index in range(40):
        cv2.imwrite(str(scene / "rgb" / f"{index:06d}.png"), seen if index < 10 else empty)
    cameras = {str(index): {"cam_K": K.ravel().tolist(), "depth_scale": 1.0} for index in range(40)}
    (scene / "scene_camera.json").write_text(json.dumps(cameras))
    port = free_port()
    with flying(tmp_path, toml(scene, toy_model, port)) as flight, connect(f"tcp/127.0.0.1:{port}") as session:
        with session.declare_subscriber(topics.subscription_key(topics.EVENTS, "uav1")) as events:
            for sample in events:
                event = Log.decode(sample.payload.to_bytes())
                if re.fullmatch(r"target 0 lost: held for \d+\.\d s, last seen at \d+ m", event.msg):
                    break
        assert event.level == logging.WARNING
        assert flight.process.poll() is None
