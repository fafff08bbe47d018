"""The airframes are what their citations say, closed, symmetric and the right way round."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import pdist

from sim_replay.airframes import AIRFRAMES, Airframe, Part, airframe_id
from sim_replay.airframes.livery import livery_from_seed
from sim_replay.airframes.mesh import Mesh
from sim_replay.airframes.shapes import Patch, ellipsoid, fuselage, lifting_surface
from sim_replay.bop import read_ply_vertices_m, write_models

every_airframe = pytest.mark.parametrize("airframe", AIRFRAMES, ids=lambda airframe: airframe.name)


def _signed_volume(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


@every_airframe
def test_span_and_length_are_those_published(airframe: Airframe) -> None:
    length, span, _ = np.ptp(airframe.mesh().vertices_m, axis=0)
    assert span == pytest.approx(airframe.span_m, abs=1e-3)
    assert length == pytest.approx(airframe.length_m, abs=1e-3)


@every_airframe
def test_left_mirrors_right(airframe: Airframe) -> None:
    points = airframe.mesh().vertices_m
    low, high = points[:, 1].min(), points[:, 1].max()
    assert low == pytest.approx(-high, abs=1e-4)
    a, b, c = (points[airframe.mesh().faces[:, k]].astype(np.float64) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # An exhaust, an aerial or a radar pod on one side are welcome, but small.
    assert abs(np.sum(area * (a + b + c)[:, 1] / 3.0) / area.sum()) < 0.01 * airframe.span_m


@every_airframe
def test_faces_and_normals_look_outwards(airframe: Airframe) -> None:
    mesh = airframe.mesh()
    solid = mesh.part[mesh.faces[:, 0]] != Part.PROPELLER_DISC
    mesh = Mesh(mesh.vertices_m, mesh.normals, mesh.part, mesh.faces[solid])
    assert _signed_volume(mesh) > 0
    a, b, c = (mesh.vertices_m[mesh.faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    area = np.linalg.norm(cross, axis=1)
    agreement = np.einsum("ij,ij->i", cross, mesh.normals[mesh.faces].sum(axis=1))
    assert area[agreement > 0].sum() > 0.99 * area.sum()


@every_airframe
def test_every_triangle_has_an_area_and_belongs_to_one_part(airframe: Airframe, tmp_path: Path) -> None:
    mesh = airframe.mesh()
    corners = mesh.vertices_m[mesh.faces].astype(np.float64)
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert np.all(area > 0.9e-5 * sides.max(axis=1) ** 2)
    assert np.all(mesh.part[mesh.faces] == mesh.part[mesh.faces[:, :1]])
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-4)
    assert len(np.unique(mesh.faces)) == len(mesh.vertices_m)
    assert 1400 < len(mesh.faces) < 6000
    write_models(tmp_path, {1: mesh})
    assert np.allclose(read_ply_vertices_m(tmp_path / "obj_000001.ply"), mesh.vertices_m, atol=1e-5)


def test_no_two_airframes_share_a_silhouette() -> None:
    """From above, on a grid over span and length; the network has to tell them apart."""
    seen = {}
    for airframe in AIRFRAMES:
        points = (airframe.mesh().vertices_m[:, :2] / airframe.diameter_m() * 120 + 100).astype(np.int32)
        picture = np.zeros((260, 260), np.uint8)
        for triangle in points[airframe.mesh().faces]:
            cv2.fillConvexPoly(picture, triangle, 1)
        seen[airframe.name] = picture.astype(bool)
    for (a, one), (b, other) in itertools.combinations(seen.items(), 2):
        assert (one & other).sum() < 0.9 * (one | other).sum(), f"{a} looks like {b}"


@every_airframe
def test_nose_and_tail_differ(airframe: Airframe) -> None:
    """Front and rear show different paint: glass, sensors, intakes ahead; exhausts and propellers where they belong."""
    mesh = airframe.mesh()
    facing = mesh.normals[:, 0]
    share = [np.bincount(mesh.part[way * facing > 0.3], minlength=len(Part)) for way in (1, -1)]
    ahead, behind = (counts / counts.sum() for counts in share)
    assert np.abs(ahead - behind).sum() > 0.02


@given(
    st.tuples(st.integers(0, 6), st.integers(2, 6), st.integers(6, 18)),
    st.floats(0.2, 3.0),
    st.floats(-1.2, 1.2),
    st.floats(-5.0, 5.0),
)
def test_any_wing_is_closed_and_faces_outwards(
    naca: tuple[int, int, int], chord_m: float, dihedral_rad: float, twist_deg: float
) -> None:
    span_m = 4.0
    tip = (-0.3, span_m * np.cos(dihedral_rad), -span_m * np.sin(dihedral_rad), 0.6 * chord_m, twist_deg)
    wing = lifting_surface([(0.0, 0.0, 0.0, chord_m), tip], f"{naca[0]}{naca[1] if naca[0] else 0}{naca[2]:02d}")
    assert _signed_volume(wing) > 0
    # Ends have vertices of their own; by position, every edge of a closed surface joins two triangles.
    _, point = np.unique(wing.vertices_m, axis=0, return_inverse=True)
    triangles = point[wing.faces]
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    _, uses = np.unique(edges, axis=0, return_counts=True)
    assert np.all(uses == 2)


def test_camber_lifts_the_upper_side() -> None:
    """NACA 4412: 4 % camber at 40 % of the chord (the thickness there adds to both sides alike)."""
    wing = lifting_surface([(0.0, 0.0, 0.0, 1.0), (0.0, 2.0, 0.0, 1.0)], "4412")
    assert -wing.vertices_m[:, 2].min() == pytest.approx(0.098, abs=0.006)  # ordinate 9.8 % of the published section
    assert wing.vertices_m[:, 2].max() == pytest.approx(0.0286, abs=0.004)  # and -2.86 %


def test_a_patch_paints_only_where_it_is() -> None:
    patch = Patch(Part.GLASS, (0.5, 1.0), (0.0, 60.0))
    body = fuselage([(2.0, 0.4, 0.4, 0.0), (1.0, 1.0, 1.0, 0.0), (-2.0, 1.0, 1.0, 0.0)], patches=[patch])
    glass = body.vertices_m[body.part == Part.GLASS]
    assert glass[:, 0].min() == pytest.approx(0.5, abs=0.02)
    assert glass[:, 0].max() == pytest.approx(1.0, abs=0.02)
    assert glass[:, 2].max() < 0.0


@every_airframe
def test_diameter_is_the_largest_distance(airframe: Airframe) -> None:
    assert airframe.diameter_m() == pytest.approx(pdist(airframe.mesh().vertices_m.astype(np.float64)).max(), rel=1e-6)


def test_wheels_hang_below_and_the_fin_stands_above() -> None:
    mesh = AIRFRAMES[airframe_id("light_aircraft")].mesh()
    lowest = np.argmax(mesh.vertices_m[:, 2])
    assert mesh.part[lowest] == Part.TYRE
    assert mesh.vertices_m[lowest, 2] > 1.0
    tail = mesh.vertices_m[mesh.part == Part.TAIL]
    assert tail[:, 2].min() < -1.5
    assert tail[:, 0].max() < 0.0


def test_solids_have_the_volume_that_geometry_gives_them() -> None:
    ball = ellipsoid([1.0, 2.0, 3.0], [0.5, 0.4, 0.3], Part.SENSOR)
    assert _signed_volume(ball) == pytest.approx(4 / 3 * np.pi * 0.5 * 0.4 * 0.3, rel=0.12)
    # A NACA four-digit section encloses 0.685 t c^2 (Abbott & von Doenhoff's thickness polynomial, integrated).
    plank = lifting_surface([(0.0, 0.0, 0.0, 1.0), (0.0, 3.0, 0.0, 1.0)], "0012")
    assert _signed_volume(plank) == pytest.approx(0.685 * 0.12 * 3.0, rel=0.06)
    assert pdist(plank.vertices_m).max() == pytest.approx(np.hypot(1.0, 3.0), rel=0.01)


def test_an_unknown_name_is_answered_with_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"'zeppelin'.*male_v_tail"):
        airframe_id("zeppelin")


def test_liveries_follow_their_seed_and_vary() -> None:
    skins = np.array([livery_from_seed(seed).palette[Part.FUSELAGE] for seed in range(200)])
    assert np.array_equal(livery_from_seed(5).palette, livery_from_seed(5).palette)
    assert skins.min() < 0.1
    assert skins.max() > 0.8
