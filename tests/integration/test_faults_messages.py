"""The judge of faults on messages beside the poses: it sees what is stale, untrue or of a frozen picture."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from msgs import topics
from msgs.cdr import Detection3DArray, TFMessage, TransformStamped, Vector3Stamped
from msgs.receive import TargetDirection
from msgs.topics import Topic
from sim_replay.faults.judge import faults_since, message_faults
from sim_replay.faults.messages import AUTOPILOT, OWN_LAT_LON_ALT, ReceivedMessage, from_mavlink, from_zenoh
from sim_replay.faults.witness import ExposedFrame, Witness
from sim_replay.subscriber import direction_record, sample_record

MS = 1_000_000
T0 = 1_700_000_000_000_000_000
# Ten frames a second; from the twentieth on the same picture again.
FRAMES = [ExposedFrame(T0 + k * 100 * MS, T0 + k * 100 * MS, frozen=k >= 20) for k in range(60)]
LAT, LON, ALT_M = OWN_LAT_LON_ALT


def utc_ns(monotonic_ns: int) -> int:
    return T0 + monotonic_ns


def told(name: str, t_ns: int, **fields: Any) -> ReceivedMessage:
    message = from_mavlink({"message": name, "t_ns": t_ns, **fields}, utc_ns)
    assert message is not None
    return message


def geo(t_ns: int, north_deg: float = 0.002, dist: float = 222.4) -> ReceivedMessage:
    place = {"lat": round((LAT + north_deg) * 1e7), "lon": round(LON * 1e7), "alt": ALT_M}
    return told("CAMERA_TRACKING_GEO_STATUS", t_ns, dist=dist, **place)


def box(t_ns: int, right: float | None = 0.6) -> ReceivedMessage:
    sides = {"rec_top_x": 0.5, "rec_top_y": 0.4, "rec_bottom_x": right, "rec_bottom_y": 0.5}
    return told("CAMERA_TRACKING_IMAGE_STATUS", t_ns, tracking_status=1, **sides)


def sample(topic: Topic, payload: bytes, frame: int, age_ms: int) -> ReceivedMessage:
    return from_zenoh(sample_record(topic, payload, FRAMES[frame].stamp_ns + age_ms * MS))


def tf(frame: int, age_ms: int, q_body_xyzw: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)) -> ReceivedMessage:
    own = TransformStamped(FRAMES[frame].stamp_ns, topics.FRAME_BODY_NED, topics.FRAME_BODY, (0, 0, 0), q_body_xyzw)
    return sample(topics.TF, TFMessage((own,)).encode(), frame, age_ms)


def direction(frame: int, age_ms: float, ray_cam: tuple[float, ...] = (0.6, 0.0, 0.8)) -> ReceivedMessage:
    told = Vector3Stamped(FRAMES[frame].stamp_ns, topics.FRAME_CAMERA, np.array(ray_cam))
    return sample(topics.DIRECTION, told.encode(), frame, age_ms)


def test_what_is_fresh_and_true_is_no_fault() -> None:
    empty = Detection3DArray(FRAMES[3].stamp_ns, topics.FRAME_CAMERA, ()).encode()
    follow = told(
        "FOLLOW_TARGET", 350 * MS, timestamp=300, lat=round((LAT + 0.002) * 1e7), lon=round(LON * 1e7), alt=ALT_M
    )
    fresh = [geo(350 * MS), box(350 * MS), follow, tf(3, 50), sample(topics.DETECTIONS, empty, 3, 50)]
    fresh.append(direction(3, 50))
    assert message_faults(fresh, FRAMES) == []


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (tf(3, 2_000), "2000 ms after"),
        (tf(25, 20), "frozen"),
        (tf(3, 20, (0.5, 0.5, 0.5, 0.5)), "nobody flew"),
        (direction(3, 2_000), "2000 ms after"),
        (direction(3, 20, (0.6, 0.0, -0.8)), "behind the camera"),
        (sample(topics.DETECTIONS, b"\0\1\0\0", 3, 20), "ends before its last field"),
        (geo(4_000 * MS), "no frame had been exposed"),  # nothing but the frozen picture for two seconds
        (box(4_000 * MS), "no frame had been exposed"),
        (geo(350 * MS, dist=400.0), "222 m away, not 400 m"),
        (geo(350 * MS, north_deg=-0.002), "behind the camera"),
        (box(350 * MS, right=1.2), "outside the picture"),
        (box(350 * MS, right=None), "outside the picture"),
    ],
)
def test_what_is_stale_or_untrue_is_found(message: ReceivedMessage, words: str) -> None:
    (fault,) = message_faults([geo(350 * MS), message], FRAMES)
    assert words in fault


def test_a_direction_is_told_twice_and_no_complaint() -> None:
    seen = TargetDirection("uav1", "t0", FRAMES[3].stamp_ns, np.array([0.6, 0.0, 0.8]), FRAMES[4].stamp_ns)
    witness = Witness()
    witness.hear("subscriber", json.dumps(direction_record(seen)))
    assert (witness.complaints, witness.poses, witness.messages) == ([], [], [])


def test_a_camera_that_says_it_tracks_nothing_tells_of_no_target() -> None:
    idle = {"message": "CAMERA_TRACKING_IMAGE_STATUS", "t_ns": 0, "tracking_status": 0}
    assert from_mavlink(idle, utc_ns) is None


def test_only_what_a_cut_link_to_the_ground_held_back_may_come_late() -> None:
    witness = Witness(frames=FRAMES, messages=[tf(3, 4_000)])
    assert len(faults_since(witness)) == 1
    witness.zenoh_cut(True, FRAMES[2].exposed_ns)
    witness.zenoh_cut(False, FRAMES[9].exposed_ns)
    assert faults_since(witness) == []
    stale = ReceivedMessage(AUTOPILOT, "FOLLOW_TARGET", FRAMES[3].exposed_ns + 4_000 * MS, FRAMES[3].stamp_ns, None)
    witness.messages.append(stale)
    witness.messages.append(tf(25, 4_000))
    assert len(faults_since(witness)) == 2


def test_what_a_cut_link_held_back_may_be_late_and_no_more() -> None:
    never_exposed = replace(tf(3, 4_000), capture_ns=FRAMES[3].stamp_ns + 50 * MS)
    witness = Witness(frames=FRAMES, messages=[tf(24, 4_000), tf(3, 4_000, (0.5, 0.5, 0.5, 0.5)), never_exposed])
    witness.zenoh_cut(True, FRAMES[2].exposed_ns)
    witness.zenoh_cut(False, FRAMES[30].exposed_ns)
    faults = faults_since(witness)
    assert len(faults) == 3
    for fault, words in zip(faults, ("frozen", "nobody flew", "never exposed"), strict=True):
        assert words in fault
