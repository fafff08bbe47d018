"""The sheet shows every airframe from every side, and says what is wrong with an order for one."""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.errors import InputError
from sim_replay import sheet
from sim_replay.airframes import AIRFRAMES, airframe_id
from sim_replay.airframes.invented import dataset_names
from sim_replay.benchmark import commands


def _run(*words: str) -> int:
    parser = argparse.ArgumentParser()
    commands.register(parser.add_subparsers(dest="command"))
    args = parser.parse_args(["sheet", *words])
    return int(args.run(args))


def test_the_whole_fleet_fits_one_small_picture(tmp_path: Path) -> None:
    out = tmp_path / "fleet.jpg"
    assert _run("--out", str(out)) == 0
    assert out.stat().st_size <= 400_000
    picture = cv2.imread(str(out))
    row_px = sheet.HEADING_PX + sheet.TILE_HEIGHT_PX
    assert picture.shape[0] == row_px * len(AIRFRAMES)
    tiles = picture.reshape(len(AIRFRAMES), row_px, -1, sheet.TILE_WIDTH_PX, 3)[:, sheet.HEADING_PX : -22]
    # An empty tile is even; an aircraft is not.
    assert np.all(tiles.astype(float).std(axis=(1, 3)).max(axis=-1) > 3.0)
    assert tiles.shape[2] == 7


def test_an_airframe_reaches_across_its_tile_as_its_proportions_say() -> None:
    airframe = AIRFRAMES[airframe_id("twin_turboprop")]
    picture = sheet.sheet_image([airframe], livery_seed=3)[sheet.HEADING_PX : -22]
    top = picture[:, 3 * sheet.TILE_WIDTH_PX : 4 * sheet.TILE_WIDTH_PX].astype(int)
    background = np.median(top.reshape(-1, 3), axis=0)
    body = np.abs(top - background).max(axis=-1) > 25
    wide = np.ptp(np.flatnonzero(body.sum(axis=0) > 1))
    assert wide < sheet.TILE_WIDTH_PX - 2 * sheet.MARGIN_PX + 2
    high_px = sheet.TILE_HEIGHT_PX - 2 * sheet.MARGIN_PX
    assert wide == pytest.approx(high_px * airframe.span_m / airframe.length_m, rel=0.06)


def test_paint_follows_the_seed() -> None:
    chosen = [AIRFRAMES[0]]
    assert np.array_equal(sheet.sheet_image(chosen, 1), sheet.sheet_image(chosen, 1))
    assert not np.array_equal(sheet.sheet_image(chosen, 1), sheet.sheet_image(chosen, 2))


def test_an_invented_aircraft_is_drawn_by_its_name(tmp_path: Path) -> None:
    """As `stats` tells it of a dataset that shows some."""
    (name,) = dataset_names(1, [airframe_id("biplane"), airframe_id("glider")])
    out = tmp_path / "one.jpg"
    assert _run("--airframe", name, "--out", str(out)) == 0
    assert cv2.imread(str(out)).shape[0] == sheet.HEADING_PX + sheet.TILE_HEIGHT_PX


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--airframe", "zeppelin", "--out", "a.jpg"], r"--airframe: .*'zeppelin'.*male_v_tail"),
        (["--out", "a.tiff"], r"--out a\.tiff: .*\.jpg"),
        (["--out", "a.png", "--dataset", "flown"], r"--out a\.png: .*\.jpg"),
        (["--out", "a.jpg", "--dataset", "flown", "--airframe", "glider"], "--airframe: not with --dataset"),
        (["--out", "/nowhere/at/all/a.jpg"], r"--out .*no folder /nowhere/at/all"),
    ],
)
def test_a_mistaken_order_is_answered_with_a_sentence(words: list[str], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        _run(*words)
