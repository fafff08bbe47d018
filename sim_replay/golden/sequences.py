"""Renders the short sequences that golden files need beside the bundled one.

    python -m sim_replay.golden.sequences --out sim_replay/data/golden

`away_and_back`: the own ship swings its nose off the target for longer than a track lasts, and back.
`two_targets`: a second aircraft crosses the first. `unknown_range`: a small image of an aircraft that the model was not
trained on, so that its range is not known. They are BOP scenes with telemetry, like `sim_replay.sequence`'s.
"""

from __future__ import annotations

import argparse
import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from sim_replay.flight.encounter import ORIGIN_DEG_M
from sim_replay.sequence import (
    AIRFRAME,
    R_BODY_CAM,
    T_BODY_CAM_M,
    Array,
    Filmed,
    Flight,
    own_flight,
    target_flight,
    write_scene,
)

SEED = 34
FPS = 10.0
SIZE_WH_PX = (1280, 720)
SMALL_WH_PX = (640, 360)
JPEG_QUALITY = 60
AWAY_RAD = np.radians(42.0)
AWAY_FROM_S, AWAY_TO_S, SWING_S = 1.1, 3.6, 0.1


def sequences() -> dict[str, Filmed]:
    """The sequences by name."""
    own, first = own_flight(SEED), (AIRFRAME, 8, target_flight(SEED))
    return {
        "away_and_back": Filmed(50, FPS, SIZE_WH_PX, SEED, _swinging(own), (first,)),
        "two_targets": Filmed(30, FPS, SIZE_WH_PX, SEED, own, (first, ("glider", 3, _glider()))),
        "unknown_range": Filmed(12, FPS, SMALL_WH_PX, SEED, own, (("canard_pusher", 3, target_flight(SEED)),)),
    }


def _swinging(flight: Flight) -> Flight:
    def shake_rad(t_s: Array) -> Array:
        t_s = np.asarray(t_s)
        out = 1.0 / (1.0 + np.exp((AWAY_FROM_S - t_s) / SWING_S))
        back = 1.0 / (1.0 + np.exp((AWAY_TO_S - t_s) / SWING_S))
        return np.asarray(flight.shake_rad(t_s) + (out - back)[:, None] * [0.0, 0.0, AWAY_RAD])

    return dataclasses.replace(flight, shake_rad=shake_rad)


def _glider() -> Flight:
    """Wings level, slowly from the right to the left of the image."""
    return Flight(
        t_ned_start_m=(185.3, 4.9, -306.0),
        speed_mps=30.1,
        heading_rad=np.radians(10.8),
        climb_rad=np.radians(4.4),
        incidence_rad=np.radians(2.0),
        bank_rad=lambda t_s: np.zeros_like(t_s),
        shake_rad=lambda t_s: np.zeros((len(t_s), 3)),
    )


def generate(folder: Path, filmed: Filmed) -> None:
    """Write a whole sequence into `folder`."""
    write_scene(folder, filmed, JPEG_QUALITY)
    for name in ("mask", "mask_visib"):  # not used when a sequence is played
        shutil.rmtree(folder / name)
    lines = [
        'command = "python -m sim_replay.golden.sequences"',
        f"fps = {FPS}",
        "t0_ns = 0  # exposure of frame 0 on telemetry.csv's clock",
        f"R_body_cam = {np.round(R_BODY_CAM, 9).tolist()}",
        f"t_body_cam_m = {T_BODY_CAM_M.tolist()}",
        f"origin_lat_lon_alt = {list(ORIGIN_DEG_M)}",
    ]
    (folder / "sequence.toml").write_text("\n".join(lines) + "\n", encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m sim_replay.golden.sequences", description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write the scenes' folders to")
    options = parser.parse_args(arguments)
    for name, filmed in sequences().items():
        generate(options.out / name, filmed)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
