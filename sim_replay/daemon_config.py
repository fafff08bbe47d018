"""The configuration of a daemon that plays a sequence: loopback only, the camera mounted as in the sequence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from edge.estimator.given_size import TargetSize
from msgs.settings import toml_value
from sim_replay.ground_truth import PlayedSequence
from sim_replay.ports import LOOPBACK

UAV = "uav1"
EVERY_IMAGE_HZ = 240.0  # the largest; at the sequence's own rate, an exposure rounded down to a nanosecond is too early


def sequence_config(
    sequence: PlayedSequence,
    model: Path | None,
    zenoh_endpoint: str,
    mavlink_port: int,
    camera: Mapping[str, object],
    recordings: Path | None = None,
    *,
    to_px4: bool = False,
    target_size: TargetSize | None = None,
) -> str:
    """The text of its TOML file.

    Args:
        model: ONNX file; None: the daemon's default.
        camera: Further keys of [camera]: when, how often or under whose control the sequence is played.
        recordings: Folder for the daemon's own recordings, including images; None: no recordings.
        to_px4: Also send TARGET_RELATIVE to PX4, which takes it for a landing target.
        target_size: Of the aircraft to be seen; None: not given.
    """
    tables: dict[str, dict[str, object]] = {
        "vehicle": {"name": UAV},
        "camera": {
            "type": "sequence",
            "mount": sequence.camera_mount,
            "path": str(sequence.scene.folder.resolve()),
            "fps": sequence.fps,
            "readout_ms": sequence.readout_ms,
            **camera,
        },
        "mount": {
            "R_body_cam": sequence.mount.R_body_cam.tolist(),
            "t_body_cam_m": sequence.mount.t_body_cam_m.tolist(),
        },
        "model": {} if model is None else {"path": str(model.resolve())},
        "zenoh": {"listen": [zenoh_endpoint]},
        "mavlink": {"endpoints": [f"udpin:{LOOPBACK}:{mavlink_port}"]},
    }
    if sequence.own_ship_mask is not None:
        tables["camera"]["own_ship_mask"] = str(sequence.own_ship_mask.resolve())
    if to_px4:
        tables["mavlink"]["target_relative_to_px4"] = True
    if target_size is not None:
        tables["target"] = asdict(target_size)
    if recordings is not None:
        recorder = {"enabled": True, "folder": str(recordings.resolve()), "image_max_hz": EVERY_IMAGE_HZ}
        tables["recorder"] = {**recorder, "free_min_mb": 0.0}
    lines = []
    for name, table in tables.items():
        lines += [f"[{name}]", *(f"{key} = {toml_value(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"
