"""The airframes are what their citations say, closed, symmetric and the right way round."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import pdist

from sim_replay.airframes import AIRFRAMES, Airframe, Part, airframe_id
from sim_replay.airframes.livery import livery_from_seed
from sim_replay.airframes.mesh import Mesh, diameter_m
from sim_replay.airframes.shapes import ellipsoid, lifting_surface

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
    assert diameter_m(plank) == pytest.approx(np.hypot(1.0, 3.0), rel=0.01)


def test_an_unknown_name_is_answered_with_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"'zeppelin'.*male_v_tail"):
        airframe_id("zeppelin")


def test_liveries_follow_their_seed_and_vary() -> None:
    skins = np.array([livery_from_seed(seed).palette[Part.FUSELAGE] for seed in range(200)])
    assert np.array_equal(livery_from_seed(5).palette, livery_from_seed(5).palette)
    assert skins.min() < 0.1
    assert skins.max() > 0.8
