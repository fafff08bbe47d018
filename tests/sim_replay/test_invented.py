"""Aircraft that nobody built are sound meshes, differ from the fleet, and are labelled as what they are."""

from __future__ import annotations

import numpy as np
import pytest

from sim_replay.airframes import AIRFRAMES, Part, airframe_id, airframe_of
from sim_replay.airframes.invented import (
    FLEET_ALONE,
    KEPT_BACK_VARIANTS,
    SPAN_M,
    TRAINING_VARIANTS,
    Invention,
    bent,
    draw_invented,
)
from sim_replay.airframes.mesh import Mesh, loft
from sim_replay.sampler import WindowSampler

FLEET = len(AIRFRAMES)


def test_numbers_of_the_fleet_mean_the_fleet() -> None:
    assert [airframe_of(number) for number in range(FLEET)] == list(AIRFRAMES)
    with pytest.raises(IndexError):
        airframe_of(10**6)


@pytest.mark.parametrize("name", ["glider", "invented_21", "invented_10604"])
def test_a_name_leads_to_its_aircraft(name: str) -> None:
    assert airframe_of(airframe_id(name)).name == name


@pytest.mark.parametrize("name", ["zeppelin", "invented_20", "invented_10605", "invented_x", "invented_"])
def test_a_name_of_none_is_refused(name: str) -> None:
    with pytest.raises(ValueError, match=f"no airframe is called '{name}'; there are male"):
        airframe_id(name)


def test_invented_aircraft_are_sound_meshes_of_another_size_and_shape() -> None:
    rng = np.random.default_rng(3)
    numbers = {draw_invented(rng, [0, 3, 6, 18]) for _ in range(40)}
    assert len(numbers) > 20
    sizes = []
    for number in numbers:
        airframe = airframe_of(number)
        mesh = airframe.mesh()
        assert np.isfinite(mesh.vertices_m).all()
        assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-4)
        assert set(np.unique(mesh.faces)) <= set(range(len(mesh.vertices_m)))
        assert (mesh.part[mesh.faces] == mesh.part[mesh.faces[:, :1]]).all(), "no face joins two parts"
        assert SPAN_M[0] * 0.99 <= airframe.span_m <= SPAN_M[1] * 1.01
        assert Part.FUSELAGE in mesh.part or Part.WING in mesh.part
        sizes.append(airframe.length_m / airframe.span_m)
    assert np.ptp(sizes) > 0.3


def test_the_normals_of_what_is_bent_are_those_of_its_new_surface() -> None:
    along, around = np.meshgrid(np.linspace(0.05, np.pi - 0.05, 80), np.linspace(0.0, 2 * np.pi, 120, endpoint=False))
    rings_m = np.stack([np.cos(along), np.sin(along) * np.cos(around), np.sin(along) * np.sin(around)], axis=-1)
    ellipsoid = loft(np.swapaxes(rings_m, 0, 1) * [4.0, 6.0, 1.0], Part.WING)
    changed = bent(ellipsoid, (-0.3, 0.1), np.array([1.3, 0.8]))
    anew = np.zeros_like(changed.vertices_m)
    a, b, c = (changed.vertices_m[changed.faces[:, k]] for k in range(3))
    for k in range(3):
        np.add.at(anew, changed.faces[:, k], np.cross(b - a, c - a))
    anew /= np.linalg.norm(anew, axis=1, keepdims=True)
    off_deg = np.degrees(np.arccos(np.sum(anew * changed.normals, axis=1).clip(-1.0, 1.0)))
    assert np.median(off_deg) < 1.0


def _floating(mesh: Mesh) -> float:
    """Farthest that a piece of its skin lies from all other pieces, in lengths of the aircraft."""
    piece = np.arange(len(mesh.vertices_m))
    while not np.array_equal(least := piece[mesh.faces].min(axis=1), piece[mesh.faces].max(axis=1)):
        np.minimum.at(piece, mesh.faces, least[:, None])
    gaps_m = [0.0]
    for number in np.unique(piece):
        own, others = mesh.vertices_m[piece == number], mesh.vertices_m[piece != number]
        if len(others):
            apart_m = np.maximum(others - own.max(axis=0), own.min(axis=0) - others).max(axis=1)
            gaps_m.append(float(apart_m.min()))
    return max(gaps_m) / float(np.ptp(mesh.vertices_m[:, 0]))


def test_some_have_a_small_wing_at_the_nose_as_light_aircraft_and_gliders_have_not() -> None:
    def has_canard(mesh: Mesh) -> bool:
        wing_m = mesh.vertices_m[mesh.part == Part.WING]
        along_m = np.sort(wing_m[:, 0])
        gap = int(np.argmax(np.diff(along_m)))
        ahead, behind = (wing_m[sign * (wing_m[:, 0] - along_m[gap]) > 0.0] for sign in (1.0, -1.0))
        apart = along_m[gap + 1] - along_m[gap] > 0.1 * np.ptp(mesh.vertices_m[:, 0])
        return bool(apart and np.ptp(ahead[:, 1]) < 0.6 * np.ptp(behind[:, 1]))

    given = [3, 5, 9, 12]
    assert not any(has_canard(AIRFRAMES[k].mesh()) for k in given)
    rng = np.random.default_rng(8)
    drawn = [airframe_of(draw_invented(rng, given)).mesh() for _ in range(60)]
    canards = [mesh for mesh in drawn if has_canard(mesh)]
    assert 0.08 < len(canards) / len(drawn) < 0.35
    assert max(_floating(mesh) for mesh in canards) < 0.03


def test_only_parts_of_the_given_members_are_used() -> None:
    rng = np.random.default_rng(1)
    given = {AIRFRAMES[k].name for k in (2, 5)}
    for _ in range(30):
        words = airframe_of(draw_invented(rng, [2, 5])).description.replace(",", "").split()
        assert {word for word in words if word in {a.name for a in AIRFRAMES}} <= given


def test_those_kept_back_from_training_are_others() -> None:
    rng = np.random.default_rng(2)
    drawn, kept_back = (
        {draw_invented(rng, range(FLEET), variants) for _ in range(400)}
        for variants in (TRAINING_VARIANTS, KEPT_BACK_VARIANTS)
    )
    assert not drawn & kept_back
    assert len(kept_back) > 300
    sizes_m = [airframe_of(number).span_m for number in sorted(kept_back)[:20]]
    assert len({round(size_m, 3) for size_m in sizes_m}) > 15


def test_windows_show_them_with_labels_that_fit() -> None:
    batch = WindowSampler(5, 96, [0, 3, 6], 0.0, 0.0, Invention(1.0)).batch(0, 12)
    seen = batch.present
    assert seen.sum() >= 10
    assert (batch.airframe_id[seen] >= FLEET).all()
    apart_px = []
    for k in np.flatnonzero(seen):
        assert batch.diameter_m[k] == pytest.approx(airframe_of(int(batch.airframe_id[k])).diameter_m())
        rows, columns = np.nonzero(batch.mask[k])
        mask_px = np.array([columns.min(), rows.min(), columns.max(), rows.max()])
        apart_px.append(np.abs(mask_px - batch.box_xyxy_px[k]).max())
    # An aerial thinner than half a pixel is in the outline and not in the mask.
    assert np.median(apart_px) < 1.5
    assert max(apart_px) < 6.0


def test_without_a_share_the_windows_are_the_fleets_own() -> None:
    plain, named = WindowSampler(7, 64).batch(0, 4), WindowSampler(7, 64, invention=FLEET_ALONE).batch(0, 4)
    assert (plain.airframe_id < FLEET).all()
    assert np.array_equal(plain.image_bgr, named.image_bgr)
