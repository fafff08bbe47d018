"""model_frame.toml: orientation of a dataset's model axes in the target's body frame (FRD), for all objects or each.

R_body_model = [[1, 0, 0], [0, -1, 0], [0, 0, -1]]   # this one: models drawn nose x, left wing y, up z
t_body_model_m = [0.0, 0.0, 0.0]                     # optional: the models' origin, in body

[objects.2]                                          # optional: object 2 differs
R_body_model = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]
diameter_m = 12.0                                    # optional: for datasets without models
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from msgs.settings import read_toml
from sim_replay.bop.fields import is_rotation
from sim_replay.bop.records import Array, BopError, BopTarget

MODEL_FRAME_FILE = "model_frame.toml"
_KEYS = ("R_body_model", "t_body_model_m", "diameter_m")


@dataclass(frozen=True, eq=False)
class ModelFrame:
    """Pose of a model file's axes in body (FRD): x_body = R_body_model x_model + t_body_model_m."""

    R_body_model: Array = field(default_factory=lambda: np.eye(3))  # [3, 3]
    t_body_model_m: Array = field(default_factory=lambda: np.zeros(3))  # [3]
    diameter_m: float | None = None

    def points_in_body(self, points_model_m: Array) -> Array:
        """Points [N, 3] of the model file, metres, converted to body axes."""
        return points_model_m @ self.R_body_model.T + self.t_body_model_m

    def pose_of_body(self, R_cam_model: Array, t_cam_model_m: Array) -> tuple[Array, Array]:
        """R_cam_body [3, 3] and t_cam_body_m [3] of a model at the given pose."""
        R_cam_body = R_cam_model @ self.R_body_model.T
        return R_cam_body, t_cam_model_m - R_cam_body @ self.t_body_model_m


@dataclass(frozen=True, eq=False)
class ModelFrames:
    """The frames of a dataset's models."""

    common: ModelFrame = field(default_factory=ModelFrame)
    by_object: dict[int, ModelFrame] = field(default_factory=dict)

    def of(self, object_id: int) -> ModelFrame:
        return self.by_object.get(object_id, self.common)

    def in_body(self, target: BopTarget) -> BopTarget:
        """The target with the pose of its body axes instead of its model file's."""
        R, t = self.of(target.object_id).pose_of_body(target.R_cam_target, target.t_cam_target_m)
        return dataclasses.replace(target, R_cam_target=R, t_cam_target_m=t)


def read_model_frames(root: Path | None) -> ModelFrames:
    """Read model_frame.toml at the dataset's root or in its models/; without one, models are FRD. Raises BopError."""
    for folder in () if root is None else (root, root / "models"):
        path = folder / MODEL_FRAME_FILE
        if path.is_file():
            return _parse(path)
    return ModelFrames()


def _parse(path: Path) -> ModelFrames:
    table = read_toml(path, BopError)
    objects = table.pop("objects", {})
    common = _frame(path, "", table, ModelFrame())
    if not isinstance(objects, dict):
        raise BopError(f"{path}: 'objects' does not hold a table for each object, as [objects.1]")
    by_object = {}
    for key, entry in objects.items():
        if not key.isdecimal() or not isinstance(entry, dict):
            raise BopError(f"{path}: 'objects.{key}' is not a table named by an object's number")
        by_object[int(key)] = _frame(path, f"objects.{key}.", entry, common)
    return ModelFrames(common, by_object)


def _frame(path: Path, prefix: str, table: dict[str, Any], default: ModelFrame) -> ModelFrame:
    for name in table:
        if name not in _KEYS:
            raise BopError(f"{path}: unknown key '{prefix}{name}'; there are {', '.join(_KEYS)} and [objects.N]")
    values: dict[str, Array] = {}
    for name, shape in (("R_body_model", (3, 3)), ("t_body_model_m", (3,)), ("diameter_m", ())):
        if name in table:
            try:
                value = np.array(table[name], dtype=np.float64)
            except (ValueError, TypeError, OverflowError):
                value = np.zeros(0)
            if value.shape != shape or not np.isfinite(value).all():
                what = " by ".join(map(str, shape)) + " finite numbers" if shape else "a finite number"
                raise BopError(f"{path}: '{prefix}{name}' is not {what}")
            values[name] = value
    R = values.get("R_body_model", default.R_body_model)
    if not is_rotation(R):
        raise BopError(
            f"{path}: '{prefix}R_body_model' is not a rotation: three unit vectors at right angles, right-handed"
        )
    diameter = values.get("diameter_m")
    if diameter is not None and diameter <= 0:
        raise BopError(f"{path}: '{prefix}diameter_m' is not above zero")
    return ModelFrame(
        R,
        values.get("t_body_model_m", default.t_body_model_m),
        default.diameter_m if diameter is None else float(diameter),
    )
