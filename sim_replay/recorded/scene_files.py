"""The files of a scene without ground truth: images, their camera, rate, mount and telemetry."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.cameras.sequence import SOURCE_KEY
from edge.types import Array, Mount
from msgs.settings import toml_value
from sim_replay.bop import Distortion
from sim_replay.bop.records import BopFrame
from sim_replay.bop.write import SceneWriter

JPEG_QUALITY = 95


def add_picture(
    writer: SceneWriter,
    index: int,
    image_bgr: NDArray[np.uint8],
    K: Array,
    distortion: tuple[float, ...],
) -> None:
    """Write one image [H, W, 3] of a lens with 0, 4, 5 or 8 plumb-bob coefficients.

    Scenes support five: an image of a lens with eight is undistorted.
    """
    if len(distortion) > 5:
        image_bgr = np.asarray(cv2.undistort(image_bgr, K, np.array(distortion)), dtype=np.uint8)
    writer.add(BopFrame(index, K, distortion=scene_distortion(distortion)), image_bgr)


def scene_distortion(distortion: tuple[float, ...]) -> Distortion | None:
    """The distortion that the reader of the scene must still correct."""
    if len(distortion) > 5 or not any(distortion):
        return None
    k1, k2, p1, p2, k3 = (*distortion, *(0.0,) * (5 - len(distortion)))
    return k1, k2, p1, p2, k3


def write_sequence_toml(
    folder: Path,
    source: Path,
    fps: float,
    frame0_ns: int,
    mount: Mount,
    gimballed: bool,
    camera: Mapping[str, object] | None = None,
) -> None:
    """Write sequence.toml of a finished scene without labels; `source` is where the images are from, `camera` has
    further keys."""
    entries = {
        SOURCE_KEY: str(source),
        "fps": fps,
        "t0_ns": frame0_ns,
        "R_body_cam": mount.R_body_cam.tolist(),
        "t_body_cam_m": mount.t_body_cam_m.tolist(),
        "mount": "gimbal" if gimballed else "fixed",
        **(camera or {}),
    }
    lines = [f"{key} = {toml_value(value)}\n" for key, value in entries.items()]
    (folder / "sequence.toml").write_text("".join(lines), encoding="utf-8")
    for name in ("scene_gt.json", "scene_gt_info.json"):  # empty lists would say that there is no target
        (folder / name).unlink(missing_ok=True)


def is_unpacked(folder: Path) -> bool:
    """Whether `folder` is a scene that was unpacked here, can be unpacked again, and has been given no labels since."""
    try:
        entries = tomllib.loads((folder / "sequence.toml").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return SOURCE_KEY in entries and not (folder / "scene_gt.json").exists()
