"""The zenoh link as a tool on board and a router on the ground see it: real sessions on loopback."""

from __future__ import annotations

import contextlib
import itertools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import zenoh
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from edge import clock
from edge.config import ZenohSettings
from edge.health import Activity, Condition, HealthSnapshot, HealthState, Percentiles, Reason
from edge.links.zenoh_link import ZenohLink
from edge.types import Mount, TrackState
from msgs import topics
from msgs.client import connect, subscribe, subscribe_all
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .reports import (
    OWN_NED_M,
    R_BODY_CAM,
    R_CAM_TARGET,
    R_NED_BODY,
    R_NED_CAM,
    ROTATION_UNKNOWN,
    SIZE_WH,
    T_CAM_TARGET_M,
    TRACKING,
    V_NED_MPS,
    K,
    rangeless,
)
from .reports import make_report as report
from .reports import make_track as track

MOUNT = Mount(R_BODY_CAM, np.array([0.5, 0.0, 0.2]))
ROS = get_typestore(Stores.ROS2_JAZZY)
# rosbags does not carry vision_msgs; these are the package's own definitions.
VISION_MSGS = {
    "ObjectHypothesis": "string class_id\nfloat64 score\n",
    "ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "Detection3D": "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id\n",
    "Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
}
for _name, _definition in VISION_MSGS.items():
    ROS.register(get_types_from_msg(_definition, f"vision_msgs/msg/{_name}"))


@contextlib.contextmanager
def linked(endpoint: str, **settings: Any) -> Iterator[ZenohLink]:
    link = ZenohLink(ZenohSettings(listen=[endpoint], **settings), "uav1", MOUNT)
    link.start()
    try:
        yield link
    finally:
        link.stop()


class Samples:
    """The newest sample of each topic, decoded by rosbags."""

    def __init__(self, session: zenoh.Session) -> None:
        self.newest: dict[str, Any] = {}
        handler = zenoh.handlers.Callback(self._take, indirect=False)
        self._subscriber = session.declare_subscriber("0/uav1/**", handler)

    def _take(self, sample: zenoh.Sample) -> None:
        row = topics.parse_key(str(sample.key_expr), "uav1")
        if row is None:
            return
        message = ROS.deserialize_cdr(sample.payload.to_bytes(), row[0].ros_type)
        self.newest[topics.topic_name(row[0], "uav1", row[1])] = message

    def wait(self, *names: str, each: Callable[[], None]) -> None:
        """Until all of these topics came; `each` is called again and again."""
        until(lambda: all(name in self.newest for name in names), each, what=f"samples of {', '.join(names)}")


def test_a_report_arrives_on_every_topic_as_ros_reads_it() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link, connect(endpoint) as session:
        samples = Samples(session)
        exposures_ns = []

        def publish() -> None:
            before_ns = time.time_ns()
            one = report(track(time.monotonic_ns()))
            exposures_ns.append((before_ns, time.time_ns()))
            link.publish(one)

        pose_name, odom_name = "uav1/target/t0/pose", "uav1/target/t0/odom"
        samples.wait(pose_name, odom_name, "uav1/target/detections", "uav1/tf", each=publish)
        pose, odom = samples.newest[pose_name], samples.newest[odom_name]
        found, tf = samples.newest["uav1/target/detections"], samples.newest["uav1/tf"]
    stamp_ns = pose.header.stamp.sec * 1_000_000_000 + pose.header.stamp.nanosec
    # The clocks are read one after the other here and when the link relates them: a few milliseconds either way.
    assert any(before_ns - 5_000_000 < stamp_ns < after_ns + 5_000_000 for before_ns, after_ns in exposures_ns)
    assert pose.header.frame_id == "camera_optical_frame"
    np.testing.assert_allclose(vector(pose.pose.pose.position), T_CAM_TARGET_M)
    np.testing.assert_allclose(matrix(pose.pose.pose.orientation), R_CAM_TARGET, atol=1e-12)
    np.testing.assert_allclose(pose.pose.covariance.reshape(6, 6), np.diag([0.09, 0.16, 144.0, 0.01, 0.02, 0.03]))

    assert (odom.header.frame_id, odom.child_frame_id) == ("ned", "target_frd")
    np.testing.assert_allclose(vector(odom.pose.pose.position), OWN_NED_M + R_NED_CAM @ T_CAM_TARGET_M)
    R_ned_target = matrix(odom.pose.pose.orientation)
    np.testing.assert_allclose(R_ned_target @ vector(odom.twist.twist.linear), V_NED_MPS, atol=1e-9)
    np.testing.assert_allclose(np.diag(odom.pose.covariance.reshape(6, 6)), [4.0, 9.0, 16.0, 0.01, 0.02, 0.09])
    twist = odom.twist.covariance.reshape(6, 6)
    np.testing.assert_allclose(R_ned_target @ twist[:3, :3] @ R_ned_target.T, np.diag([1.0, 4.0, 2.0]), atol=1e-9)

    (one,) = found.detections
    assert (one.id, one.results[0].hypothesis.score) == ("t0", 0.87)
    frames = [(t.header.frame_id, t.child_frame_id) for t in tf.transforms]
    chain = ["ned", "base_link_ned", "base_link_frd", "camera_optical_frame"]
    assert frames == list(itertools.pairwise(chain))
    # Up the chain, a point on the optical axis of a camera that looks along the nose lies ahead.
    point_m = np.array([0.0, 0.0, 10.0])
    for step in reversed(tf.transforms):
        point_m = matrix(step.transform.rotation) @ point_m + vector(step.transform.translation)
    np.testing.assert_allclose(point_m, OWN_NED_M + R_NED_BODY @ np.array([10.5, 0.0, 0.2]), atol=1e-9)
    np.testing.assert_allclose(vector(tf.transforms[0].transform.translation), OWN_NED_M)


def test_without_own_attitude_there_is_a_pose_but_nothing_in_ned() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link, connect(endpoint) as session:
        samples = Samples(session)
        in_cam_only = {"R_ned_target": None, "t_ned_target_m": None, "v_ned_target_mps": None, "covariance_ned": None}
        samples.wait(
            "uav1/target/t0/pose",
            "uav1/target/detections",
            each=lambda: link.publish(report(track(time.monotonic_ns(), **in_cam_only), own_ship=False)),
        )
        assert "sent_odom" not in link.counters()
        assert "sent_tf" not in link.counters()


def test_without_own_position_everything_is_told_around_the_own_ship_and_nothing_in_ned() -> None:
    endpoint, odom_name = free_endpoint(), "uav1/target/t0/odom"
    with linked(endpoint) as link, connect(endpoint) as session:
        samples = Samples(session)

        def publish() -> None:
            one = report(track(time.monotonic_ns()))
            assert one.own_ship is not None
            link.publish(replace(one, own_ship=replace(one.own_ship, t_ned_body_m=None, v_ned_body_mps=None)))

        samples.wait(odom_name, "uav1/tf", each=publish)
        odom, tf = samples.newest[odom_name], samples.newest["uav1/tf"]
    assert odom.header.frame_id == "base_link_ned"
    frames = [(t.header.frame_id, t.child_frame_id) for t in tf.transforms]
    assert frames == list(itertools.pairwise(["base_link_ned", "base_link_frd", "camera_optical_frame"]))


def test_tentative_stale_broken_and_unsure_tracks_never_leave() -> None:
    endpoint = free_endpoint()
    with linked(endpoint, max_age_ms=500.0) as link, connect(endpoint) as session:
        samples = Samples(session)

        def publish() -> None:
            now_ns = time.monotonic_ns()
            link.publish(
                report(
                    track(now_ns, track_id=1, state=TrackState.TENTATIVE),
                    track(now_ns, track_id=2, state=TrackState.COASTING, measured_ns=now_ns - 600_000_000),
                    track(now_ns, track_id=3, R_cam_target=np.full((3, 3), np.nan)),
                    track(now_ns, track_id=4, R_cam_target=np.ones((3, 3))),
                    track(now_ns, track_id=5, covariance=np.diag([1.0, 1.0, -9.0, 1.0, 1.0, 1.0])),
                    track(now_ns, track_id=6, covariance=np.diag([1.0, 1.0, 250.0**2, 1.0, 1.0, 1.0])),
                    track(now_ns, track_id=7, state=TrackState.COASTING, measured_ns=now_ns - 100_000_000),
                )
            )

        samples.wait("uav1/target/t7/pose", "uav1/target/detections", each=publish)
        (only,) = samples.newest["uav1/target/detections"].detections
        poses = {name for name in samples.newest if name.endswith(("pose", "odom"))}
    assert only.id == "t7"
    assert poses == {"uav1/target/t7/pose", "uav1/target/t7/odom"}


def test_a_report_that_waited_too_long_is_withheld_when_it_is_sent() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        link.publish(report(track(time.monotonic_ns() - 700_000_000)))
        until(lambda: link.counters().get("tracks_withheld") == 1, what="withholding")
        assert "sent_pose" not in link.counters()


def test_of_a_frame_that_is_too_old_nothing_is_told_that_has_its_time() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        old_ns = time.monotonic_ns() - 700_000_000
        link.publish(report(track(old_ns), now_ns=old_ns))
        until(lambda: link.counters().get("too_late") == 2, what="withholding")
        link.publish(report(track(time.monotonic_ns())))
        until(lambda: link.counters().get("sent_tf") == 1, what="the next frame")
        counted = link.counters()
    assert (counted["sent_pose"], counted["sent_odom"], counted["sent_detections"]) == (1, 1, 1)


def test_the_rest_of_a_report_does_not_go_out_after_the_process_was_held_up(stepped: int) -> None:
    """As when it is stopped while it sends the first of two targets, and goes on later."""
    seen = rangeless(track(stepped, track_id=1))
    with linked(free_endpoint(), max_age_ms=200.0) as link:
        assert link.session is not None
        # A subscriber of the session that publishes is called while it publishes.
        hold_up = zenoh.handlers.Callback(lambda _: clock.step_to(stepped + 200_000_001), indirect=False)
        link.session.declare_subscriber("0/uav1/target/t0/pose/**", hold_up)
        link.publish(report(track(stepped), seen, now_ns=stepped))
        link.settle()
        counted = link.counters()
    assert counted["too_late"] == 4  # odometry, the other target's direction, detections, transforms
    assert {name for name in counted if name.startswith("sent_")} == {"sent_pose", "sent_camera_info"}


def test_the_typed_client_takes_every_pose_it_gets() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link, connect(endpoint) as session, subscribe(session, "uav1", depth=64) as poses:
        taken = []
        began_ns = time.time_ns()

        def turn() -> None:
            link.publish(report(track(time.monotonic_ns())))
            while (pose := poses.poll()) is not None:
                taken.append((pose, time.time_ns()))

        until(lambda: len(taken) >= 20, turn, what="20 poses")
        assert not poses.refused
    assert all(a.stamp_ns < b.stamp_ns for (a, _), (b, _) in itertools.pairwise(taken))
    for pose, taken_ns in taken:
        # However long it took: its age is from its exposure to its receipt, give or take the clocks' relation.
        assert began_ns - 5_000_000 < pose.stamp_ns < taken_ns + 5_000_000
        assert -0.005 < pose.age_s < (taken_ns - pose.stamp_ns) * 1e-9 + 0.005


def test_who_joins_late_gets_intrinsics_and_events_from_the_cache() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        link.publish(report(track(time.monotonic_ns())))
        for text in ("searching", "tracking"):
            link.publish_event(20, text)
        until(lambda: link.counters().get("sent_events") == 2, what="events")
        assert link.counters()["sent_camera_info"] == 1
        with connect(endpoint) as session, subscribe_all(session, "uav1") as counts:
            until(
                lambda: counts.counts().get("uav1/events", 0) >= 2 and counts.counts().get("uav1/camera_info", 0) >= 1,
                what="history",
            )


def test_an_attitude_that_is_not_known_is_told_as_unknown_on_every_topic() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link, connect(endpoint) as session, subscribe(session, "uav1") as poses:
        samples = Samples(session)
        blind = lambda: link.publish(report(track(time.monotonic_ns(), covariance=ROTATION_UNKNOWN)))  # noqa: E731
        names = ("uav1/target/t0/pose", "uav1/target/t0/odom", "uav1/target/detections")
        samples.wait(*names, each=blind)
        pose, odom, found = (samples.newest[name] for name in names)
        (result,) = found.detections[0].results
        for told in (pose.pose, odom.pose, result.pose):
            q = told.pose.orientation
            assert (q.x, q.y, q.z, q.w) == (0.0, 0.0, 0.0, 1.0)
            assert np.diag(told.covariance.reshape(6, 6))[3:].tolist() == [1e6] * 3
        np.testing.assert_allclose(vector(pose.pose.pose.position), T_CAM_TARGET_M)
        # The velocity is in the target's axes, which without an attitude are ned's.
        np.testing.assert_allclose(vector(odom.twist.twist.linear), V_NED_MPS)
        taken = next(iter(poses))
        assert not taken.rotation_known
        samples.newest.clear()
        samples.wait(names[0], each=lambda: link.publish(report(track(time.monotonic_ns()))))
        assert any(one.rotation_known for one in iter(poses.poll, None))


def test_intrinsics_are_told_again_only_when_they_change() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link, connect(endpoint) as session:
        samples = Samples(session)
        zoomed = K * np.array([[2.0, 1.0, 1.0], [1.0, 2.0, 1.0], [1.0, 1.0, 1.0]])
        steps = [report(track(time.monotonic_ns())), report(track(time.monotonic_ns()))]
        steps.append(type(steps[0])(**{**vars(steps[0]), "K": zoomed}))
        for count, step in enumerate(steps, start=1):
            link.publish(step)
            until(lambda count=count: link.counters().get("sent_detections") == count, what="report")  # type: ignore[misc]
        assert link.counters()["sent_camera_info"] == 2
        samples.wait("uav1/camera_info", each=lambda: link.publish(report(track(time.monotonic_ns()))))
        info = samples.newest["uav1/camera_info"]
    assert (info.width, info.height) == SIZE_WH
    assert info.k[0] in (K[0, 0], zoomed[0, 0])


def test_health_arrives_as_diagnostics() -> None:
    endpoint = free_endpoint()
    snapshot = HealthSnapshot(
        time.monotonic_ns(),
        Condition(HealthState.DEGRADED, Activity.TRACKING, (Reason("no_attitude", "no own attitude"),)),
        1,
        29.97,
        {"capture_dropped": 3},
        {"track": Percentiles(6.0, 7.0, 8.5)},
    )
    with linked(endpoint) as link, connect(endpoint) as session:
        samples = Samples(session)
        samples.wait("uav1/diagnostics", each=lambda: link.publish_diagnostics(snapshot))
        (status,) = samples.newest["uav1/diagnostics"].status
    values = {pair.key: pair.value for pair in status.values}
    assert status.message == "degraded, tracking; no own attitude"
    assert (values["state"], values["activity"]) == ("degraded", "tracking")
    assert status.hardware_id == "uav1"
    assert values["capture_dropped"] == "3"
    assert values["latency_ms/track/p99"] == "8.50"
    assert (
        int(np.frombuffer(bytes([status.level]) if isinstance(status.level, int) else status.level, np.uint8)[0]) == 1
    )


def test_publishing_never_waits_and_the_newest_wins() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link:
        one = report(track(time.monotonic_ns()))
        worst_s = 0.0
        for _ in range(2000):
            began = time.perf_counter()
            link.publish(one)
            worst_s = max(worst_s, time.perf_counter() - began)
        until(
            lambda: link.counters()["reports_replaced"] + link.counters().get("sent_detections", 0) == 2000,
            what="delivery",
        )
        assert link.counters()["reports_replaced"] > 0
    assert worst_s < 0.5


def test_one_message_that_no_field_holds_does_not_end_the_link() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link, connect(endpoint) as session:
        samples = Samples(session)
        now_ns = time.monotonic_ns()
        after_2038_ns = now_ns + 30 * 365 * 86_400 * 1_000_000_000
        link.publish_diagnostics(HealthSnapshot(after_2038_ns, TRACKING, 1, 30.0, {}, {}))
        until(lambda: link.counters().get("failed", 0) == 1, what="failure")
        samples.wait("uav1/target/t0/pose", each=lambda: link.publish(report(track(time.monotonic_ns()))))


def test_events_go_out_beside_a_message_that_cannot() -> None:
    endpoint = free_endpoint()
    link = ZenohLink(ZenohSettings(listen=[endpoint]), "uav1", MOUNT)
    after_2038_ns = time.monotonic_ns() + 30 * 365 * 86_400 * 1_000_000_000
    link.publish_diagnostics(HealthSnapshot(after_2038_ns, TRACKING, 1, 30.0, {}, {}))
    link.publish_event(40, "fault")
    link.start()
    try:
        until(lambda: link.counters().get("sent_events") == 1, what="the event")
        assert link.counters()["failed"] == 1
    finally:
        link.stop()


def vector(v: Any) -> np.ndarray:
    return np.array([v.x, v.y, v.z])


def matrix(q: Any) -> np.ndarray:
    return Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
