"""PLY meshes, millimetres in the file (G. Turk, The PLY Polygon File Format, 1994): writes them, reads vertices."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim_replay.bop.records import MM_PER_M, BopError

if TYPE_CHECKING:
    from sim_replay.airframes.mesh import Mesh

_VERTEX = np.dtype([(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")])
_FACE = np.dtype([("count", "u1"), ("vertex", "<i4", (3,))])
_SCALARS = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
_BYTE_ORDER = {"binary_little_endian": "<", "binary_big_endian": ">"}


def write_ply(path: Path, mesh: Mesh) -> None:
    """Write a mesh as binary PLY in millimetres."""
    vertices = np.empty(len(mesh.vertices_m), _VERTEX)
    for k, axis in enumerate("xyz"):
        vertices[axis], vertices[f"n{axis}"] = mesh.vertices_m[:, k] * MM_PER_M, mesh.normals[:, k]
    faces = np.empty(len(mesh.faces), _FACE)
    faces["count"], faces["vertex"] = 3, mesh.faces
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(vertices)}",
        *(f"property float {name}" for name in _VERTEX.names or ()),
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "end_header",
        "",
    ]
    path.write_bytes("\n".join(header).encode("ascii") + vertices.tobytes() + faces.tobytes())


def read_ply_vertices_m(path: Path) -> NDArray[np.float32]:
    """Vertices [V, 3], metres, of a PLY in millimetres, ASCII or binary of either byte order. Raises BopError."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise BopError(f"{path} cannot be read: {error.strerror}") from error
    head, mark, body = raw.partition(b"end_header")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines() if line.strip()]
    if not mark or len(lines) < 3 or lines[0] != ["ply"] or lines[1][:1] != ["format"]:
        raise BopError(f"{path} is not a PLY file")
    body = body[2:] if body.startswith(b"\r\n") else body[1:]
    elements = [i for i, line in enumerate(lines) if line[:1] == ["element"]]
    try:
        if not elements or lines[elements[0]][1] != "vertex":
            raise BopError(f"{path}: its first element is not 'vertex'")
        count = int(lines[elements[0]][2])
        stop = elements[1] if len(elements) > 1 else len(lines)
        kinds = {line[2]: line[1] for line in lines[elements[0] : stop] if line[:1] == ["property"]}
        if lines[1][1] == "ascii":
            rows = [row.split()[: len(kinds)] for row in body.splitlines()[:count]]
            columns = dict(zip(kinds, np.array(rows, dtype=np.float64).reshape(count, len(kinds)).T, strict=True))
        else:
            order = _BYTE_ORDER[lines[1][1]]
            block = np.frombuffer(body, [(name, order + _SCALARS[kind]) for name, kind in kinds.items()], count)
            columns = {name: block[name] for name in kinds}
        points = np.stack([columns[axis] for axis in "xyz"], axis=-1)
    except (KeyError, ValueError, IndexError) as error:
        if isinstance(error, BopError):
            raise
        raise BopError(f"{path}: its vertices cannot be read: {error}") from error
    if not len(points) or not np.isfinite(points).all():
        raise BopError(f"{path}: it holds no vertices, or some that are not finite")
    return (points / MM_PER_M).astype(np.float32)
