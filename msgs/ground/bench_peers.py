"""The same pose in other codecs: rosbags and pycdr2 write the same CDR, protobuf its own format with the same fields.

pycdr2 evaluates annotations, so this module must not turn them into strings.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.util import find_spec

from msgs import topics
from msgs.cdr import PoseWithCovarianceStamped

_NS = 1_000_000_000


@dataclass(frozen=True)
class Codec:
    """`encode` returns one pose as bytes, `decode` parses them."""

    name: str
    encode: Callable[[], bytes]
    decode: Callable[[], object]


def installed(message: PoseWithCovarianceStamped) -> Iterator[Codec]:
    """The installed codecs, each with this pose."""
    for package, make in (("rosbags", rosbags), ("pycdr2", pycdr2), ("google.protobuf", protobuf)):
        if find_spec(package.partition(".")[0]) is not None and find_spec(package) is not None:
            yield make(message)


def rosbags(message: PoseWithCovarianceStamped) -> Codec:
    from rosbags.typesys import Stores, get_typestore

    store, ros_type, payload = get_typestore(Stores.ROS2_JAZZY), topics.POSE.ros_type, message.encode()
    theirs = store.deserialize_cdr(payload, ros_type)
    return Codec(
        "rosbags",
        lambda: bytes(store.serialize_cdr(theirs, ros_type)),
        lambda: store.deserialize_cdr(payload, ros_type),
    )


def pycdr2(message: PoseWithCovarianceStamped) -> Codec:
    from pycdr2 import IdlStruct
    from pycdr2.types import array, float64, int32, uint32

    @dataclass
    class Time(IdlStruct):
        sec: int32
        nanosec: uint32

    @dataclass
    class Header(IdlStruct):
        stamp: Time
        frame_id: str

    @dataclass
    class Point(IdlStruct):
        x: float64
        y: float64
        z: float64

    @dataclass
    class Quaternion(IdlStruct):
        x: float64
        y: float64
        z: float64
        w: float64

    @dataclass
    class Pose(IdlStruct):
        position: Point
        orientation: Quaternion

    @dataclass
    class PoseWithCovariance(IdlStruct):
        pose: Pose
        covariance: array[float64, 36]  # type: ignore[type-arg, valid-type]

    @dataclass
    class Stamped(IdlStruct):
        header: Header
        pose: PoseWithCovariance

    sec, nanosec = divmod(message.stamp_ns, _NS)
    pose = Pose(Point(*map(float, message.t_cam_target_m)), Quaternion(*map(float, message.q_cam_target_xyzw)))
    covariance = [float(value) for value in message.covariance.ravel()]
    theirs = Stamped(Header(Time(sec, nanosec), message.frame_id), PoseWithCovariance(pose, covariance))  # type: ignore[arg-type]
    payload = theirs.serialize()
    return Codec("pycdr2", theirs.serialize, lambda: Stamped.deserialize(payload))


def protobuf(message: PoseWithCovarianceStamped) -> Codec:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory  # type: ignore[import-untyped]

    kind = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="uavpose/pose.proto", package="uavpose", syntax="proto3")
    schema = file.message_type.add(name="Pose")
    single, several = kind.LABEL_OPTIONAL, kind.LABEL_REPEATED
    schema.field.add(name="stamp_ns", number=1, type=kind.TYPE_INT64, label=single)
    schema.field.add(name="frame_id", number=2, type=kind.TYPE_STRING, label=single)
    for number, name in enumerate(("position", "orientation", "covariance"), start=3):
        schema.field.add(name=name, number=number, type=kind.TYPE_DOUBLE, label=several)
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    Pose = message_factory.GetMessageClass(pool.FindMessageTypeByName("uavpose.Pose"))
    theirs = Pose(
        stamp_ns=message.stamp_ns,
        frame_id=message.frame_id,
        position=message.t_cam_target_m,
        orientation=message.q_cam_target_xyzw,
        covariance=message.covariance.ravel(),
    )
    payload = theirs.SerializeToString()
    return Codec("protobuf", theirs.SerializeToString, lambda: Pose.FromString(payload))
