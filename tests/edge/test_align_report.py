"""What `uavpose-edge align` prints: lines for the configuration, and nothing that is not known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from edge.align.command import report, to_tree
from edge.align.fit import Alignment
from edge.config import Config, ConfigFile, load_config

FORWARD_CAM = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
CAMERA = '[camera]\ntype = "zenoh"\ntopic = "a"\nlatency_ms = 40.0\nintrinsics = { file = "camera.yaml" }\n'
FILE = '[camera]\ntype = "file"\npath = "a.mp4"\nintrinsics = { file = "camera.yaml" }\n'


def mounted(roll_deg: float, pitch_deg: float, yaw_deg: float) -> np.ndarray:
    return Rotation.from_euler("ZYX", [yaw_deg, pitch_deg, roll_deg], degrees=True).as_matrix() @ FORWARD_CAM


def found(
    R_body_cam: np.ndarray, late_s: float = 0.02, clock_s: float = 0.001, focal: float = 1.0, **wanting: str
) -> Alignment:
    sure_rad, turned_rad = np.deg2rad([0.1, 0.2, 0.3]), np.full(3, 5.0)
    return Alignment(R_body_cam, 0.005, sure_rad, late_s, 0.002, clock_s, focal, 0.01, 150, turned_rad, wanting)


def configured(folder: Path, text: str) -> ConfigFile:
    (folder / "flight.toml").write_text(text)
    return load_config(folder / "flight.toml")


def said(alignment: Alignment, file: ConfigFile) -> tuple[bool, list[str]]:
    tree = to_tree(alignment, file)
    return tree["well"], list(report(alignment, tree, [], file))


def pasted(folder: Path, text: str, lines: list[str]) -> Config:
    """The configuration with the lines that were printed."""
    new = "\n".join(lines[lines.index(f"for {folder / 'flight.toml'}:") + 1 :])
    mount, _, camera = new.partition("[camera]\n")
    head = text.partition("[mount]")[0].replace("latency_ms = 40.0", camera.strip())
    return configured(folder, f"{head}{mount}").config


@pytest.mark.parametrize(
    ("mount", "R_body_cam"),
    [
        ("", mounted(3.0, -10.0, 170.0)),
        ("[mount]\nyaw_deg = 4.0\n", mounted(-90.0, 40.0, -20.0)),
        ("[mount]\nR_body_cam = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]\n", mounted(3.0, -10.0, 20.0)),
        ("", mounted(0.0, -89.0, 20.0)),
    ],
)
def test_the_lines_give_what_was_measured(tmp_path: Path, mount: str, R_body_cam: np.ndarray) -> None:
    well, lines = said(found(R_body_cam), configured(tmp_path, CAMERA + mount))
    assert well
    then = pasted(tmp_path, CAMERA + mount, lines)
    assert np.abs(then.mount.mount().R_body_cam - R_body_cam).max() < 2e-4
    assert then.camera.latency_ms == 60.0  # type: ignore[union-attr]
    assert "latency: 60.0 ± 2.0 ms; configured: 40 ms" in lines


def test_it_says_how_far_the_configured_mount_is_off(tmp_path: Path) -> None:
    _, lines = said(found(mounted(0.0, -10.0, 0.0)), configured(tmp_path, f"{CAMERA}[mount]\npitch_deg = -7.0\n"))
    (line,) = (line for line in lines if line.startswith("mount: "))
    assert "pitch -10.00 ± 0.20°" in line
    assert "configured: roll 0.00°, pitch -7.00°, yaw 0.00°; 3.00 ± 0.29° apart" in line


def test_what_is_not_known_is_not_printed(tmp_path: Path) -> None:
    alignment = found(mounted(0.0, -10.0, 0.0), mount="turn more about roll")
    well, lines = said(alignment, configured(tmp_path, CAMERA))
    assert not well
    assert "turn more about roll" in lines
    assert not any("pitch_deg" in line or line.startswith("mount: ") for line in lines)
    assert "latency_ms = 60.0" in lines
    well, lines = said(replace(alignment, wanting={"latency": "turn faster"}), configured(tmp_path, CAMERA))
    assert not well
    assert not any("latency_ms" in line or line.startswith("latency: ") for line in lines)
    assert "pitch_deg = -10.00" in lines


def test_stamps_before_the_exposure_are_no_latency(tmp_path: Path) -> None:
    well, lines = said(found(mounted(0.0, 0.0, 0.0), late_s=-0.07), configured(tmp_path, CAMERA))
    assert not well
    assert any("stamps are 30.0 ms earlier than the exposure" in line for line in lines)
    assert not any(line.startswith("latency_ms") for line in lines)
    well, lines = said(found(mounted(0.0, 0.0, 0.0), late_s=-0.041), configured(tmp_path, CAMERA))
    assert well  # within the uncertainty
    assert "latency_ms = 0.0" in lines


def test_a_focal_length_that_does_not_fit_is_told(tmp_path: Path) -> None:
    well, lines = said(found(mounted(0.0, 0.0, 0.0), focal=1.1), configured(tmp_path, CAMERA))
    assert not well
    assert any("1.100 ± 0.010 times the configured one: it does not fit" in line for line in lines)


def test_a_recording_has_no_latency_to_set(tmp_path: Path) -> None:
    well, lines = said(found(mounted(0.0, 0.0, 0.0)), configured(tmp_path, FILE))
    assert well
    assert '# a camera of type "file" has no latency_ms' in lines


@pytest.mark.parametrize(("clock_s", "told"), [(0.044, True), (0.002, False)])
def test_stamps_of_an_autopilot_that_are_hardly_known_are_told(tmp_path: Path, clock_s: float, told: bool) -> None:
    well, lines = said(found(mounted(0.0, 0.0, 0.0), clock_s=clock_s), configured(tmp_path, CAMERA))
    assert well
    assert any("TIMESYNC" in line for line in lines) is told
