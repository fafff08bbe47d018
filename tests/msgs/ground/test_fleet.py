"""How things stand, when clocks are set, history comes late and numbers are used again."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msgs import cdr, topics
from msgs.ground.feed import Incoming
from msgs.ground.fleet import DirectionRow, Fleet, TargetRow
from msgs.topics import Topic
from msgs.wire import Refusal

from ..conftest import pose_now
from .flight import R_BODY_CAM

NOW_NS = 1_700_000_000_000_000_000
MS, S, HOUR_NS = 1_000_000, 1_000_000_000, 3_600_000_000_000
FRAME_NS, YAW_DEG_S = 40 * MS, 30.0
GID, OTHER_GID = bytes(range(16)), bytes(range(1, 17))


def incoming(topic: Topic, message: cdr.Payload, number: int, gid: bytes = GID, target: str | None = None) -> Incoming:
    key = topics.publication_key(topic, "uav1", target)
    attachment = topics.attachment(number, NOW_NS, gid)
    return Incoming("uav1", topic, target, key, message.encode(), attachment)


def event(text: str, stamp_ns: int, number: int, gid: bytes = GID) -> Incoming:
    return incoming(topics.EVENTS, cdr.Log(stamp_ns, 20, "uavpose_edge", text), number, gid)


def pose(stamp_ns: int, number: int, z_m: float = 300.0, gid: bytes = GID, target: str = "t0") -> Incoming:
    return incoming(topics.POSE, dataclasses.replace(pose_now(z_m), stamp_ns=stamp_ns), number, gid, target)


def told(fleet: Fleet) -> str:
    (row,) = fleet.rows(NOW_NS)
    return row.event


def test_an_event_after_the_vehicles_clock_was_set_back_is_told() -> None:
    fleet = Fleet()
    assert fleet.take(event("tracking", NOW_NS, 1), NOW_NS) is not None
    assert fleet.take(event("fault: no frame", NOW_NS - HOUR_NS, 2), NOW_NS + S) is not None
    assert told(fleet) == "fault: no frame"


def test_history_that_comes_after_the_present_is_not_news_and_a_restarted_daemons_first_word_is() -> None:
    fleet = Fleet()
    assert fleet.take(event("tracking", NOW_NS, 7), NOW_NS) is not None
    assert fleet.take(event("searching", NOW_NS - S, 6), NOW_NS) is None
    assert told(fleet) == "tracking"
    assert fleet.take(event("init", NOW_NS - HOUR_NS, 1, OTHER_GID), NOW_NS) is not None
    assert told(fleet) == "init"


def test_targets_of_before_our_clock_was_set_back_are_not_shown_for_as_long() -> None:
    fleet = Fleet()
    fleet.take(pose(NOW_NS, 1), NOW_NS)
    assert [len(row.targets) for row in fleet.rows(NOW_NS + S)] == [1]
    (row,) = fleet.rows(NOW_NS - HOUR_NS)
    assert (row.targets, row.pose_rate_hz) == ((), 0.0)


def test_four_targets_at_120_frames_a_second_are_480_poses_a_second() -> None:
    fleet, frame_ns = Fleet(), S // 120
    for number in range(1, 500):
        now_ns = NOW_NS + number * frame_ns
        for target in ("t0", "t1", "t2", "t3"):
            message = dataclasses.replace(pose_now(300.0), stamp_ns=now_ns)
            assert fleet.take(incoming(topics.POSE, message, number, target=target), now_ns) is not None
    (row,) = fleet.rows(now_ns)
    assert row.pose_rate_hz == pytest.approx(480.0, rel=0.01)


def detections(stamp_ns: int, number: int, score: float) -> Incoming:
    t, q, covariance = np.array([1.0, 2.0, 300.0]), np.array([0.0, 0.0, 0.0, 1.0]), np.eye(6)
    hypothesis = cdr.Hypothesis("fixed_wing", score, t, q, covariance)
    one = cdr.Detection3D(stamp_ns, "camera_optical_frame", (hypothesis,), t, q, np.zeros(3), "t0")
    return incoming(topics.DETECTIONS, cdr.Detection3DArray(stamp_ns, "camera_optical_frame", (one,)), number)


def test_a_score_is_not_told_for_poses_long_after_it() -> None:
    """As over a link that no longer carries detections."""
    fleet = Fleet()
    fleet.take(detections(NOW_NS, 1, 0.9), NOW_NS)
    scores = []
    for number, after_ns in enumerate((0, S, 3 * S), start=1):
        fleet.take(pose(NOW_NS + after_ns, number), NOW_NS + after_ns)
        (row,) = fleet.rows(NOW_NS + after_ns)
        scores.append(row.targets[0].score)
    assert scores == [0.9, 0.9, None]


def test_how_fast_a_target_nears_is_not_taken_across_a_clock_that_was_set_back() -> None:
    fleet = Fleet()
    for k in range(20):
        fleet.take(pose(NOW_NS + k * S // 10, k + 1, 300.0 - 2.0 * k), NOW_NS + k * S // 10)
    back_ns = NOW_NS - HOUR_NS
    for k in range(20):
        fleet.take(pose(back_ns + k * S // 10, k + 21, 260.0 - 1.0 * k), back_ns + k * S // 10)
    (row,) = fleet.rows(back_ns + 2 * S)
    assert row.targets[0].closing_mps == pytest.approx(10.0, abs=0.5)


def closing_mps(ranges: Sequence[tuple[int, float]]) -> list[float | None]:
    """As it is told with each of the poses at these (ns from the start, m)."""
    fleet, told = Fleet(), list[float | None]()
    for number, (after_ns, range_m) in enumerate(ranges, start=1):
        row = fleet.take(pose(NOW_NS + after_ns, number, range_m), NOW_NS + after_ns)
        assert isinstance(row, TargetRow)
        told.append(row.closing_mps)
    return told


def test_another_aircraft_under_the_same_number_nears_from_where_it_is() -> None:
    """Both rest. How fast is told again as soon as there is enough of the second."""
    first = [(k * 33 * MS, 400.0) for k in range(60)]
    second = [(first[-1][0] + 130 * MS + k * 33 * MS, 150.0) for k in range(60)]
    told = closing_mps(first + second)
    assert all(one is None or abs(one) < 5.0 for one in told)
    assert told[59] is not None
    assert told[60] is None
    assert None not in told[-40:]


def test_a_track_that_is_moved_once_does_not_near_for_it() -> None:
    told = closing_mps([(k * 33 * MS, 300.0 if k < 45 else 360.0) for k in range(90)])
    assert all(one is None or abs(one) < 5.0 for one in told)
    assert told[44] is not None
    assert None not in told[-30:]


@pytest.mark.parametrize("rate_hz", [30, 5])
def test_how_fast_a_fast_one_nears_is_told_all_along(rate_hz: int) -> None:
    """Nearly head on, each range off by a metre; also at the few poses a second of a radio."""
    off_m = np.random.default_rng(0).normal(size=3 * rate_hz)
    told = closing_mps([(k * S // rate_hz, 500.0 - 120.0 * k / rate_hz + off_m[k]) for k in range(3 * rate_hz)])
    assert told[rate_hz:] == pytest.approx([120.0] * (2 * rate_hz), abs=10.0)


def R_ned_body(stamp_ns: int) -> Rotation:
    """Of a vehicle that yaws steadily."""
    return Rotation.from_euler("Z", YAW_DEG_S * (stamp_ns - NOW_NS) / S, degrees=True)


def turning_frame(stamp_ns: int, number: int, *, own: bool) -> Iterator[Incoming]:
    """A target straight north, as the camera of the turning vehicle sees it; its own attitude is told after it."""
    R_ned_cam = R_ned_body(stamp_ns).as_matrix() @ R_BODY_CAM
    t_m, upright = R_ned_cam.T @ np.array([200.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
    seen = cdr.PoseWithCovarianceStamped(stamp_ns, topics.FRAME_CAMERA, t_m, upright, 0.01 * np.eye(6))
    yield incoming(topics.POSE, seen, number, target="t0")
    if own:
        q_body, q_cam = R_ned_body(stamp_ns).as_quat(), Rotation.from_matrix(R_BODY_CAM).as_quat()
        links = (
            cdr.TransformStamped(stamp_ns, topics.FRAME_BODY_NED, topics.FRAME_BODY, np.zeros(3), q_body),
            cdr.TransformStamped(stamp_ns, topics.FRAME_BODY, topics.FRAME_CAMERA, np.zeros(3), q_cam),
        )
        yield incoming(topics.TF, cdr.TFMessage(links), number)


def off_north_deg(row: TargetRow) -> float:
    return abs((row.bearing_deg + 180.0) % 360.0 - 180.0)


@pytest.mark.parametrize("own_every", [1, 5])
def test_bearings_of_a_turning_vehicle_are_by_its_attitude_of_that_instant(own_every: int) -> None:
    """At the rate of the poses and at the 5 Hz of a radio; looked at after each sample."""
    fleet, told, shown = Fleet(), list[TargetRow](), list[TargetRow]()
    for k in range(100):
        stamp_ns = NOW_NS + k * FRAME_NS
        for one in turning_frame(stamp_ns, k + 1, own=k % own_every == 0):
            news = fleet.take(one, stamp_ns + 20 * MS)
            told += [news] if isinstance(news, TargetRow) else []
            (vehicle,) = fleet.rows(stamp_ns + 20 * MS)
            shown += vehicle.targets if k > own_every else ()
            assert stamp_ns - vehicle.targets[0].stamp_ns <= own_every * FRAME_NS
    assert {row.frame for row in shown} == {"ned"}
    assert max(map(off_north_deg, shown)) < 0.01
    # What is told at once, before the frame's own attitude, is predicted from the last two.
    at_once = [row for row in told if row.stamp_ns > NOW_NS + 2 * own_every * FRAME_NS]
    assert {row.frame for row in at_once} == {"ned"}
    assert max(map(off_north_deg, at_once)) < 0.01
    assert {round((row.own_age_s or 0.0) * S / FRAME_NS) for row in at_once} == set(range(1, own_every + 1))


def test_own_attitude_is_predicted_by_no_more_than_it_was_seen_to_turn_and_not_for_long() -> None:
    fleet, rows = Fleet(), list[TargetRow]()
    for k in range(30):
        for one in turning_frame(NOW_NS + k * FRAME_NS, k + 1, own=k < 10):
            news = fleet.take(one, NOW_NS + k * FRAME_NS)
            rows += [news] if isinstance(news, TargetRow) else []
    assert [row.frame for row in rows[2:]] == ["ned"] * 11 + ["cam"] * 17  # up to 120 ms after the tenth
    assert off_north_deg(rows[10]) < 0.01
    assert off_north_deg(rows[12]) == pytest.approx(2 * YAW_DEG_S * FRAME_NS / S, abs=0.01)
    assert [row.own_age_s for row in rows[12:14]] == [pytest.approx(0.12), None]


def test_without_own_attitude_a_row_is_by_the_camera_and_a_lost_target_keeps_its_bearing() -> None:
    fleet = Fleet()
    for k in range(50):
        for one in turning_frame(NOW_NS + k * FRAME_NS, k + 1, own=k < 30):
            fleet.take(one, NOW_NS + k * FRAME_NS)
    (vehicle,) = fleet.rows(NOW_NS + 2 * S)
    assert (vehicle.targets[0].frame, vehicle.targets[0].stamp_ns) == ("cam", NOW_NS + 49 * FRAME_NS)

    fleet = Fleet()
    for k in range(200):
        seen, own = turning_frame(NOW_NS + k * FRAME_NS, k + 1, own=True)
        for one in (seen, own) if k < 30 else (own,):
            fleet.take(one, NOW_NS + k * FRAME_NS)
    (vehicle,) = fleet.rows(NOW_NS + 8 * S)
    assert (vehicle.targets[0].frame, vehicle.targets[0].stamp_ns) == ("ned", NOW_NS + 29 * FRAME_NS)
    assert off_north_deg(vehicle.targets[0]) < 0.01


def attitude(stamp_ns: int, yaw_deg: float) -> cdr.TFMessage:
    """Own ship and camera, which looks along the nose."""
    q_ned_body = Rotation.from_euler("ZYX", [yaw_deg, 0.0, 0.0], degrees=True).as_quat()
    q_body_cam = Rotation.from_matrix(R_BODY_CAM).as_quat()
    links = [
        (topics.FRAME_BODY_NED, topics.FRAME_BODY, q_ned_body),
        (topics.FRAME_BODY, topics.FRAME_CAMERA, q_body_cam),
    ]
    return cdr.TFMessage(tuple(cdr.TransformStamped(stamp_ns, a, b, np.zeros(3), q) for a, b, q in links))


def test_of_two_daemons_of_one_name_one_tells_targets_attitude_and_health() -> None:
    """One looks north, its attitude thinned as on a radio, the other south."""
    fleet, seen = Fleet(), set()
    well, ill = (
        cdr.DiagnosticArray(NOW_NS, "", (cdr.DiagnosticStatus(level, "uavpose", said, "", ()),))
        for level, said in ((0, "well"), (2, "ill"))
    )
    for k in range(60):
        now_ns = NOW_NS + k * 100 * MS
        ours = [incoming(topics.TF, attitude(now_ns, 0.0), k + 1)] if k % 2 == 0 else []
        ours += [pose(now_ns, k + 1), incoming(topics.DIAGNOSTICS, well, k + 1)]
        later_ns = now_ns + 10 * MS
        theirs = [incoming(topics.TF, attitude(later_ns, 180.0), k + 1, OTHER_GID)]
        theirs += [pose(later_ns, k + 1, 450.0, OTHER_GID, target) for target in ("t0", "t1")]
        theirs.append(incoming(topics.DIAGNOSTICS, ill, k + 1, OTHER_GID))
        for sender, samples in (("a", ours), ("b", theirs)):
            for one in samples:
                fleet.take(dataclasses.replace(one, sender=sender), now_ns + 20 * MS)
        (row,) = fleet.rows(now_ns + 20 * MS)
        seen |= {(row.health, one.target, round(one.range_m), round(one.bearing_deg)) for one in row.targets}
    assert seen == {("well", "t0", 300, 0)}
    assert row.refused == {Refusal.PUBLISHER: 60 * 4}
    (after,) = [pose(now_ns + 2 * S, 900, 450.0, OTHER_GID)]
    assert fleet.take(dataclasses.replace(after, sender="b"), now_ns + 2 * S) is not None, "the first is silent"


def test_a_target_whose_range_is_no_longer_known_keeps_its_bearing_alone() -> None:
    """In the turning vehicle's ned: for ten frames poses, for ten directions, then poses again."""
    fleet, rows = Fleet(), list[TargetRow | DirectionRow]()
    for number in range(1, 31):
        stamp_ns = NOW_NS + number * FRAME_NS
        told = list(turning_frame(stamp_ns, number, own=True))
        if 10 < number <= 20:
            pose_of = cdr.PoseWithCovarianceStamped.decode(told[0].payload)
            ray = pose_of.t_cam_target_m / np.linalg.norm(pose_of.t_cam_target_m)
            seen = cdr.Vector3Stamped(stamp_ns, topics.FRAME_CAMERA, ray)
            told[0] = incoming(topics.DIRECTION, seen, number, OTHER_GID, "t0")
        for one in told:
            fleet.take(one, stamp_ns)
        (vehicle,) = fleet.rows(stamp_ns)
        (row,) = vehicle.targets
        assert row.stamp_ns == stamp_ns
        assert vehicle.pose_rate_hz * 3.0 == pytest.approx(number if number <= 10 else max(10, number - 10))
        rows.append(row)
    assert [isinstance(row, DirectionRow) for row in rows] == [False] * 10 + [True] * 10 + [False] * 10
    for row in rows:
        assert (row.frame, row.own_age_s) == ("ned", 0.0)
        assert abs((row.bearing_deg + 180.0) % 360.0 - 180.0) < 1e-6
        assert row.elevation_deg == pytest.approx(0.0, abs=1e-6)
    last = rows[-1]
    assert isinstance(last, TargetRow)
    assert last.closing_mps == pytest.approx(0.0, abs=1e-6)
