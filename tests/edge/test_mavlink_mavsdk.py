"""MAVSDK, an implementation that shares nothing with ours, as the ground station of the real link."""

from __future__ import annotations

import json
import math
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.camera import Camera
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from mavsdk.plugins.telemetry import Telemetry
from scipy.spatial.transform import Rotation

from edge.links.mavlink_link import MavlinkLink
from edge.requests import RequestQueue, StopTracking, TrackBox
from msgs.mavlink import DIALECT_XML
from sim_replay.ports import free_port

from .mavlink_peer import SYSTEM_ID, Peer, linked, meet
from .reports import BOX_XYXY_PX, ORIGIN, R_CAM_TARGET, R_NED_CAM, SIZE_WH, T_CAM_TARGET_M, TRACKING, K
from .reports import make_report as report
from .reports import make_track as track

COMPUTER_ID, CAMERA_ID = 191, 100


class Flight:
    """An autopilot beside the link, served while the ground station waits."""

    def __init__(self, link: MavlinkLink, peer: Peer, ground: Mavsdk, requests: RequestQueue) -> None:
        self.link, self.peer, self.ground, self.requests = link, peer, ground, requests

    def until(self, done: Callable[[], bool], what: str) -> None:
        self.peer.settle(done, what, self._turn)

    def _turn(self) -> None:
        """What the daemon's loop does."""
        self.link.set_health(TRACKING)
        self.link.publish(report(track(time.monotonic_ns())))

    def meanwhile(self, act: Callable[[], Any]) -> Any:
        """The result of a call that blocks."""
        results: list[Any] = []
        thread = threading.Thread(target=lambda: results.append(act()), daemon=True)
        thread.start()
        self.until(lambda: not thread.is_alive(), "answer")
        return results[0]


@contextmanager
def flying(**settings: Any) -> Iterator[Flight]:
    port, requests = free_port(socket.SOCK_DGRAM), RequestQueue()
    ground = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    assert ground.add_any_connection(f"udpin://127.0.0.1:{port}") == 0
    endpoints = ("udpin:127.0.0.1:0", f"udpout:127.0.0.1:{port}")
    with linked(*endpoints, requests=requests, **settings) as (link, _), Peer(link.ports[0]) as peer:
        meet(link, peer)
        flight = Flight(link, peer, ground, requests)
        flight.until(lambda: bool(ground.get_systems()), "system seen by MAVSDK")
        yield flight
    ground.destroy()


@pytest.fixture(scope="module")
def flight() -> Iterator[Flight]:
    with flying(sensor_width_mm=6.4) as flight:
        yield flight


def heard(flight: Flight, name: str, components: set[int]) -> dict[int, dict[str, Any]]:
    """A message of a name from each component of our system, by MAVSDK's own parser."""
    direct = MavlinkDirect(flight.ground.get_systems()[0])
    direct.load_custom_xml(DIALECT_XML.read_text())
    messages: dict[int, dict[str, Any]] = {}

    def keep(message: Any, _: Any) -> None:
        if message.system_id == SYSTEM_ID:
            messages[message.component_id] = json.loads(message.fields_json)

    direct.subscribe_message(name, keep)
    flight.until(lambda: components <= messages.keys(), name)
    return messages


def test_heartbeats_are_those_of_an_onboard_computer_and_a_camera(flight: Flight) -> None:
    beats = heard(flight, "HEARTBEAT", {COMPUTER_ID, CAMERA_ID})
    assert {component: (beat["type"], beat["autopilot"]) for component, beat in beats.items()} == {
        COMPUTER_ID: (18, 8),
        CAMERA_ID: (30, 8),
    }


def test_the_camera_is_found_with_its_lens_and_takes_tracking_commands(flight: Flight) -> None:
    camera = Camera(flight.ground.get_systems()[0])
    flight.until(lambda: bool(camera.camera_list().cameras), "camera")
    (information,) = camera.camera_list().cameras
    assert (information.component_id, information.vendor_name) == (CAMERA_ID, "MF-UAVPose6D")
    assert (information.horizontal_resolution_px, information.vertical_resolution_px) == SIZE_WH
    field_rad = 2 * math.atan2(0.5 * information.horizontal_sensor_size_mm, information.focal_length_mm)
    assert field_rad == pytest.approx(2 * math.atan2(0.5 * SIZE_WH[0], K[0, 0]), abs=1e-6)
    flight.meanwhile(lambda: camera.track_rectangle(CAMERA_ID, 0.1, 0.2, 0.3, 0.4))
    flight.meanwhile(lambda: camera.track_stop(CAMERA_ID))
    rectangle, stop = flight.requests.take()
    assert isinstance(rectangle, TrackBox)
    np.testing.assert_allclose(rectangle.box_xyxy_share, [0.1, 0.2, 0.3, 0.4], atol=1e-6)
    assert stop == StopTracking()


def test_the_tracking_status_says_where_the_box_is(flight: Flight) -> None:
    status = heard(flight, "CAMERA_TRACKING_IMAGE_STATUS", {CAMERA_ID})[CAMERA_ID]
    assert status["tracking_status"] == 1
    corners = [status[f"rec_{corner}_{axis}"] for corner in ("top", "bottom") for axis in "xy"]
    np.testing.assert_allclose(corners, (BOX_XYXY_PX + 0.5) / np.tile(SIZE_WH, 2), rtol=1e-5)
    place = heard(flight, "CAMERA_TRACKING_GEO_STATUS", {CAMERA_ID})[CAMERA_ID]
    assert abs(place["lat"] * 1e-7 - ORIGIN[0]) < 0.01
    assert place["dist"] == pytest.approx(np.linalg.norm(T_CAM_TARGET_M), rel=1e-6)


def test_target_relative_is_the_whole_pose(flight: Flight) -> None:
    pose = heard(flight, "TARGET_RELATIVE", {COMPUTER_ID})[COMPUTER_ID]
    assert (pose["id"], pose["frame"]) == (0, 3)
    np.testing.assert_allclose([pose["x"], pose["y"], pose["z"]], T_CAM_TARGET_M, rtol=1e-6)
    R_cam_target = Rotation.from_quat(np.roll(pose["q_target"], -1)).as_matrix()
    np.testing.assert_allclose(R_cam_target, R_CAM_TARGET, atol=1e-6)
    R_ned_cam = Rotation.from_quat(np.roll(pose["q_sensor"], -1)).as_matrix()
    np.testing.assert_allclose(R_ned_cam, R_NED_CAM, atol=1e-6)
    assert abs(pose["timestamp"] - time.time_ns() // 1000) < 60_000_000


def test_an_event_arrives_whole_also_where_its_last_chunk_is_full(flight: Flight) -> None:
    told: list[str] = []
    telemetry = Telemetry(flight.ground.get_systems()[0])
    telemetry.subscribe_status_text(lambda status, _: told.append(status.text))
    text = "target 0 lost: held for 12.3 s, last seen at 240 m".ljust(99, ".") + "!"
    flight.link.event(4, text)
    flight.until(lambda: bool(told), "event")
    assert told == [text]
