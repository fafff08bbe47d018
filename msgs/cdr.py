"""The nine ROS 2 interfaces of the topic table: frozen payloads, `encode` and `decode`.

Stamps are UTC nanoseconds of the exposure. Quaternions are Hamilton, xyzw as ROS writes them. Covariances are
6×6 over (x, y, z, rot x, rot y, rot z). `decode` trusts nothing and raises PayloadError; `encode` raises
struct.error, OverflowError or ValueError if a value does not fit its field or an array has the wrong shape.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from numpy.typing import ArrayLike

from msgs.wire import Array, Reader, Writer


@dataclass(frozen=True, eq=False)
class PoseWithCovarianceStamped:
    """geometry_msgs/msg/PoseWithCovarianceStamped: the target in `cam`."""

    stamp_ns: int
    frame_id: str
    t_cam_target_m: Array  # [3]
    q_cam_target_xyzw: Array  # [4]
    covariance: Array  # [6, 6] in cam

    def encode(self) -> bytes:
        out = Writer()
        out.header(self.stamp_ns, self.frame_id)
        _put_pose(out, self.t_cam_target_m, self.q_cam_target_xyzw, self.covariance)
        return out.done()

    @classmethod
    def decode(cls, payload: bytes) -> PoseWithCovarianceStamped:
        data = Reader(payload)
        message = cls(*data.header(), *data.pose())
        data.done()
        return message


@dataclass(frozen=True, eq=False)
class Odometry:
    """nav_msgs/msg/Odometry: the target in `ned`; the twist is expressed in the child frame, as ROS defines it."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    t_ned_target_m: Array  # [3]
    q_ned_target_xyzw: Array  # [4]
    covariance: Array  # [6, 6] in ned
    v_target_mps: Array  # [3], in the target's own axes
    omega_target_radps: Array  # [3], in the target's own axes
    covariance_twist: Array  # [6, 6]

    def encode(self) -> bytes:
        out = Writer()
        out.header(self.stamp_ns, self.frame_id)
        out.string(self.child_frame_id)
        _put_pose(out, self.t_ned_target_m, self.q_ned_target_xyzw, self.covariance)
        out.f64(self.v_target_mps, 3)
        out.f64(self.omega_target_radps, 3)
        out.f64(self.covariance_twist, 6, 6)
        return out.done()

    @classmethod
    def decode(cls, payload: bytes) -> Odometry:
        data = Reader(payload)
        stamp_ns, frame_id = data.header()
        child_frame_id = data.string()
        message = cls(stamp_ns, frame_id, child_frame_id, *data.pose(), data.f64(3), data.f64(3), data.covariance())
        data.done()
        return message


@dataclass(frozen=True, eq=False)
class Vector3Stamped:
    """geometry_msgs/msg/Vector3Stamped: the direction of a target in `cam`, of unit length."""

    stamp_ns: int
    frame_id: str
    ray_cam: Array  # [3]

    def encode(self) -> bytes:
        out = Writer()
        out.header(self.stamp_ns, self.frame_id)
        out.f64(self.ray_cam, 3)
        return out.done()

    @classmethod
    def decode(cls, payload: bytes) -> Vector3Stamped:
        data = Reader(payload)
        message = cls(*data.header(), data.f64(3))
        data.done()
        return message


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """vision_msgs/msg/ObjectHypothesisWithPose."""

    class_id: str
    score: float
    t_cam_target_m: Array  # [3]
    q_cam_target_xyzw: Array  # [4]
    covariance: Array  # [6, 6] in cam


@dataclass(frozen=True, eq=False)
class Detection3D:
    """vision_msgs/msg/Detection3D. The box is zero-sized where the target's extent is not known."""

    stamp_ns: int
    frame_id: str
    hypotheses: tuple[Hypothesis, ...]
    t_cam_box_m: Array  # [3]
    q_cam_box_xyzw: Array  # [4]
    size_m: Array  # [3]
    id: str


@dataclass(frozen=True, eq=False)
class Detection3DArray:
    """vision_msgs/msg/Detection3DArray: every target of one frame."""

    stamp_ns: int
    frame_id: str
    detections: tuple[Detection3D, ...]

    def encode(self) -> bytes:
        out = Writer()
        out.header(self.stamp_ns, self.frame_id)
        out.u32(len(self.detections))
        for detection in self.detections:
            out.header(detection.stamp_ns, detection.frame_id)
            out.u32(len(detection.hypotheses))
            for one in detection.hypotheses:
                out.string(one.class_id)
                out.f64(one.score)
                _put_pose(out, one.t_cam_target_m, one.q_cam_target_xyzw, one.covariance)
            out.f64(detection.t_cam_box_m, 3)
            out.f64(detection.q_cam_box_xyzw, 4)
            out.f64(detection.size_m, 3)
            out.string(detection.id)
        return out.done()

    @classmethod
    def decode(cls, payload: bytes) -> Detection3DArray:
        data = Reader(payload)
        stamp_ns, frame_id = data.header()
        # The smallest detection: header 13, empty sequence 4, box 80, empty string 5 bytes.
        detections = tuple(_take_detection(data) for _ in range(data.length(102)))
        data.done()
        return cls(stamp_ns, frame_id, detections)


@dataclass(frozen=True, eq=False)
class TransformStamped:
    """geometry_msgs/msg/TransformStamped: the child's origin and axes in the frame."""

    stamp_ns: int
    frame_id: str
    child_frame_id: str
    t_frame_child_m: Array  # [3]
    q_frame_child_xyzw: Array  # [4]


@dataclass(frozen=True, eq=False)
class TFMessage:
    """tf2_msgs/msg/TFMessage."""

    transforms: tuple[TransformStamped, ...]

    def encode(self) -> bytes:
        out = Writer()
        out.u32(len(self.transforms))
        for one in self.transforms:
            out.header(one.stamp_ns, one.frame_id)
            out.string(one.child_frame_id)
            out.f64(one.t_frame_child_m, 3)
            out.f64(one.q_frame_child_xyzw, 4)
        return out.done()

    @classmethod
    def decode(cls, payload: bytes) -> TFMessage:
        data = Reader(payload)
        # The smallest transform: header 13, empty string 5, translation and rotation 56 bytes.
        transforms = tuple(
            TransformStamped(*data.header(), data.string(), data.f64(3), data.quaternion())
            for _ in range(data.length(74))
        )
        data.done()
        return cls(transforms)


@dataclass(frozen=True)
class RegionOfInterest:
    """sensor_msgs/msg/RegionOfInterest; all zeros: the whole image."""

    x_offset_px: int = 0
    y_offset_px: int = 0
    height_px: int = 0
    width_px: int = 0
    do_rectify: bool = False


@dataclass(frozen=True, eq=False)
class CameraInfo:
    """sensor_msgs/msg/CameraInfo; pixel centres lie at integer coordinates."""

    stamp_ns: int
    frame_id: str
    height_px: int
    width_px: int
    distortion_model: str
    distortion: Array  # [n], in the model's order
    K: Array  # [3, 3]
    R: Array  # [3, 3], rectification
    P: Array  # [3, 4], projection
    binning_x: int = 0
    binning_y: int = 0
    roi: RegionOfInterest = field(default_factory=RegionOfInterest)

    def encode(self) -> bytes:
        out = Writer()
        out.header(self.stamp_ns, self.frame_id)
        out.u32(self.height_px, self.width_px)
        out.string(self.distortion_model)
        out.f64_sequence(self.distortion)
        out.f64(self.K, 3, 3)
        out.f64(self.R, 3, 3)
        out.f64(self.P, 3, 4)
        roi = self.roi
        out.u32(self.binning_x, self.binning_y, roi.x_offset_px, roi.y_offset_px, roi.height_px, roi.width_px)
        out.u8(roi.do_rectify)
        return out.done()

    @classmethod
    def decode(cls, payload: bytes) -> CameraInfo:
        data = Reader(payload)
        stamp_ns, frame_id = data.header()
        height_px, width_px = data.u32(), data.u32()
        distortion = data.string(), data.f64_sequence()
        matrices = data.f64(9).reshape(3, 3), data.f64(9).reshape(3, 3), data.f64(12).reshape(3, 4)
        binning = data.u32(), data.u32()
        roi = RegionOfInterest(data.u32(), data.u32(), data.u32(), data.u32(), data.boolean())
        data.done()
        return cls(stamp_ns, frame_id, height_px, width_px, *distortion, *matrices, *binning, roi)


@dataclass(frozen=True)
class CompressedImage:
    """sensor_msgs/msg/CompressedImage; `format` is `jpeg` or `png`."""

    stamp_ns: int
    frame_id: str
    format: str
    data: bytes

    def encode(self) -> bytes:
        out = Writer()
        out.header(self.stamp_ns, self.frame_id)
        out.string(self.format)
        out.bytes_sequence(self.data)
        return out.done()

    @classmethod
    def decode(cls, payload: bytes) -> CompressedImage:
        data = Reader(payload)
        message = cls(*data.header(), data.string(), data.bytes_sequence())
        data.done()
        return message


@dataclass(frozen=True)
class DiagnosticStatus:
    """diagnostic_msgs/msg/DiagnosticStatus; level 0 ok, 1 warn, 2 error, 3 stale."""

    level: int
    name: str
    message: str
    hardware_id: str
    values: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class DiagnosticArray:
    """diagnostic_msgs/msg/DiagnosticArray."""

    stamp_ns: int
    frame_id: str
    status: tuple[DiagnosticStatus, ...]

    def encode(self) -> bytes:
        out = Writer()
        out.header(self.stamp_ns, self.frame_id)
        out.u32(len(self.status))
        for one in self.status:
            out.u8(one.level)
            out.string(one.name)
            out.string(one.message)
            out.string(one.hardware_id)
            out.u32(len(one.values))
            for key, value in one.values:
                out.string(key)
                out.string(value)
        return out.done()

    @classmethod
    def decode(cls, payload: bytes) -> DiagnosticArray:
        data = Reader(payload)
        stamp_ns, frame_id = data.header()
        # The smallest status: level 1, three empty strings 15, empty sequence 4 bytes.
        status = tuple(
            DiagnosticStatus(
                data.u8(),
                data.string(),
                data.string(),
                data.string(),
                tuple((data.string(), data.string()) for _ in range(data.length(10))),
            )
            for _ in range(data.length(20))
        )
        data.done()
        return cls(stamp_ns, frame_id, status)


@dataclass(frozen=True)
class Log:
    """rcl_interfaces/msg/Log; level 10 debug, 20 info, 30 warn, 40 error, 50 fatal."""

    stamp_ns: int
    level: int
    name: str
    msg: str
    file: str = ""
    function: str = ""
    line: int = 0

    def encode(self) -> bytes:
        out = Writer()
        out.stamp(self.stamp_ns)
        out.u8(self.level)
        for text in (self.name, self.msg, self.file, self.function):
            out.string(text)
        out.u32(self.line)
        return out.done()

    @classmethod
    def decode(cls, payload: bytes) -> Log:
        data = Reader(payload)
        stamp_ns, level = data.stamp(), data.u8()
        message = cls(stamp_ns, level, data.string(), data.string(), data.string(), data.string(), data.u32())
        data.done()
        return message


Payload = (
    PoseWithCovarianceStamped
    | Odometry
    | Vector3Stamped
    | Detection3DArray
    | TFMessage
    | CameraInfo
    | CompressedImage
    | DiagnosticArray
    | Log
)

DECODERS: dict[str, Callable[[bytes], Payload]] = {
    "geometry_msgs/msg/PoseWithCovarianceStamped": PoseWithCovarianceStamped.decode,
    "nav_msgs/msg/Odometry": Odometry.decode,
    "geometry_msgs/msg/Vector3Stamped": Vector3Stamped.decode,
    "vision_msgs/msg/Detection3DArray": Detection3DArray.decode,
    "tf2_msgs/msg/TFMessage": TFMessage.decode,
    "sensor_msgs/msg/CameraInfo": CameraInfo.decode,
    "sensor_msgs/msg/CompressedImage": CompressedImage.decode,
    "diagnostic_msgs/msg/DiagnosticArray": DiagnosticArray.decode,
    "rcl_interfaces/msg/Log": Log.decode,
}


def _put_pose(out: Writer, t_m: ArrayLike, q_xyzw: ArrayLike, covariance: ArrayLike) -> None:
    out.f64(t_m, 3)
    out.f64(q_xyzw, 4)
    out.f64(covariance, 6, 6)


def _take_detection(data: Reader) -> Detection3D:
    stamp_ns, frame_id = data.header()
    # The smallest hypothesis: empty string 5, score 8, pose 56, covariance 288 bytes.
    hypotheses = tuple(Hypothesis(data.string(), float(data.f64(1)[0]), *data.pose()) for _ in range(data.length(357)))
    box = data.f64(3), data.quaternion(), data.f64(3)
    return Detection3D(stamp_ns, frame_id, hypotheses, *box, data.string())
