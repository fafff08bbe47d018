"""Which folder, file and entry tells of a dataset's models, where several do or some are missing."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sim_replay.bop import BopError, ModelFrames, object_names, read_model_frames, read_models
from tests.sim_replay.foreign import write_json, write_ply

# The models are drawn nose y, right wing x, up z; a point 0.5 m above their origin is the body's.
FRAME = "R_body_model = [[0, 1, 0], [1, 0, 0], [0, 0, -1]]\nt_body_model_m = [0, 0, 0.5]\n"
NOSE_WING_FIN_MM = [[0, 4000, 0], [6000, 0, 0], [0, -3000, 1500]]
LOW_M, SIZE_M = (-3.0, 0.0, -1.0), (7.0, 6.0, 1.5)  # of these points in body
BOX_MM = {f"{kind}_{axis}": value for axis in "xyz" for kind, value in (("min", -1000.0), ("size", 3000.0))}


def diameters_m(root: Path) -> dict[int, float]:
    return {number: model.diameter_m for number, model in read_models(root, read_model_frames(root)).items()}


def test_models_are_preferred_to_those_for_scoring_and_those_to_others(tmp_path: Path) -> None:
    folders = ("models_fine", "models_eval", "models")
    for diameter_mm, name in enumerate(folders, start=1):
        write_json(tmp_path / name / "models_info.json", {"1": {"diameter": 1000 * diameter_mm, "name": name}})
        assert diameters_m(tmp_path) == {1: diameter_mm}
        assert object_names(tmp_path) == {1: name}
    (tmp_path / "models" / "models_info.json").unlink()
    assert diameters_m(tmp_path) == {1: 2.0}  # an empty folder tells nothing


def test_objects_without_a_name_and_datasets_without_models_have_none(tmp_path: Path) -> None:
    assert object_names(None) == object_names(tmp_path) == {}
    write_ply(tmp_path / "models" / "obj_000001.ply", NOSE_WING_FIN_MM)
    assert object_names(tmp_path) == {}
    write_json(tmp_path / "models" / "models_info.json", {"1": {"diameter": 1}, "2": {"name": "kite"}, "3": "hawk"})
    assert object_names(tmp_path) == {2: "kite"}


def test_a_mesh_alone_tells_size_and_diameter_in_body_axes(tmp_path: Path) -> None:
    (tmp_path / "model_frame.toml").write_text(FRAME)
    write_ply(tmp_path / "models" / "obj_000007.ply", NOSE_WING_FIN_MM)
    (tmp_path / "models" / "obj_copy.ply").write_text("of no number")
    models = read_models(tmp_path, read_model_frames(tmp_path))
    assert models.keys() == {7}
    assert models[7].diameter_m == pytest.approx(np.linalg.norm([6.0, 4.0]))  # from the nose to the wing's tip
    np.testing.assert_allclose(models[7].low_m, LOW_M, atol=1e-6)
    np.testing.assert_allclose(models[7].size_m, SIZE_M, atol=1e-6)


def test_what_models_info_leaves_out_the_mesh_tells(tmp_path: Path) -> None:
    """Of object 1 the diameter, of object 2 the box; of both the rest is believed, though the mesh is another."""
    write_json(tmp_path / "models" / "models_info.json", {"1": BOX_MM | {"name": "kite"}, "2": {"diameter": 99e3}})
    for number in (1, 2):
        write_ply(tmp_path / "models" / f"obj_{number:06d}.ply", NOSE_WING_FIN_MM)
    boxed, told = (read_models(tmp_path, ModelFrames())[number] for number in (1, 2))
    assert (boxed.name, told.name) == ("kite", "")
    np.testing.assert_allclose([boxed.low_m, boxed.size_m], [[-1.0] * 3, [3.0] * 3])
    assert boxed.diameter_m == pytest.approx(np.linalg.norm([6.0, 4.0]))
    assert told.diameter_m == 99.0
    np.testing.assert_allclose(told.low_m, [0.0, -3.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(told.size_m, [6.0, 7.0, 1.5], atol=1e-6)


def test_a_diameter_in_the_sidecar_stands_in_where_no_model_has_one(tmp_path: Path) -> None:
    (tmp_path / "model_frame.toml").write_text("[objects.1]\ndiameter_m = 5.0\n[objects.2]\ndiameter_m = 6.0\n")
    write_json(tmp_path / "models" / "models_info.json", {"1": {"diameter": 9000}})
    assert diameters_m(tmp_path) == {1: 9.0, 2: 6.0}


@pytest.mark.parametrize("diameter", [0, -5.0])
def test_a_model_of_no_size_is_refused(tmp_path: Path, diameter: float) -> None:
    write_json(tmp_path / "models" / "models_info.json", {"1": {"diameter": diameter}})
    with pytest.raises(BopError, match=r"models_info\.json: 'diameter' of '1' is not above zero"):
        read_models(tmp_path, ModelFrames())
