"""An independent ROS 2 peer finds the vehicle's node and topics with their types and receives its poses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
from rosbags.typesys import Stores, get_typestore

from msgs import topics
from msgs.publish import Node
from tests.waiting import until

from .conftest import Network, pose_now
from .ros2_peer import POSE_TYPE

SECONDS = 60.0
# As docs/ground.md says: between two peers a router of ours carries nothing.
CLIENT = {**os.environ, "ZENOH_CONFIG_OVERRIDE": 'mode="client"'}
NEEDED = (
    "builtin_interfaces/msg/Time", "std_msgs/msg/Header", "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion",
    "geometry_msgs/msg/Pose", "geometry_msgs/msg/PoseWithCovariance", POSE_TYPE,
)  # fmt: skip


def write_definitions(folder: Path) -> None:
    """As a ROS 2 installation has them, so that the peer need not fetch them."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for ros_type in NEEDED:
        package, kind, name = ros_type.split("/")
        path = folder / package / kind / f"{name}.msg"
        path.parent.mkdir(parents=True, exist_ok=True)
        # What follows the line of equals signs are the definitions of the types within.
        path.write_text(store.generate_msgdef(ros_type, ros_version=2)[0].split("=" * 80)[0])


def test_an_independent_peer_lists_the_node_and_its_topics_and_receives_poses(network: Network, tmp_path: Path) -> None:
    write_definitions(tmp_path)
    port = network.endpoint.rpartition(":")[2]
    command = [sys.executable, "-m", "tests.msgs.ros2_peer", port, str(tmp_path), "uav1", str(SECONDS)]
    root = Path(__file__).parents[2]
    with Node(network.daemon, "uav1") as node:
        poses = node.publisher(topics.POSE, "t0")
        for topic in topics.TOPICS:
            if topic is not topics.POSE:
                node.publisher(topic, "t0" if topic.per_target else None)
        peer = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=root, env=CLIENT
        )
        until(
            lambda: peer.poll() is not None,
            lambda: poses.put(pose_now(321.0).encode()),
            what="the peer's end",
            within_s=2 * SECONDS,
        )
        said, complaints = peer.communicate()
    assert peer.returncode == 0, said + complaints
    found = json.loads(said)
    expected = {"/" + topics.topic_name(t, "uav1", "t0" if t.per_target else None): [t.ros_type] for t in topics.TOPICS}
    assert {name: types for name, types in found["topics"].items() if name.startswith("/uav1/")} == expected
    assert found["publishers"] == [["/uav1", topics.NODE_NAME, topics.POSE.type_hash]]
    assert found["own_hash"] == topics.POSE.type_hash
    for pose in found["poses"]:
        assert pose["frame"] == topics.FRAME_CAMERA
        assert pose["position_m"] == [1.0, 2.0, 321.0]
        np.testing.assert_array_equal(np.reshape(pose["covariance"], (6, 6)), np.eye(6))
