"""Directions of targets whose range is not known, as a tool on board sees them: real sessions on loopback."""

from __future__ import annotations

import time

import numpy as np

from edge.types import TrackState
from msgs.client import connect, subscribe_directions
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .reports import T_CAM_TARGET_M, make_report, make_track, rangeless
from .test_zenoh_link import Samples, linked, vector


def test_of_a_target_whose_range_is_not_known_the_direction_alone_is_told() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link, connect(endpoint) as session:
        samples = Samples(session)

        def publish() -> None:
            now_ns = time.monotonic_ns()
            anywhere = np.diag([5.0**2, 1.0, 250.0**2, 1.0, 1.0, 1.0])
            link.publish(
                make_report(
                    rangeless(make_track(now_ns, track_id=0)),
                    make_track(now_ns, track_id=1, covariance=anywhere),
                    rangeless(make_track(now_ns, track_id=2, state=TrackState.TENTATIVE)),
                    make_track(now_ns, track_id=3),
                )
            )

        samples.wait("uav1/target/t0/direction", "uav1/target/t3/pose", "uav1/target/detections", each=publish)
        seen = samples.newest["uav1/target/t0/direction"]
        of_targets = {name for name in samples.newest if "/target/t" in name}
        (only,) = samples.newest["uav1/target/detections"].detections
        counted = link.counters()
    assert counted["tracks_withheld"] == 2 * counted["sent_detections"]
    assert seen.header.frame_id == "camera_optical_frame"
    np.testing.assert_allclose(vector(seen.vector), T_CAM_TARGET_M / np.linalg.norm(T_CAM_TARGET_M))
    assert of_targets == {"uav1/target/t0/direction", "uav1/target/t3/pose", "uav1/target/t3/odom"}
    assert only.id == "t3"


def test_the_typed_client_takes_every_direction_it_gets() -> None:
    endpoint = free_endpoint()
    with linked(endpoint) as link, connect(endpoint) as session, subscribe_directions(session, "uav1") as seen:
        taken = []

        def publish() -> None:
            link.publish(make_report(rangeless(make_track(time.monotonic_ns()))))
            taken.extend(iter(seen.poll, None))

        until(lambda: len(taken) >= 5, publish, what="directions")
        assert not seen.refused
    assert {one.target for one in taken} == {"t0"}
    np.testing.assert_allclose(taken[0].ray_cam, T_CAM_TARGET_M / np.linalg.norm(T_CAM_TARGET_M))
