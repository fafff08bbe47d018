"""The topic table, and the zenoh names of its topics, chosen so that ROS 2 with rmw_zenoh_cpp sees native topics.

Key     `<domain>/<topic>/<pkg>::msg::dds_::<Type>_/<hash>`
Tokens  `@ros2_lv/<domain>/<zid>/<nid>/<nid>/NN/%/<namespace>/<node>` and
        `@ros2_lv/<domain>/<zid>/<nid>/<eid>/MP/%/<namespace>/<node>/<topic>/<type>/<hash>/<qos>`, `/` in names as `%`
Sample  encoding `application/cdr;<pkg>/msg/<Type>`, attachment (sequence from 1, UTC ns, 16, gid)

On Humble the hash is `TypeHashNotSupported`; with the distribution "off" the key ends after the topic.
`subscription_key` matches a topic under every distribution.
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import xxhash
from zenoh import CongestionControl, Priority, Reliability

Distribution = Literal["jazzy", "humble", "off"]

NODE_NAME = "uavpose_edge"
FRAME_CAMERA = "camera_optical_frame"  # cam: x right, y down, z forward
FRAME_TARGET = "target_frd"
FRAME_BODY = "base_link_frd"
FRAME_NED = "ned"
# NED axes with the origin at the own ship, moving with it: the targets' frame while the own position is unknown.
FRAME_BODY_NED = "base_link_ned"
TARGETS_MAX = 4  # of one vehicle at a time: t0 to t3

_ROS_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_TARGET_NAME = re.compile(r"t[0-9]{1,3}")
_ATTACHMENT = struct.Struct("<qqB16s")
HASH_UNSUPPORTED = "TypeHashNotSupported"


@dataclass(frozen=True)
class Topic:
    """One row of the table: topic name, ROS 2 interface type and quality of service."""

    name: str  # below `<uav>/`; contains `{target}` if each target has its own topic
    ros_type: str
    type_hash: str  # RIHS01 of the interface (REP 2011)
    reliability: Reliability
    congestion: CongestionControl
    priority: Priority
    rate: str
    cache: int  # samples kept for late joiners; 0: none
    recorded: bool  # by the recorder on board; False: only with `[recorder] image_max_hz`

    @property
    def per_target(self) -> bool:
        return "{target}" in self.name


_BEST_EFFORT, _RELIABLE, _DROP = Reliability.BEST_EFFORT, Reliability.RELIABLE, CongestionControl.DROP

POSE = Topic(
    "target/{target}/pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e",
    _BEST_EFFORT, _DROP, Priority.REAL_TIME, "frame rate, capped per link", 0, True,
)  # fmt: skip
ODOM = Topic(
    "target/{target}/odom",
    "nav_msgs/msg/Odometry",
    "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    _BEST_EFFORT, _DROP, Priority.REAL_TIME, "frame rate, capped per link", 0, True,
)  # fmt: skip
DIRECTION = Topic(
    "target/{target}/direction",
    "geometry_msgs/msg/Vector3Stamped",
    "RIHS01_d4829622288cbb443886e7ea94ea5671a3b1be6bab4ad04224432a65f7d7887a",
    _BEST_EFFORT, _DROP, Priority.REAL_TIME, "frame rate, capped per link", 0, True,
)  # fmt: skip
DETECTIONS = Topic(
    "target/detections",
    "vision_msgs/msg/Detection3DArray",
    "RIHS01_793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
    _BEST_EFFORT, _DROP, Priority.DATA, "frame rate; 2 Hz where poses are capped", 0, True,
)  # fmt: skip
TF = Topic(
    "tf",
    "tf2_msgs/msg/TFMessage",
    "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    _BEST_EFFORT, _DROP, Priority.DATA, "frame rate; 5 Hz where poses are capped", 0, True,
)  # fmt: skip
CAMERA_INFO = Topic(
    "camera_info",
    "sensor_msgs/msg/CameraInfo",
    "RIHS01_b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    _RELIABLE, _DROP, Priority.DATA_HIGH, "on change", 1, True,
)  # fmt: skip
IMAGE = Topic(
    "image/compressed",
    "sensor_msgs/msg/CompressedImage",
    "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    _BEST_EFFORT, _DROP, Priority.BACKGROUND, "at most 1 Hz, off on radio", 0, False,
)  # fmt: skip
DIAGNOSTICS = Topic(
    "diagnostics",
    "diagnostic_msgs/msg/DiagnosticArray",
    "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    _RELIABLE, _DROP, Priority.DATA_HIGH, "1 Hz", 0, True,
)  # fmt: skip
EVENTS = Topic(
    "events",
    "rcl_interfaces/msg/Log",
    "RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac",
    _RELIABLE, _DROP, Priority.DATA_HIGH, "on change", 50, True,
)  # fmt: skip

TOPICS = (POSE, ODOM, DIRECTION, DETECTIONS, TF, CAMERA_INFO, IMAGE, DIAGNOSTICS, EVENTS)


def check_uav_name(uav: str) -> str:
    """Return `uav` if ROS accepts it as a name (letter, then letters, digits, `_`); raises ValueError."""
    if not _ROS_NAME.fullmatch(uav):
        raise ValueError(f"uav name {uav!r} must be a letter followed by letters, digits or underscores")
    return uav


def _check_target_name(target: str) -> None:
    if not _TARGET_NAME.fullmatch(target):
        raise ValueError(f"target {target!r} must be t0, t1, …")


def topic_name(topic: Topic, uav: str, target: str | None = None) -> str:
    """`<uav>/<topic>` without a leading slash. `target` (`t0`, `t1`, …) is required for per-target topics only."""
    check_uav_name(uav)
    if topic.per_target != (target is not None):
        raise ValueError(f"topic {topic.name!r} {'needs a' if topic.per_target else 'takes no'} target")
    if target is not None:
        _check_target_name(target)
    return f"{uav}/{topic.name.format(target=target)}"


def dds_type(topic: Topic) -> str:
    """The ROS type in DDS notation, e.g. `nav_msgs::msg::dds_::Odometry_`."""
    package, _, name = topic.ros_type.split("/")
    return f"{package}::msg::dds_::{name}_"


def type_hash(topic: Topic, distribution: Distribution) -> str:
    """The type hash part of key and token."""
    return topic.type_hash if distribution == "jazzy" else HASH_UNSUPPORTED


def publication_key(
    topic: Topic, uav: str, target: str | None = None, *, domain: int = 0, distribution: Distribution = "jazzy"
) -> str:
    """The zenoh key on which samples are published. Raises ValueError for an invalid name."""
    stem = f"{domain}/{topic_name(topic, uav, target)}"
    if distribution == "off":
        return stem
    return f"{stem}/{dds_type(topic)}/{type_hash(topic, distribution)}"


def subscription_key(topic: Topic, uav: str, target: str | None = None, *, domain: int = 0) -> str:
    """A key expression for the topic under every distribution; `target` None matches all targets, `uav` "*" all UAVs.

    Raises ValueError for an invalid name: its key would never match anything.
    """
    if uav != "*":
        check_uav_name(uav)
    if target is not None:
        _check_target_name(target)
    return f"{domain}/{uav}/{topic.name.format(target=target or '*')}/**"


@lru_cache(maxsize=1024)  # called at frame rate with the same few keys
def parse_key(key: str, uav: str, *, domain: int = 0) -> tuple[Topic, str | None] | None:
    """(topic, target) of a sample's key, or None if it is not in this table."""
    prefix = f"{domain}/{uav}/"
    if not key.startswith(prefix):
        return None
    chunks = key[len(prefix) :].split("/")
    for topic in TOPICS:
        stem = topic.name.split("/")
        head, tail = chunks[: len(stem)], chunks[len(stem) :]
        matches = len(head) == len(stem) and all(s in ("{target}", h) for s, h in zip(stem, head, strict=True))
        if not matches or tail not in ([], [dds_type(topic), topic.type_hash], [dds_type(topic), HASH_UNSUPPORTED]):
            continue
        if not topic.per_target:
            return topic, None
        target = head[stem.index("{target}")]
        return (topic, target) if _TARGET_NAME.fullmatch(target) else None
    return None


def parse_any_key(key: str, *, domain: int = 0) -> tuple[str, Topic, str | None] | None:
    """(uav, topic, target) of a sample's key, of any UAV; None if it is not in this table."""
    first, _, rest = key.partition("/")
    uav = rest.partition("/")[0]
    if first != str(domain) or not _ROS_NAME.fullmatch(uav):
        return None
    row = parse_key(key, uav, domain=domain)
    return None if row is None else (uav, *row)


def encoding(topic: Topic) -> str:
    """The zenoh encoding of its samples, e.g. `application/cdr;nav_msgs/msg/Odometry`."""
    return f"application/cdr;{topic.ros_type}"


def table_markdown() -> str:
    """The table of topics as the documents show it."""
    lines = [
        "| topic | type | reliability | priority | rate | kept for late joiners | recorded |",
        "|---|---|---|---|---|---|---|",
    ]
    for one in TOPICS:
        name = f"`<uav>/{one.name}`".replace("{target}", "<tN>")
        reliability = "best effort" if one.reliability == Reliability.BEST_EFFORT else "reliable"
        priority = str(one.priority).rpartition(".")[2].lower().replace("_", " ")
        kept, recorded = str(one.cache or "–"), "yes" if one.recorded else "on board with `image_max_hz`"
        lines.append(f"| {name} | {one.ros_type} | {reliability} | {priority} | {one.rate} | {kept} | {recorded} |")
    return "\n".join(lines) + "\n"


def _mangle(name: str) -> str:
    return name.replace("/", "%")


def node_token(zid: str, node_id: int, uav: str, *, domain: int = 0, node: str = NODE_NAME) -> str:
    """Liveliness token of the ROS node `/<uav>/<node>`."""
    return f"@ros2_lv/{domain}/{zid}/{node_id}/{node_id}/NN/%/{_mangle('/' + uav)}/{node}"


def alive_token(uav: str) -> str:
    """Liveliness token of the UAV's daemon, present while its zenoh link is up, with or without ROS."""
    return f"uavpose/@v1/{check_uav_name(uav)}/alive"


def qos_chunk(topic: Topic) -> str:
    """rmw_zenoh's QoS notation: reliability, durability, history and depth, deadline, lifespan, liveliness.

    Values of the default profile are left empty; reliability 2 is best effort, durability 1 is transient local.
    """
    reliability = "2" if topic.reliability == Reliability.BEST_EFFORT else ""
    durability = "1" if topic.cache else ""
    return f"{reliability}:{durability}:,{topic.cache or 5}:,:,:,,"


def publisher_token(
    zid: str,
    node_id: int,
    entity_id: int,
    topic: Topic,
    uav: str,
    target: str | None = None,
    *,
    domain: int = 0,
    distribution: Distribution = "jazzy",
    node: str = NODE_NAME,
) -> str:
    """Liveliness token of one publisher, by which `ros2 topic list` and ROS subscribers discover it."""
    return (
        f"@ros2_lv/{domain}/{zid}/{node_id}/{entity_id}/MP/%/{_mangle('/' + uav)}/{node}/"
        f"{_mangle('/' + topic_name(topic, uav, target))}/{dds_type(topic)}/{type_hash(topic, distribution)}/"
        f"{qos_chunk(topic)}"
    )


def gid(token: str) -> bytes:
    """The publisher's 16-byte identity: xxh3_128 of its token, low 64 bits first, each little-endian."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def attachment(sequence: int, time_ns: int, publisher_gid: bytes) -> bytes:
    """Attachment of each sample: sequence number from 1, UTC ns of the put, the publisher's gid."""
    return _ATTACHMENT.pack(sequence, time_ns, 16, publisher_gid)


def parse_attachment(data: bytes) -> tuple[int, int, bytes] | None:
    """(sequence, time_ns, gid), or None if malformed."""
    if len(data) != _ATTACHMENT.size:
        return None
    sequence, time_ns, gid_length, publisher_gid = _ATTACHMENT.unpack(data)
    return (sequence, time_ns, publisher_gid) if gid_length == 16 and sequence >= 1 else None
