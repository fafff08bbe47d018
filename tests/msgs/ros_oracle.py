"""rosbags as an independent CDR codec; vision_msgs from the package's own definitions (Jazzy, 4.1)."""

from __future__ import annotations

from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

_VISION_MSGS = {
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
    "vision_msgs/msg/ObjectHypothesisWithPose": "ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "vision_msgs/msg/Detection3D": (
        "std_msgs/Header header\nObjectHypothesisWithPose[] results\nBoundingBox3D bbox\nstring id\n"
    ),
    "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nDetection3D[] detections\n",
}

STORE = get_typestore(Stores.ROS2_JAZZY)
for _name, _definition in _VISION_MSGS.items():
    STORE.register(get_types_from_msg(_definition, _name))


def make(ros_type: str, *fields: Any) -> Any:
    """A message of the type, its fields in the definition's order."""
    return STORE.types[ros_type](*fields)


def serialize(message: Any) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__))


def deserialize(payload: bytes, ros_type: str) -> Any:
    return STORE.deserialize_cdr(payload, ros_type)
