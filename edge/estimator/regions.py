"""Regions of the frame that the acquire stage searches: the whole of it, and tiles of finer resolution. Pure.

Reduced to the network's input, the whole of a large frame hides small and faint targets. A tile shows a part of it in
the finest resolution that the network was trained on for this stage.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import numpy as np

from edge.estimator.lens import Lens
from edge.estimator.window import Window, whole_frame

TILE_REDUCTION = 1.6  # training reduces this stage's pixels 1.5 to 3 times
FINER_LEAST = 1.25  # a whole frame that is not reduced by this much more than a tile needs no tiles
OVERLAP = 0.25  # of neighbouring tiles, at least: what the edge of one cuts is whole in the other
EACH_WAY_MOST = 4  # rows and columns of tiles; of larger frames they are reduced more


class Region(NamedTuple):
    """A part of the undistorted frame. `share`: of the frame's targets that are to be expected in it, 0..1."""

    window: Window
    share: float

    def probability(self, score: float) -> float:
        """Of a target here, if the same peak in a whole frame had the probability `score`: the odds times the share."""
        return score * self.share / (score * self.share + 1.0 - score)

    def score_of(self, probability: float) -> float:
        """The inverse of `probability`."""
        return probability / (probability + (1.0 - probability) * self.share)


def whole(frame_wh: tuple[int, int], lens: Lens | None = None) -> Region:
    """The whole frame as a region."""
    return Region(whole_frame(frame_wh, lens), 1.0)


def tiles(frame_wh: tuple[int, int], size_wh: tuple[int, int], lens: Lens | None, aspect: float) -> tuple[Region, ...]:
    """The tiles that cover a frame, row by row, for a network input of `size_wh`; none if the whole is fine enough.

    `aspect`: of the frame's pixels (pixel_aspect).
    """
    frame = whole_frame(frame_wh, lens)
    reduction = max(frame.width / size_wh[0], frame.height * aspect / size_wh[1])
    finest = max(TILE_REDUCTION, reduction / (1.0 + (EACH_WAY_MOST - 1) * (1.0 - OVERLAP)))
    if reduction < FINER_LEAST * finest:
        return ()
    width = min(ceil(size_wh[0] * finest), frame.width)
    height = min(ceil(size_wh[1] * finest / aspect), frame.height)
    columns, rows = _starts(frame.left, frame.width, width), _starts(frame.top, frame.height, height)
    share = 1.0 / (len(columns) * len(rows))
    return tuple(Region(Window(left, top, width, height), share) for top in rows for left in columns)


def _starts(first: int, length: int, tile: int) -> list[int]:
    """Where tiles begin that cover `length` pixels from `first` on, evenly."""
    count = ceil((length - tile) / (tile * (1.0 - OVERLAP))) + 1
    return [round(float(start)) for start in np.linspace(first, first + length - tile, count)]


class Sweep:
    """The order in which regions are searched, from one search to the next: the whole frame at least every other time,
    the tiles in turn."""

    def __init__(self) -> None:
        self._had_whole = False
        self._tiles_had = 0

    def next(self, regions: Sequence[Region], count: int = 1) -> list[Region]:
        """Up to `count` of the regions, of which the first is the whole frame."""
        frame, *parts = regions
        self._had_whole = not self._had_whole or count > 1 or not parts
        chosen = [frame] if self._had_whole else []
        for _ in range(min(count - len(chosen), len(parts))):
            chosen.append(parts[self._tiles_had % len(parts)])
            self._tiles_had += 1
        return chosen
