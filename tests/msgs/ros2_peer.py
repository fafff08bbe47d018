"""A ROS 2 peer that shares no code with us: zenoh-ros2-sdk, on message definitions as ROS 2 ships them.

    python tests/msgs/ros2_peer.py PORT FOLDER UAV SECONDS

Prints one JSON object: the topics it finds with their types, the node and hash of each pose publisher, the hash that it
computes itself for a pose, and the first poses that it receives. FOLDER holds `<package>/msg/<Type>.msg`.
"""

from __future__ import annotations

import json
import sys
import threading
from typing import Any

import zenoh_ros2_sdk as ros2

POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
POSES = 3


def main() -> int:
    port, folder, uav, seconds = int(sys.argv[1]), sys.argv[2], sys.argv[3], float(sys.argv[4])
    ros2.get_registry(folder)
    peer = {"domain_id": 0, "router_ip": "127.0.0.1", "router_port": port}
    enough = threading.Event()
    poses: list[dict[str, Any]] = []

    def take(message: Any) -> None:
        position = message.pose.pose.position
        poses.append(
            {
                "frame": message.header.frame_id,
                "position_m": [position.x, position.y, position.z],
                "covariance": [float(value) for value in message.pose.covariance],
            }
        )
        if len(poses) >= POSES:
            enough.set()

    subscriber = ros2.ROS2Subscriber(f"/{uav}/target/t0/pose", POSE_TYPE, take, **peer)
    came = enough.wait(seconds)
    info = ros2.get_topic_info(f"/{uav}/target/t0/pose", verbose=True, timeout=5.0, **peer)
    publishers = [] if info is None else info.publishers
    found = {
        "topics": dict(ros2.get_topic_names_and_types(timeout=5.0, **peer)),
        "publishers": [[one.node_namespace, one.node_name, one.type_hash] for one in publishers],
        "own_hash": subscriber.type_hash,
        "poses": poses,
    }
    print(json.dumps(found), flush=True)
    subscriber.close()
    subscriber.session_mgr.session.close()
    return 0 if came else 1


if __name__ == "__main__":
    sys.exit(main())
