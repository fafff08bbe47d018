"""What keeps its place in the picture of a turning camera is no aircraft; what moves through it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edge.estimator.model import load_model
from edge.fixed_places import FixedPlaces
from edge.requests import TrackBox
from edge.tracking.view import View
from edge.types import Array, Estimate, Frame, FrameMeta

from .looping import PERIOD_NS, Gated, box_around, frame, looping
from .toy_scene import SIZE_WH, K

ALONG_NOSE = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
SIDES = np.array([118.0, 60.0])
PICTURE = np.zeros((1080, 1920, 3), np.uint8)


def estimate(center_px: Array, sides_px: Array = SIDES) -> Estimate:
    box = np.concatenate([center_px - sides_px / 2, center_px + sides_px / 2])
    return Estimate(0.95, box, np.eye(3), np.array([0.0, 0.0, 300.0]), np.eye(6), "track")


def view(index: int, attitude: Rotation | None, axes_epoch: int = 0) -> View:
    if attitude is None:
        return View.of(index * PERIOD_NS, None, None)  # type: ignore[arg-type]
    return View("ned", index * PERIOD_NS, attitude.as_matrix() @ ALONG_NOSE, np.zeros(3), None, axes_epoch=axes_epoch)


def yawed(degrees: float) -> Rotation:
    return Rotation.from_euler("z", degrees, degrees=True)


class Flight:
    """Feeds a FixedPlaces frame by frame."""

    def __init__(self) -> None:
        self.places, self.index = FixedPlaces(), 0

    def see(self, attitude: Rotation | None, *estimates: Estimate, axes_epoch: int = 0) -> list[Estimate]:
        self.index += 1
        meta = FrameMeta(self.index, self.index * PERIOD_NS, self.index * PERIOD_NS)
        return self.places.without(Frame(meta, PICTURE, K), estimates, view(self.index, attitude, axes_epoch))

    def told(self, after_s: float = 0.0) -> list[str]:
        return [reason.text for reason in self.places.reasons(self.index * PERIOD_NS + round(after_s * 1e9))]


def scattered(random: np.random.Generator, center_px: tuple[float, float]) -> Estimate:
    """As the network sees a fixed thing before a changing background."""
    return estimate(np.array(center_px) + random.normal(0, 1.7, 2), SIDES + random.normal(0, 2.0, 2))


def seen_of(target_ned: Array, attitude: Rotation) -> Estimate:
    x, y, z = ALONG_NOSE.T @ attitude.inv().apply(target_ned)
    return estimate(K[:2, :2] @ [x / z, y / z] + K[:2, 2])


def test_what_keeps_its_place_while_the_camera_turns_is_ignored_and_told_of() -> None:
    flight, random = Flight(), np.random.default_rng(0)
    passed = [len(flight.see(yawed(0.5 * i), scattered(random, (500, 350)))) for i in range(100)]
    turned = passed.index(0)
    assert passed == [1] * turned + [0] * (100 - turned)
    assert 28 <= turned <= 36, "until the camera has turned by 15 degrees"
    assert flight.told() == [
        "what is seen at (500, 350) px keeps its place in the picture while the camera turns, and is ignored"
    ]
    assert flight.places.refused == 100 - turned
    assert flight.see(None, scattered(random, (500, 350))) == [], "known by its place, even without own attitude"
    assert flight.told(59.0) != []
    assert flight.told(61.0) == [], "wiped off"


def test_other_aircraft_pass_meanwhile() -> None:
    flight, random = Flight(), np.random.default_rng(1)
    for i in range(100):
        past = estimate(np.array([1800.0 - 26.0 * i, 350.0]), np.array([30.0, 12.0]))
        there = seen_of(300.0 * np.array([1.0, 0.4, 0.1]), yawed(0.5 * i))
        passed = flight.see(yawed(0.5 * i), scattered(random, (500, 350)), past, there)
        assert any(one is past for one in passed), "before the fixed thing, too"
        assert any(one is there for one in passed)
        assert i > 28 or len(passed) == 3
        assert i < 36 or len(passed) == 2


@given(st.floats(-0.4, 0.4), st.floats(-0.2, 0.2), st.tuples(*[st.floats(-1.0, 1.0)] * 3), st.integers(1, 40))
def test_an_aircraft_in_place_is_never_ignored(
    east: float, down: float, axis: tuple[float, float, float], frames_per_degree: int
) -> None:
    """At constant bearing in ned, however the camera turns."""
    flight, target_ned = Flight(), 300.0 * np.array([1.0, east, down])
    turn = np.array(axis) / max(float(np.linalg.norm(axis)), 1e-3)
    for i in range(100):
        attitude = Rotation.from_rotvec(turn * np.deg2rad(i / frames_per_degree))
        if (ALONG_NOSE.T @ attitude.inv().apply(target_ned))[2] < 10.0:
            break
        one = seen_of(target_ned, attitude)
        assert flight.see(attitude, one) == [one]
    assert flight.told() == []


def test_a_steady_camera_an_unknown_or_a_new_attitude_tell_nothing() -> None:
    for attitudes in (
        [yawed(0.1 * i) for i in range(150)],
        [None] * 150,
        [Rotation.from_euler("x", 2.0 * i, degrees=True) for i in range(150)],  # about the line of sight
        [yawed(0.01 * i) for i in range(4000)],  # a compass that drifts by 18 degrees a minute
    ):
        flight = Flight()
        for attitude in attitudes:
            one = estimate(np.array([959.5, 539.5]))
            assert flight.see(attitude, one) == [one]
    flight = Flight()
    for i in range(100):  # the autopilot corrects its heading
        one = estimate(np.array([500.0, 350.0]))
        assert flight.see(yawed(90.0 * (i >= 50)), one, axes_epoch=int(i >= 50)) == [one]


@pytest.mark.parametrize("gimbal", [False, True])
def test_the_daemon_sends_none_of_it_and_says_why_unless_a_gimbal_follows_it(toy_model: Path, gimbal: bool) -> None:
    mount = "gimbal" if gimbal else "fixed"
    with looping(Gated(load_model(toy_model, 1)), camera_mount=mount) as (loop, ear, requests):
        for index in range(240):
            now = frame(index, (500.5, 350.5))
            if index % 3 == 0:
                turned = np.roll(yawed(0.5 * index).as_quat(), 1)
                loop._own_ship.add_attitude(now.meta.capture_ns + PERIOD_NS * 3, turned, np.zeros(3))
            loop._process(now)
        told = [reason.kind for reason in loop._reasons(now.meta.capture_ns)]
        left, top, right, bottom = (float(one) for one in box_around((500.5, 350.5)) / np.tile(SIZE_WH, 2))
        requests.put(TrackBox((left, top, right, bottom)))
        for index in range(240, 280):
            loop._process(frame(index, (500.5, 350.5)))
    assert any(report.tracks for report in ear.reports), "as long as the camera has not turned"
    assert bool(ear.reports[-1].tracks) is gimbal
    assert told == ([] if gimbal else ["camera_fixed_places"])
    assert ("no target found where pointed" in [text for _, text in ear.events]) is not gimbal
    assert (loop._counters()["refused_fixed_in_picture"] > 0) is not gimbal
