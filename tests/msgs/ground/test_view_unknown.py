"""`uavpose-ground view` of targets whose attitude or range is not known."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from msgs import cdr, topics
from msgs.ground.cli import main
from msgs.mcap_file import McapFile

from .flight import PERIOD_NS, START_NS, T_BODY_CAM_M, UAV, attitude, places_m, samples, stamps_ns
from .test_view import clears, component, rows, text


def rotation_unknown(payload: bytes) -> bytes:
    """The same pose, as the daemon tells it where it does not know how the target is turned."""
    pose = cdr.PoseWithCovarianceStamped.decode(payload)
    covariance = np.diag([0.0, 0.0, 0.0, 1e6, 1e6, 1e6])
    covariance[:3, :3] = pose.covariance[:3, :3]
    upright = np.array([0.0, 0.0, 0.0, 1.0])
    return dataclasses.replace(pose, q_cam_target_xyzw=upright, covariance=covariance).encode()


def test_of_a_target_whose_rotation_is_not_known_the_place_alone_is_drawn(tmp_path: Path) -> None:
    """Known for ten frames, not for ten, and then again: what was drawn of it does not stay meanwhile."""
    file = McapFile(tmp_path / "turned.mcap")
    for topic, target, payload, log_ns in samples(30):
        unknown = topic is topics.POSE and 10 <= (log_ns - START_NS) // PERIOD_NS < 20
        told = rotation_unknown(payload) if unknown else payload
        file.write(topics.topic_name(topic, UAV, target), topic.ros_type, told, log_ns, log_ns)
    file.close()
    path = tmp_path / "turned.rrd"
    assert main(["view", str(tmp_path / "turned.mcap"), "--save", str(path)]) == 0
    place = [
        "ned/target/t0/place", "ned/target/t0/sigma", "ned/target/t0/line_of_sight", "ned/trail/targets",
        "ned/camera/target/t0/sigma", "ned/camera/target/t0/label", "map/target/t0/place", "map/target/t0/sigma",
        "zoom/target/t0/label", "plots/range/t0",
    ]  # fmt: skip
    turned = [
        "ned/target/t0/body", "ned/camera/target/t0/box", "ned/camera/target/t0/range_sigma", "map/target/t0/heading",
        "zoom/target/t0/box", "zoom/target/t0/axes", "plots/attitude/t0/roll", "plots/attitude/t0/heading",
    ]  # fmt: skip
    stamps = stamps_ns(30)
    for entity in place:
        assert [stamp_ns for stamp_ns, row in rows(path, entity) if not clears(row)] == stamps, entity
    for entity in turned:
        assert [stamp_ns for stamp_ns, row in rows(path, entity) if not clears(row)] == stamps[:10] + stamps[20:], (
            entity
        )
        assert stamps[10] in [stamp_ns for stamp_ns, row in rows(path, entity) if clears(row)], entity
    labels = [text(row, "labels") for _, row in rows(path, "zoom/target/t0/label")]
    assert labels == ["t0  ±8°"] * 10 + ["t0  ±?°"] * 10 + ["t0  ±8°"] * 10


def test_of_a_target_whose_range_is_not_known_the_line_of_sight_alone_is_drawn(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Known for ten frames, not for ten, and then again."""
    file = McapFile(tmp_path / "direction.mcap")
    for topic, target, payload, log_ns in samples(30):
        if topic is topics.POSE and 10 <= (log_ns - START_NS) // PERIOD_NS < 20:
            pose = cdr.PoseWithCovarianceStamped.decode(payload)
            ray = pose.t_cam_target_m / np.linalg.norm(pose.t_cam_target_m)
            topic, payload = topics.DIRECTION, cdr.Vector3Stamped(pose.stamp_ns, pose.frame_id, ray).encode()
        file.write(topics.topic_name(topic, UAV, target), topic.ros_type, payload, log_ns, log_ns)
    file.close()
    path = tmp_path / "direction.rrd"
    assert main(["view", str(tmp_path / "direction.mcap"), "--save", str(path)]) == 0
    assert capsys.readouterr().err.splitlines()[-1] == f"20 poses and 10 directions drawn into {path}"
    stamps = stamps_ns(30)
    for entity in ("ned/target/t0/place", "ned/target/t0/body", "ned/camera/target/t0/box", "map/target/t0/place"):
        drawn = [stamp_ns for stamp_ns, row in rows(path, entity) if not clears(row)]
        assert drawn == stamps[:10] + stamps[20:], entity
    emptied = ("ned/target/t0", "ned/camera/target/t0", "map/target/t0", "plots/range/t0", "plots/latency/t0")
    for where in emptied:
        assert [stamp_ns for stamp_ns, row in rows(path, where) if clears(row)] == [stamps[10], stamps[20]], where
    for entity in ("map/target/t0/line_of_sight", "ned/camera/target/t0/direction"):
        assert [stamp_ns for stamp_ns, row in rows(path, entity) if not clears(row)] == stamps[10:20], entity
    labels = [text(row, "labels") for _, row in rows(path, "ned/camera/target/t0/label") if not clears(row)]
    assert labels[10:20] == ["t0  range ?"] * 10
    stamp_ns, row = next(one for one in rows(path, "ned/target/t0/line_of_sight") if one[0] == stamps[10])
    own_m, target_m = places_m(stamp_ns)
    camera_m = own_m + attitude(stamp_ns).apply(T_BODY_CAM_M)
    start, end = component(row, "strips").reshape(2, 3)
    towards = (target_m - camera_m) / np.linalg.norm(target_m - camera_m)
    np.testing.assert_allclose(start, camera_m, atol=1e-3)
    np.testing.assert_allclose((end - start) / np.linalg.norm(end - start), towards, atol=1e-5)
