"""Fixed-wing airframes as meshes in body FRD metres, in an order that never changes (labels index it)."""

from sim_replay.airframes.fleet import AIRFRAMES, Airframe
from sim_replay.airframes.invented import airframe_id, airframe_of
from sim_replay.airframes.mesh import Mesh, Part

__all__ = ["AIRFRAMES", "Airframe", "Mesh", "Part", "airframe_id", "airframe_of"]
