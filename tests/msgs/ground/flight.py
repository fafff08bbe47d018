"""A made-up flight as a recording holds it: an own ship that flies north and a target that circles ahead of it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from msgs import cdr, topics
from msgs.mcap_file import McapFile
from msgs.topics import Topic

UAV = "uav1"
START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000
LATE_NS = 12_000_000  # from exposure to being recorded
SIZE_WH = (1920, 1080)
K = np.array([[2600.0, 0.0, 959.5], [0.0, 2600.0, 539.5], [0.0, 0.0, 1.0]])
R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
T_BODY_CAM_M = np.array([3.0, -1.0, 0.5])

Sample = tuple[Topic, str | None, bytes, int]


def stamps_ns(frames: int) -> list[int]:
    return [START_NS + number * PERIOD_NS for number in range(frames)]


def attitude(stamp_ns: int) -> Rotation:
    """R_ned_body of the own ship, which rocks a little."""
    t_s = (stamp_ns - START_NS) * 1e-9
    return Rotation.from_euler("ZYX", [0.05 * np.sin(0.4 * t_s), 0.03 * np.cos(0.3 * t_s), 0.1 * np.sin(0.5 * t_s)])


def places_m(stamp_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Own ship and target in ned."""
    t_s = (stamp_ns - START_NS) * 1e-9
    own_m = np.array([20.0 * t_s, 0.0, -120.0])
    circle = np.array([40.0 * np.cos(0.3 * t_s), 25.0 * np.sin(0.3 * t_s), -10.0 * np.sin(0.2 * t_s)])
    return own_m, own_m + np.array([240.0, 0.0, 0.0]) + circle


def target_attitude(stamp_ns: int) -> Rotation:
    t_s = (stamp_ns - START_NS) * 1e-9
    return Rotation.from_euler("ZYX", [1.2 + 0.3 * t_s, 0.05, 0.4])


def samples(frames: int) -> Iterator[Sample]:
    """Topic, target, payload and time of recording (UTC ns), as a vehicle puts them."""
    first_ns = START_NS + LATE_NS
    info = cdr.CameraInfo(
        START_NS, topics.FRAME_CAMERA, SIZE_WH[1], SIZE_WH[0], "plumb_bob", np.zeros(5), K, np.eye(3),
        np.hstack([K, np.zeros((3, 1))]),
    )  # fmt: skip
    yield topics.CAMERA_INFO, None, info.encode(), first_ns
    yield topics.EVENTS, None, cdr.Log(START_NS, 20, topics.NODE_NAME, "tracking t0").encode(), first_ns
    for number, stamp_ns in enumerate(stamps_ns(frames)):
        log_ns = stamp_ns + LATE_NS
        yield from frame(stamp_ns, log_ns)
        if number % 10 == 0:
            yield topics.DIAGNOSTICS, None, health(stamp_ns).encode(), log_ns
            yield topics.IMAGE, None, picture(stamp_ns).encode(), log_ns


def frame(stamp_ns: int, log_ns: int) -> Iterator[Sample]:
    own_m, target_m = places_m(stamp_ns)
    R_ned_cam = attitude(stamp_ns).as_matrix() @ R_BODY_CAM
    t_cam_m = R_ned_cam.T @ (target_m - own_m - attitude(stamp_ns).apply(T_BODY_CAM_M))
    q_xyzw = Rotation.from_matrix(R_ned_cam.T @ target_attitude(stamp_ns).as_matrix()).as_quat()
    away = t_cam_m / np.linalg.norm(t_cam_m)
    covariance = np.diag([0.2, 0.2, 0.2, 0.02, 0.02, 0.02])
    covariance[:3, :3] += 15.0**2 * np.outer(away, away)
    pose = cdr.PoseWithCovarianceStamped(stamp_ns, topics.FRAME_CAMERA, t_cam_m, q_xyzw, covariance)
    yield topics.POSE, "t0", pose.encode(), log_ns
    hypothesis = cdr.Hypothesis("fixed_wing", 0.9, t_cam_m, q_xyzw, covariance)
    found = cdr.Detection3D(stamp_ns, topics.FRAME_CAMERA, (hypothesis,), t_cam_m, q_xyzw, np.zeros(3), "t0")
    yield topics.DETECTIONS, None, cdr.Detection3DArray(stamp_ns, topics.FRAME_CAMERA, (found,)).encode(), log_ns
    upright, q_body = np.array([0.0, 0.0, 0.0, 1.0]), attitude(stamp_ns).as_quat()
    chain = (
        cdr.TransformStamped(stamp_ns, topics.FRAME_NED, topics.FRAME_BODY_NED, own_m, upright),
        cdr.TransformStamped(stamp_ns, topics.FRAME_BODY_NED, topics.FRAME_BODY, np.zeros(3), q_body),
        cdr.TransformStamped(
            stamp_ns, topics.FRAME_BODY, topics.FRAME_CAMERA, T_BODY_CAM_M, Rotation.from_matrix(R_BODY_CAM).as_quat()
        ),
    )
    yield topics.TF, None, cdr.TFMessage(chain).encode(), log_ns


def health(stamp_ns: int) -> cdr.DiagnosticArray:
    latencies = tuple(
        (f"latency_ms/{stage}/{name}", f"{value:.1f}")
        for stage, values in (("inference", (6.0, 8.0, 9.5)), ("total", (10.8, 16.2, 34.9)))
        for name, value in zip(("p50", "p95", "p99"), values, strict=True)
    )
    values = (("tracks", "1"), ("frame_rate_hz", "10.0"), ("dropped", "0"), *latencies)
    return cdr.DiagnosticArray(stamp_ns, "", (cdr.DiagnosticStatus(0, topics.NODE_NAME, "tracking", UAV, values),))


def picture(stamp_ns: int) -> cdr.CompressedImage:
    """Sky over ground, at the camera's size."""
    image = np.full((SIZE_WH[1], SIZE_WH[0], 3), (210, 180, 150), np.uint8)
    image[700:] = (90, 120, 100)
    done, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 40])
    assert done
    return cdr.CompressedImage(stamp_ns, topics.FRAME_CAMERA, "jpeg", data.tobytes())


def record(path: Path, frames: int) -> None:
    """The flight as a recorder writes it, and the pictures that a recorder leaves out."""
    file = McapFile(path)
    for topic, target, payload, log_ns in samples(frames):
        file.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, log_ns, log_ns)
    file.close()
