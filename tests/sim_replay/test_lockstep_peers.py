"""The subscriber in lock-step on a real session, with a publisher in place of the daemon."""

from __future__ import annotations

import numpy as np
import zenoh

from edge.status_board import key_of
from msgs import session, topics
from msgs.cdr import Detection3DArray, Vector3Stamped
from msgs.publish import Node
from sim_replay.lockstep.command import line_of
from sim_replay.lockstep.peers import Subscriber
from sim_replay.ports import free_endpoint

NOW_NS = 1_000_000_000_000


def test_a_frame_of_a_target_whose_range_is_not_known_brings_its_direction_and_no_pose() -> None:
    endpoint = free_endpoint()
    ray_cam = np.array([0.6, 0.0, 0.8])
    with zenoh.open(session.peer_config([endpoint], [])) as daemon, Node(daemon, "uav1") as node:
        answers = daemon.declare_queryable(key_of("uav1", "info"), lambda query: query.reply(query.key_expr, b"{}"))
        directions, detections = node.publisher(topics.DIRECTION, "t1"), node.publisher(topics.DETECTIONS)
        subscriber = Subscriber(endpoint, "uav1", NOW_NS)
        try:
            directions.put(Vector3Stamped(NOW_NS, topics.FRAME_CAMERA, ray_cam).encode())
            detections.put(Detection3DArray(NOW_NS, topics.FRAME_CAMERA, ()).encode())
            found = subscriber.collect(0, NOW_NS)
        finally:
            subscriber.close()
            answers.undeclare()
    told = {"event": "direction", "target": "t1", "capture_utc_ns": NOW_NS, "age_ms": 0.0}
    assert found == subscriber.directions == [told | {"ray_cam": ray_cam.tolist()}]
    assert subscriber.records == []
    assert line_of(0, found) == "frame 0: t1 towards 0.600 0.000 0.800, range not known"
