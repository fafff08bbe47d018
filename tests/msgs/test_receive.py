"""What a pose receiver takes and what it refuses, with its reasons counted."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msgs import cdr, topics
from msgs.receive import PoseReceiver
from msgs.topics import POSE
from msgs.wire import Refusal

from .conftest import pose_now

NOW_NS, S = 1_700_000_000_000_000_000, 1_000_000_000
GID, OTHER_GID = bytes(range(16)), bytes(range(1, 17))
KEY = topics.publication_key(POSE, "uav1", "t0")
DIRECTION_KEY = topics.publication_key(topics.DIRECTION, "uav1", "t0")


def sample(sequence: int, stamp_ns: int, gid: bytes = GID) -> tuple[bytes, bytes]:
    payload = dataclasses.replace(pose_now(), stamp_ns=stamp_ns).encode()
    return payload, topics.attachment(sequence, NOW_NS, gid)


@pytest.mark.parametrize(
    ("sequence", "stamp_ns", "reason"),
    [
        (2, NOW_NS, Refusal.SEQUENCE),
        (1, NOW_NS, Refusal.SEQUENCE),
        (3, NOW_NS - 1_000_000_001, Refusal.STALE),
        (3, NOW_NS - 100_000_000, Refusal.STALE),
        (3, NOW_NS - 100_000_001, Refusal.STALE),
        (3, NOW_NS + 500_000_001, Refusal.FUTURE),
    ],
)
def test_repeated_late_and_future_poses_are_refused(sequence: int, stamp_ns: int, reason: Refusal) -> None:
    receiver = PoseReceiver("uav1")
    assert receiver.receive(KEY, *sample(2, NOW_NS - 100_000_000), NOW_NS)
    assert receiver.receive(KEY, *sample(sequence, stamp_ns), NOW_NS) is None
    assert (receiver.accepted, dict(receiver.refused)) == (1, {reason: 1})
    assert receiver.receive(KEY, *sample(3, NOW_NS - 99_999_999), NOW_NS)


def test_a_restarted_publisher_counts_from_one_again_and_is_taken_once_its_predecessor_is_silent_for_a_second() -> None:
    receiver = PoseReceiver("uav1")
    assert receiver.receive(KEY, *sample(900, NOW_NS - 5), NOW_NS)
    for after_ns in (1, S):
        assert receiver.receive(KEY, *sample(1, NOW_NS + after_ns, OTHER_GID), NOW_NS + after_ns) is None
    assert dict(receiver.refused) == {Refusal.PUBLISHER: 2}
    taken = receiver.receive(KEY, *sample(1, NOW_NS + S - 3, OTHER_GID), NOW_NS + S + 1)
    assert taken is not None
    assert taken.sequence == 1
    assert taken.age_s == pytest.approx(4e-9)


def test_of_two_publishers_the_first_alone_is_believed_while_it_is_heard() -> None:
    receiver = PoseReceiver("uav1")
    second = topics.publication_key(POSE, "uav1", "t1")
    for n in range(1, 40):
        now_ns = NOW_NS + n * S // 10
        assert receiver.receive(KEY, *sample(n, now_ns), now_ns)
        assert receiver.receive(KEY, *sample(n, now_ns + 1, OTHER_GID), now_ns + 1) is None
        assert receiver.receive(second, *sample(n, now_ns, OTHER_GID), now_ns)
    assert dict(receiver.refused) == {Refusal.PUBLISHER: 39}


def test_a_publisher_goes_on_though_a_router_puts_its_own_session_in_place_of_that_of_a_clock_ahead() -> None:
    receiver = PoseReceiver("uav1")
    second = topics.publication_key(POSE, "uav1", "t1")
    for n in range(1, 40):
        now_ns, session = NOW_NS + n * S // 10, ("daemon", "router")[n % 2]
        assert receiver.receive(KEY, *sample(n, now_ns), now_ns, session)
        assert receiver.receive(second, *sample(n, now_ns, OTHER_GID), now_ns, "another daemon") is None
    assert dict(receiver.refused) == {Refusal.PUBLISHER: 39}


def test_a_publisher_of_whom_nothing_can_be_taken_keeps_no_other_out() -> None:
    receiver = PoseReceiver("uav1")
    assert receiver.receive(KEY, *sample(1, NOW_NS), NOW_NS)
    for n in range(2, 14):
        now_ns = NOW_NS + n * S // 10
        assert receiver.receive(KEY, *sample(n, NOW_NS - S), now_ns) is None
    assert receiver.receive(KEY, *sample(1, now_ns, OTHER_GID), now_ns)


def test_targets_are_judged_apart() -> None:
    receiver = PoseReceiver("uav1")
    assert receiver.receive(KEY, *sample(5, NOW_NS), NOW_NS)
    assert receiver.receive(topics.publication_key(POSE, "uav1", "t1"), *sample(1, NOW_NS), NOW_NS)


def test_keys_and_attachments_are_judged_too() -> None:
    receiver = PoseReceiver("uav1")
    payload, attachment = sample(1, NOW_NS)
    assert receiver.receive(topics.publication_key(topics.ODOM, "uav1", "t0"), payload, attachment, NOW_NS) is None
    assert receiver.receive(topics.publication_key(POSE, "uav2", "t0"), payload, attachment, NOW_NS) is None
    assert receiver.receive(KEY, payload, b"", NOW_NS) is None
    assert dict(receiver.refused) == {Refusal.TOPIC: 2, Refusal.ATTACHMENT: 1}


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"frame_id": "ned"}, Refusal.FRAME),
        ({"frame_id": ""}, Refusal.FRAME),
        ({"covariance": np.zeros((6, 6))}, Refusal.VARIANCE),
        ({"covariance": np.diag([1.0, 1.0, 0.0, 1.0, 1.0, 1.0])}, Refusal.VARIANCE),
        ({"t_cam_target_m": np.array([0.0, -1e200, 300.0])}, Refusal.POSITION),
        ({"t_cam_target_m": np.array([0.0, 0.0, 100_001.0])}, Refusal.POSITION),
        ({"covariance": np.diag([1e308, 1e308, 1e308, 1.0, 1.0, 1.0])}, Refusal.POSITION),
        ({"covariance": np.diag([1.0, 1.0, 1.1e10, 1.0, 1.0, 1.0])}, Refusal.POSITION),
    ],
)
def test_what_no_camera_measured_is_refused(changes: dict[str, object], reason: Refusal) -> None:
    receiver, good = PoseReceiver("uav1"), dataclasses.replace(pose_now(), stamp_ns=NOW_NS)
    bad = dataclasses.replace(good, **changes).encode()  # type: ignore[arg-type]
    assert receiver.receive(KEY, bad, topics.attachment(1, NOW_NS, GID), NOW_NS) is None
    assert dict(receiver.refused) == {reason: 1}
    assert receiver.receive(KEY, good.encode(), topics.attachment(1, NOW_NS, GID), NOW_NS)


@settings(max_examples=60)
@given(
    st.lists(
        st.tuples(st.integers(-3, 40), st.integers(-2_000, 1_000), st.booleans(), st.integers(0, 1_500)), max_size=30
    )
)
def test_stamps_and_sequences_taken_always_rise(samples: list[tuple[int, int, bool, int]]) -> None:
    receiver, now_ns = PoseReceiver("uav1"), NOW_NS
    taken = []
    for sequence, offset_ms, other, pause_ms in samples:
        now_ns += pause_ms * 1_000_000
        stamp_ns = now_ns + offset_ms * 1_000_000
        pose = receiver.receive(KEY, *sample(sequence, stamp_ns, OTHER_GID if other else GID), now_ns)
        if pose is not None:
            taken.append((pose.stamp_ns, other, pose.sequence, now_ns))
    assert [t[0] for t in taken] == sorted({t[0] for t in taken})
    for publisher in (False, True):
        numbers = [t[2] for t in taken if t[1] is publisher]
        assert numbers == sorted(set(numbers))
    assert receiver.accepted + sum(receiver.refused.values()) == len(samples)
    assert all(-0.5 <= (arrival_ns - stamp_ns) / 1e9 <= 1.0 for stamp_ns, _, _, arrival_ns in taken)
    assert all(b[3] - a[3] > S for a, b in pairwise(taken) if a[1] is not b[1])


def test_made_up_publishers_do_not_grow_the_receiver() -> None:
    receiver = PoseReceiver("uav1")
    for n in range(1, 1000):
        now_ns = NOW_NS + 2 * n * S
        assert receiver.receive(KEY, *sample(1, now_ns, n.to_bytes(16, "little")), now_ns)
    assert len(receiver._sequences) <= 32


def test_a_clock_that_is_set_back_does_not_keep_poses_out() -> None:
    """An hour back on sender and receiver alike, as where both run on one host: the next pose is taken all the same."""
    receiver, hour_ns = PoseReceiver("uav1"), 3600 * S
    assert receiver.receive(KEY, *sample(1, NOW_NS), NOW_NS)
    back_ns = NOW_NS - hour_ns
    assert receiver.receive(KEY, *sample(2, back_ns), back_ns)
    assert receiver.receive(KEY, *sample(2, back_ns + 1), back_ns) is None
    assert receiver.receive(KEY, *sample(3, back_ns - 1), back_ns) is None
    assert dict(receiver.refused) == {Refusal.SEQUENCE: 1, Refusal.STALE: 1}
    further_ns = back_ns - hour_ns
    assert receiver.receive(KEY, *sample(1, further_ns, OTHER_GID), further_ns)


def seen(sequence: int, stamp_ns: int, **changed: Any) -> tuple[bytes, bytes]:
    ray = cdr.Vector3Stamped(stamp_ns, "camera_optical_frame", np.array([0.6, 0.0, 0.8]))
    return dataclasses.replace(ray, **changed).encode(), topics.attachment(sequence, NOW_NS, OTHER_GID)


def test_directions_and_poses_of_one_target_are_numbered_apart_and_taken_in_one_order() -> None:
    receiver = PoseReceiver("uav1")
    assert receiver.receive(KEY, *sample(7, NOW_NS), NOW_NS)
    taken = receiver.receive_direction(DIRECTION_KEY, *seen(1, NOW_NS + 1), NOW_NS)
    assert taken is not None
    assert (taken.target, taken.stamp_ns, taken.ray_cam.tolist()) == ("t0", NOW_NS + 1, [0.6, 0.0, 0.8])
    assert receiver.receive(KEY, *sample(8, NOW_NS + 2), NOW_NS)
    assert receiver.receive_direction(DIRECTION_KEY, *seen(1, NOW_NS + 3), NOW_NS) is None
    assert dict(receiver.refused) == {Refusal.SEQUENCE: 1}
    assert receiver.receive_direction(DIRECTION_KEY, *seen(2, NOW_NS + 1), NOW_NS) is None, "older than a pose"
    assert receiver.receive_direction(DIRECTION_KEY, *seen(3, NOW_NS + 4), NOW_NS)
    assert receiver.receive(KEY, *sample(9, NOW_NS + 3), NOW_NS) is None, "older than a direction"
    assert dict(receiver.refused) == {Refusal.SEQUENCE: 1, Refusal.STALE: 2}


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"ray_cam": np.array([0.6, 0.0, 0.9])}, Refusal.DIRECTION),
        ({"ray_cam": np.zeros(3)}, Refusal.DIRECTION),
        ({"ray_cam": np.array([0.6, np.nan, 0.8])}, Refusal.NOT_FINITE),
        ({"frame_id": "base_link_frd"}, Refusal.FRAME),
    ],
)
def test_what_is_no_direction_in_the_camera_s_frame_is_refused(changed: dict[str, Any], reason: Refusal) -> None:
    receiver = PoseReceiver("uav1")
    assert receiver.receive_direction(DIRECTION_KEY, *seen(1, NOW_NS, **changed), NOW_NS) is None
    assert dict(receiver.refused) == {reason: 1}


def test_a_direction_is_no_pose_and_a_pose_no_direction() -> None:
    receiver = PoseReceiver("uav1")
    assert receiver.receive(DIRECTION_KEY, *seen(1, NOW_NS), NOW_NS) is None
    assert receiver.receive_direction(KEY, *sample(1, NOW_NS), NOW_NS) is None
    assert dict(receiver.refused) == {Refusal.TOPIC: 2}
