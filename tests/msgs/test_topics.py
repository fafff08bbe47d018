"""Names on zenoh, against the examples of rmw_zenoh's design document and the rules of its keys."""

from __future__ import annotations

import struct

import pytest
import xxhash
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from msgs import topics
from msgs.topics import CAMERA_INFO, DETECTIONS, POSE, TOPICS, Topic

# docs/design.md of ros2/rmw_zenoh, "Graph Cache".
DOCUMENTED_PUBLISHER = (
    "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/"
    "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18/::,7:,:,:,,"
)
ZID = "8b20917502ee955ac4476e0266340d5c"
uavs = st.from_regex(r"[A-Za-z][A-Za-z0-9_]{0,8}", fullmatch=True)


def test_publisher_token_has_the_documented_form() -> None:
    ours = topics.publisher_token(ZID, 0, 10, CAMERA_INFO, "uav1", domain=2)
    theirs, mine = DOCUMENTED_PUBLISHER.split("/"), ours.split("/")
    assert mine[:7] == theirs[:7]
    assert mine[7:11] == ["%uav1", "uavpose_edge", "%uav1%camera_info", "sensor_msgs::msg::dds_::CameraInfo_"]
    assert mine[11] == CAMERA_INFO.type_hash
    assert mine[12].count(":") == theirs[12].count(":") == 5
    assert [len(part.split(",")) for part in mine[12].split(":")] == [len(p.split(",")) for p in theirs[12].split(":")]


def test_qos_says_best_effort_or_transient_local() -> None:
    assert topics.qos_chunk(POSE) == "2::,5:,:,:,,"
    assert topics.qos_chunk(CAMERA_INFO) == ":1:,1:,:,:,,"


@pytest.mark.parametrize("topic", TOPICS, ids=lambda t: t.name)
@pytest.mark.parametrize("distribution", ["jazzy", "humble", "off"])
def test_a_subscription_finds_the_topic_under_every_distribution(
    topic: Topic, distribution: topics.Distribution
) -> None:
    target = "t3" if topic.per_target else None
    key = topics.publication_key(topic, "uav1", target, domain=7, distribution=distribution)
    assert zenoh.KeyExpr(topics.subscription_key(topic, "uav1", domain=7)).intersects(key)
    assert zenoh.KeyExpr(topics.subscription_key(topic, "uav1", target, domain=7)).intersects(key)
    assert topics.parse_key(key, "uav1", domain=7) == (topic, target)
    others = [t for t in TOPICS if t is not topic]
    assert not any(zenoh.KeyExpr(topics.subscription_key(t, "uav1", domain=7)).intersects(key) for t in others)


def test_the_pose_key_is_the_one_ros_subscribes_to() -> None:
    stem = "0/uav1/target/t0/pose/geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
    assert topics.publication_key(POSE, "uav1", "t0") == f"{stem}/{POSE.type_hash}"
    assert topics.publication_key(POSE, "uav1", "t0", distribution="humble") == f"{stem}/TypeHashNotSupported"
    assert topics.publication_key(POSE, "uav1", "t0", distribution="off") == "0/uav1/target/t0/pose"
    assert topics.encoding(POSE) == "application/cdr;geometry_msgs/msg/PoseWithCovarianceStamped"


@given(uavs, st.integers(0, 999), st.sampled_from(TOPICS))
def test_every_legal_name_gives_legal_zenoh_keys(uav: str, number: int, topic: Topic) -> None:
    target = f"t{number}" if topic.per_target else None
    zenoh.KeyExpr(topics.publication_key(topic, uav, target))
    zenoh.KeyExpr(topics.publisher_token(ZID, 0, 1, topic, uav, target))
    zenoh.KeyExpr(topics.node_token(ZID, 0, uav))


@pytest.mark.parametrize("uav", ["", "1uav", "uav 1", "uav/1", "uav*", "@uav", "ü"])
def test_an_illegal_uav_name_is_refused(uav: str) -> None:
    with pytest.raises(ValueError, match="uav name"):
        topics.publication_key(POSE, uav, "t0")


@pytest.mark.parametrize(("topic", "target"), [(POSE, None), (POSE, "x0"), (POSE, "*"), (DETECTIONS, "t0")])
def test_a_target_is_named_exactly_where_there_is_one(topic: Topic, target: str | None) -> None:
    with pytest.raises(ValueError, match="target"):
        topics.publication_key(topic, "uav1", target)


@pytest.mark.parametrize("target", ["", "0", "T0", "t1000", "*", "t0/pose", "target0"])
def test_nobody_waits_for_a_target_that_cannot_be(target: str) -> None:
    with pytest.raises(ValueError, match="must be t0"):
        topics.subscription_key(POSE, "uav1", target)


@pytest.mark.parametrize(
    "key",
    [
        "0/uav2/tf",
        "1/uav1/tf",
        "0/uav1/tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_00",
        "0/uav1/target/zz/pose",
        "0/uav1",
    ],
)
def test_foreign_keys_are_no_topic(key: str) -> None:
    assert topics.parse_key(key, "uav1") is None


def test_attachment_is_rmw_zenohs() -> None:
    token = topics.publisher_token(ZID, 0, 1, POSE, "uav1", "t0")
    digest = xxhash.xxh3_128(token.encode()).intdigest()
    data = topics.attachment(5, 1_700_000_000_000_000_001, topics.gid(token))
    low, high = digest & (2**64 - 1), digest >> 64
    assert data == struct.pack("<qqBQQ", 5, 1_700_000_000_000_000_001, 16, low, high)
    assert topics.parse_attachment(data) == (5, 1_700_000_000_000_000_001, topics.gid(token))


@given(st.binary(max_size=40))
def test_junk_attachments_are_none_or_well_formed(data: bytes) -> None:
    parsed = topics.parse_attachment(data)
    assert parsed is None or topics.attachment(*parsed) == data
