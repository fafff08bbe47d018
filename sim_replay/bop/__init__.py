"""BOP datasets on disk (thodan/bop_toolkit docs/bop_datasets_format.md): write them, read them.

Lengths are millimetres in the files and metres here. A scene's world is local NED where this project wrote it.
"""

from __future__ import annotations

from edge.cameras.sequence import DISTORTION_KEY
from sim_replay.bop.layout import find_root, find_scenes, names_split, read_scene
from sim_replay.bop.model_frame import MODEL_FRAME_FILE, ModelFrame, ModelFrames, read_model_frames
from sim_replay.bop.models import Model, object_names, read_models
from sim_replay.bop.ply import read_ply_vertices_m, write_ply
from sim_replay.bop.records import BopError, BopFrame, BopTarget, Distortion
from sim_replay.bop.scene import BopScene
from sim_replay.bop.write import SceneWriter, write_camera, write_models

__all__ = [
    "DISTORTION_KEY",
    "MODEL_FRAME_FILE",
    "BopError",
    "BopFrame",
    "BopScene",
    "BopTarget",
    "Distortion",
    "Model",
    "ModelFrame",
    "ModelFrames",
    "SceneWriter",
    "find_root",
    "find_scenes",
    "names_split",
    "object_names",
    "read_model_frames",
    "read_models",
    "read_ply_vertices_m",
    "read_scene",
    "write_camera",
    "write_models",
    "write_ply",
]
