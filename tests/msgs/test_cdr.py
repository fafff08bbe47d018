"""Our CDR against rosbags' for random values, and against bytes that nobody sane would send."""

from __future__ import annotations

import contextlib
import dataclasses
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from msgs import cdr, topics
from msgs.wire import PayloadError, Refusal

from .ros_oracle import STORE, deserialize, make, serialize

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)
text = st.text(st.characters(exclude_characters="\x00", exclude_categories=["Cs"]), max_size=9)
stamps = st.integers(0, 2**31 * 10**9 - 1)
u32 = st.integers(0, 2**32 - 1)


def vectors(n: int) -> st.SearchStrategy[np.ndarray]:
    return st.lists(finite, min_size=n, max_size=n).map(np.array)


@st.composite
def quaternions(draw: st.DrawFn) -> np.ndarray:
    q = np.array(draw(st.lists(st.floats(-1, 1), min_size=4, max_size=4)))
    norm = np.linalg.norm(q)
    return q / norm if norm > 1e-3 else np.array([0.0, 0.0, 0.0, 1.0])


@st.composite
def covariances(draw: st.DrawFn) -> np.ndarray:
    rng = np.random.default_rng(draw(u32))
    root = rng.normal(size=(6, draw(st.integers(1, 6)))) * 10.0 ** rng.uniform(-4, 3, size=(6, 1))
    full = root @ root.T
    return (full + full.T) / 2


hypotheses = st.builds(cdr.Hypothesis, text, finite, vectors(3), quaternions(), covariances())
detections = st.builds(
    cdr.Detection3D,
    stamps,
    text,
    st.lists(hypotheses, max_size=2).map(tuple),
    vectors(3),
    quaternions(),
    vectors(3),
    text,
)
transforms = st.builds(cdr.TransformStamped, stamps, text, text, vectors(3), quaternions())
statuses = st.builds(
    cdr.DiagnosticStatus,
    st.integers(0, 3),
    text,
    text,
    text,
    st.lists(st.tuples(text, text), max_size=3).map(tuple),
)
payloads = st.one_of(
    st.builds(cdr.PoseWithCovarianceStamped, stamps, text, vectors(3), quaternions(), covariances()),
    st.builds(
        cdr.Odometry,
        stamps,
        text,
        text,
        vectors(3),
        quaternions(),
        covariances(),
        vectors(3),
        vectors(3),
        covariances(),
    ),
    st.builds(cdr.Vector3Stamped, stamps, text, vectors(3)),
    st.builds(cdr.Detection3DArray, stamps, text, st.lists(detections, max_size=3).map(tuple)),
    st.builds(cdr.TFMessage, st.lists(transforms, max_size=3).map(tuple)),
    st.builds(
        cdr.CameraInfo,
        stamps,
        text,
        u32,
        u32,
        text,
        st.lists(finite, max_size=8).map(np.array),
        vectors(9).map(lambda v: v.reshape(3, 3)),
        vectors(9).map(lambda v: v.reshape(3, 3)),
        vectors(12).map(lambda v: v.reshape(3, 4)),
        u32,
        u32,
        st.builds(cdr.RegionOfInterest, u32, u32, u32, u32, st.booleans()),
    ),
    st.builds(cdr.CompressedImage, stamps, text, text, st.binary(max_size=40)),
    st.builds(cdr.DiagnosticArray, stamps, text, st.lists(statuses, max_size=3).map(tuple)),
    st.builds(cdr.Log, stamps, st.integers(0, 255), text, text, text, text, u32),
)


def _stamp(ns: int) -> Any:
    return make("builtin_interfaces/msg/Time", ns // 10**9, ns % 10**9)


def _header(message: Any) -> Any:
    return make("std_msgs/msg/Header", _stamp(message.stamp_ns), message.frame_id)


def _pose(t: np.ndarray, q: np.ndarray) -> Any:
    point = make("geometry_msgs/msg/Point", *t)
    return make("geometry_msgs/msg/Pose", point, make("geometry_msgs/msg/Quaternion", *q))


def _pose_cov(t: np.ndarray, q: np.ndarray, covariance: np.ndarray) -> Any:
    return make("geometry_msgs/msg/PoseWithCovariance", _pose(t, q), covariance.ravel())


def _vector(v: np.ndarray) -> Any:
    return make("geometry_msgs/msg/Vector3", *v)


def _detection(d: cdr.Detection3D) -> Any:
    results = [
        make(
            "vision_msgs/msg/ObjectHypothesisWithPose",
            make("vision_msgs/msg/ObjectHypothesis", h.class_id, h.score),
            _pose_cov(h.t_cam_target_m, h.q_cam_target_xyzw, h.covariance),
        )
        for h in d.hypotheses
    ]
    box = make("vision_msgs/msg/BoundingBox3D", _pose(d.t_cam_box_m, d.q_cam_box_xyzw), _vector(d.size_m))
    return make("vision_msgs/msg/Detection3D", _header(d), results, box, d.id)


def _transform(t: cdr.TransformStamped) -> Any:
    rotation = make("geometry_msgs/msg/Quaternion", *t.q_frame_child_xyzw)
    transform = make("geometry_msgs/msg/Transform", _vector(t.t_frame_child_m), rotation)
    return make("geometry_msgs/msg/TransformStamped", _header(t), t.child_frame_id, transform)


def _status(s: cdr.DiagnosticStatus) -> Any:
    values = [make("diagnostic_msgs/msg/KeyValue", *pair) for pair in s.values]
    return make("diagnostic_msgs/msg/DiagnosticStatus", s.level, s.name, s.message, s.hardware_id, values)


def as_ros(m: cdr.Payload) -> Any:
    """The same message, built from rosbags' own classes."""
    match m:
        case cdr.PoseWithCovarianceStamped():
            pose = _pose_cov(m.t_cam_target_m, m.q_cam_target_xyzw, m.covariance)
            return make("geometry_msgs/msg/PoseWithCovarianceStamped", _header(m), pose)
        case cdr.Odometry():
            twist = make("geometry_msgs/msg/Twist", _vector(m.v_target_mps), _vector(m.omega_target_radps))
            twist_cov = make("geometry_msgs/msg/TwistWithCovariance", twist, m.covariance_twist.ravel())
            pose = _pose_cov(m.t_ned_target_m, m.q_ned_target_xyzw, m.covariance)
            return make("nav_msgs/msg/Odometry", _header(m), m.child_frame_id, pose, twist_cov)
        case cdr.Vector3Stamped():
            return make("geometry_msgs/msg/Vector3Stamped", _header(m), _vector(m.ray_cam))
        case cdr.Detection3DArray():
            return make("vision_msgs/msg/Detection3DArray", _header(m), [_detection(d) for d in m.detections])
        case cdr.TFMessage():
            return make("tf2_msgs/msg/TFMessage", [_transform(t) for t in m.transforms])
        case cdr.CameraInfo():
            roi = make("sensor_msgs/msg/RegionOfInterest", *dataclasses.astuple(m.roi))
            size, matrices = (m.height_px, m.width_px), (m.K.ravel(), m.R.ravel(), m.P.ravel())
            rest = (m.distortion_model, m.distortion, *matrices, m.binning_x, m.binning_y, roi)
            return make("sensor_msgs/msg/CameraInfo", _header(m), *size, *rest)
        case cdr.CompressedImage():
            data = np.frombuffer(m.data, np.uint8)
            return make("sensor_msgs/msg/CompressedImage", _header(m), m.format, data)
        case cdr.DiagnosticArray():
            return make("diagnostic_msgs/msg/DiagnosticArray", _header(m), [_status(s) for s in m.status])
        case cdr.Log():
            fields = (m.level, m.name, m.msg, m.file, m.function, m.line)
            return make("rcl_interfaces/msg/Log", _stamp(m.stamp_ns), *fields)


def same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return np.array_equal(a, b)
    if isinstance(a, tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    return a == b


@settings(max_examples=250, deadline=None)
@given(payloads)
def test_bytes_equal_rosbags_and_come_back_as_they_went(message: cdr.Payload) -> None:
    ros = as_ros(message)
    payload = message.encode()
    assert payload == serialize(ros)
    assert type(deserialize(payload, ros.__msgtype__)) is type(ros)
    assert same(cdr.DECODERS[ros.__msgtype__](payload), message)


@pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda t: t.name)
def test_type_hashes_are_those_of_the_interfaces(topic: topics.Topic) -> None:
    assert topic.type_hash == STORE.hash_rihs01(topic.ros_type)
    assert topic.ros_type in cdr.DECODERS


@settings(max_examples=400, deadline=None)
@given(st.sampled_from(sorted(cdr.DECODERS)), st.binary(max_size=500), st.booleans())
def test_junk_raises_nothing_but_payload_error(ros_type: str, junk: bytes, framed: bool) -> None:
    payload = b"\x00\x01\x00\x00" + junk if framed else junk
    with contextlib.suppress(PayloadError):
        cdr.DECODERS[ros_type](payload).encode()


@settings(max_examples=250, deadline=None)
@given(payloads, st.data())
def test_a_damaged_payload_is_refused_or_still_valid(message: cdr.Payload, data: st.DataObject) -> None:
    damaged = bytearray(message.encode())
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    damaged = damaged[: data.draw(st.integers(0, len(damaged)))]
    try:
        decoded = type(message).decode(bytes(damaged))
    except PayloadError:
        return
    assert same(type(message).decode(decoded.encode()), decoded)


@settings(max_examples=100, deadline=None)
@given(payloads, st.data())
def test_no_message_is_shorter_or_longer_than_what_it_holds(message: cdr.Payload, data: st.DataObject) -> None:
    payload = message.encode()
    with pytest.raises(PayloadError):
        type(message).decode(payload[: data.draw(st.integers(0, len(payload) - 1))])
    with pytest.raises(PayloadError) as caught:
        type(message).decode(payload + bytes(4))
    assert caught.value.reason is Refusal.TRAILING


POSE = cdr.PoseWithCovarianceStamped(
    1_700_000_000_123_456_789, "cam", np.array([1.0, -2.0, 300.0]), np.array([0.0, 0.0, 0.0, 1.0]), np.eye(6)
)


def _with(**changes: Any) -> bytes:
    return dataclasses.replace(POSE, **changes).encode()


def _covariance(*entries: tuple[int, int, float]) -> np.ndarray:
    matrix = np.eye(6)
    for row, column, value in entries:
        matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (_with(t_cam_target_m=np.array([1.0, np.nan, 2.0])), Refusal.NOT_FINITE),
        (_with(t_cam_target_m=np.array([1.0, 2.0, np.inf])), Refusal.NOT_FINITE),
        (_with(q_cam_target_xyzw=np.array([0.0, 0.0, 0.0, 1.01])), Refusal.QUATERNION),
        (_with(q_cam_target_xyzw=np.zeros(4)), Refusal.QUATERNION),
        (_with(q_cam_target_xyzw=np.full(4, 1e200)), Refusal.QUATERNION),
        (_with(covariance=_covariance((0, 0, -1.0))), Refusal.COVARIANCE),
        (_with(covariance=_covariance((0, 1, 0.5))), Refusal.COVARIANCE),
        (_with(covariance=_covariance((0, 1, 1.5), (1, 0, 1.5))), Refusal.COVARIANCE),
        (
            _with(covariance=_covariance(*[(i, j, -0.9) for i in range(3) for j in range(3) if i != j])),
            Refusal.COVARIANCE,
        ),
        (_with(covariance=_covariance((0, 0, 1e-300), (0, 1, 1e300), (1, 0, 1e300))), Refusal.COVARIANCE),
        (POSE.encode()[:-1], Refusal.TRUNCATED),
        (POSE.encode() + bytes(4), Refusal.TRAILING),
        (b"\x00\x00" + POSE.encode()[2:], Refusal.ENCAPSULATION),
        (b"", Refusal.ENCAPSULATION),
        (POSE.encode()[:12] + struct.pack("<I", 2**32 - 1) + POSE.encode()[16:], Refusal.LENGTH),
        (POSE.encode()[:8] + struct.pack("<I", 10**9) + POSE.encode()[12:], Refusal.STAMP),
        (POSE.encode().replace(b"cam\x00", b"camx"), Refusal.STRING),
        (POSE.encode().replace(b"cam\x00", b"c\xffm\x00"), Refusal.STRING),
    ],
)
def test_each_lie_has_its_reason(payload: bytes, reason: Refusal) -> None:
    with pytest.raises(PayloadError) as caught:
        cdr.PoseWithCovarianceStamped.decode(payload)
    assert caught.value.reason is reason


TURNED, NOT_TURNED = np.array([0.6, 0.0, 0.0, 0.8]), np.array([0.6, 0.0, 0.0, 0.9])
NO_COVARIANCE = _covariance((0, 1, 1.5), (1, 0, 1.5))
PLACE = np.array([1.0, 2.0, 3.0])


def _odometry(**changes: Any) -> cdr.Odometry:
    true = cdr.Odometry(1, "ned", "t0", PLACE, TURNED, np.eye(6), PLACE, PLACE, np.eye(6))
    return dataclasses.replace(true, **changes)


def _detections(**changes: Any) -> cdr.Detection3DArray:
    hypothesis = cdr.Hypothesis("aircraft", 0.9, PLACE, TURNED, np.eye(6))
    true = cdr.Detection3D(1, "cam", (hypothesis,), PLACE, TURNED, PLACE, "t0")
    return cdr.Detection3DArray(1, "cam", (dataclasses.replace(true, **changes),))


def _camera(**changes: Any) -> cdr.CameraInfo:
    matrices = np.eye(3), np.eye(3), np.eye(3, 4)
    return dataclasses.replace(cdr.CameraInfo(1, "cam", 1080, 1920, "plumb_bob", np.zeros(5), *matrices), **changes)


UNKNOWN = {"covariance": np.diag([1.0, 4.0, 9.0, 0.0, 0.0, 0.0]), "covariance_twist": np.zeros((6, 6))}


@pytest.mark.parametrize("true", [_odometry(), _odometry(**UNKNOWN), _detections(), _camera()])
def test_what_no_lie_was_put_into_is_taken(true: cdr.Payload) -> None:
    assert same(type(true).decode(true.encode()), true)


@pytest.mark.parametrize(
    ("lie", "reason"),
    [
        (_odometry(covariance_twist=NO_COVARIANCE), Refusal.COVARIANCE),
        (_odometry(covariance=NO_COVARIANCE), Refusal.COVARIANCE),
        (_odometry(v_target_mps=np.array([1.0, np.nan, 3.0])), Refusal.NOT_FINITE),
        (_detections(q_cam_box_xyzw=NOT_TURNED), Refusal.QUATERNION),
        (_detections(size_m=np.full(3, np.inf)), Refusal.NOT_FINITE),
        (cdr.TFMessage((cdr.TransformStamped(1, "ned", "base", PLACE, NOT_TURNED),)), Refusal.QUATERNION),
        (_camera(K=np.full((3, 3), np.nan)), Refusal.NOT_FINITE),
        (_camera(distortion=np.array([0.1, np.inf])), Refusal.NOT_FINITE),
        (_camera(roi=cdr.RegionOfInterest(do_rectify=2)), Refusal.BOOL),  # type: ignore[arg-type]
    ],
)
def test_a_lie_in_any_other_message_has_its_reason_too(lie: cdr.Payload, reason: Refusal) -> None:
    with pytest.raises(PayloadError) as caught:
        type(lie).decode(lie.encode())
    assert caught.value.reason is reason


def test_a_log_entry_of_no_time_is_refused() -> None:
    payload = cdr.Log(1, 20, "edge", "started").encode()
    with pytest.raises(PayloadError) as caught:
        cdr.Log.decode(payload[:8] + struct.pack("<I", 10**9) + payload[12:])
    assert caught.value.reason is Refusal.STAMP


def test_padding_to_four_bytes_is_no_lie() -> None:
    assert same(cdr.PoseWithCovarianceStamped.decode(POSE.encode() + bytes(3)), POSE)


@pytest.mark.parametrize(
    ("message", "at"),
    [
        (cdr.TFMessage((cdr.TransformStamped(1, "ned", "base", PLACE, TURNED),)), 4),
        (cdr.CompressedImage(1, "", "jpeg", b"data"), 32),
        (dataclasses.replace(_camera(distortion=np.array([0.1])), distortion_model="", frame_id=""), 36),
        (cdr.DiagnosticArray(1, "", (cdr.DiagnosticStatus(0, "", "", "", ()),)), 20),
        (dataclasses.replace(_detections(), frame_id=""), 20),
    ],
    ids=lambda value: type(value).__name__,
)
def test_a_sequence_that_claims_more_than_there_is_room_for_is_refused_before_it_is_read(
    message: cdr.Payload, at: int
) -> None:
    payload = message.encode()
    (count,) = struct.unpack_from("<I", payload, at)
    for claimed in (count + len(payload), 2**32 - 1):
        with pytest.raises(PayloadError) as caught:
            type(message).decode(payload[:at] + struct.pack("<I", claimed) + payload[at + 4 :])
        assert caught.value.reason is Refusal.LENGTH


def test_whole_numbers_and_single_precision_are_sent_as_doubles() -> None:
    whole, single = np.array([1, -2, 300]), np.array([0.1, 2.5, 300.0], np.float32)
    for vector in (whole, single, [1, -2, 300]):
        message = _with(t_cam_target_m=vector)
        assert message == _with(t_cam_target_m=np.asarray(vector, np.float64))
        np.testing.assert_array_equal(cdr.PoseWithCovarianceStamped.decode(message).t_cam_target_m, vector)
    assert _camera(distortion=[0, 1]).encode() == _camera(distortion=np.array([0.0, 1.0])).encode()


def test_a_misshapen_array_is_never_sent() -> None:
    with pytest.raises(ValueError, match="shape"):
        _with(covariance=np.eye(3))
