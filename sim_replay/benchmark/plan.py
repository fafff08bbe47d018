"""Plans every sequence from a preset and a seed: pure, quick, and the same on any machine.

Nothing is flown or rendered here. The planned focal length suits the airframe at that range on average over aspects;
`lenses` adjusts it once the aspects have been flown.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from msgs.geometry import R_from_euler
from sim_replay.airframes import Part, airframe_id, airframe_of
from sim_replay.benchmark.preset import SPLITS, Compression, Gust, Preset, Quality, Split, Weather

Array = NDArray[np.float64]
T = TypeVar("T")
ASPECTS = 96  # attitudes sampled for the mean size of an airframe
PRINCIPAL_SIGMA_PX = 12.0
LENS_LIMITS = (-2.5, 1.7)  # of the scatter, in sigmas
LONGEST_SCATTER = 0.25  # of the logarithm of the longest available lens


@dataclass(frozen=True)
class SequencePlan:
    """One sequence, complete except for the flight itself."""

    index: int  # also the BOP scene id
    split: Split
    frames: int
    fps: float
    range_m: float  # to the first target, in the middle of the sequence
    airframes: tuple[str, ...]  # flown; the first is the main target
    shown: int  # how many of those are rendered; 0: an empty sky
    flight_seed: int
    livery_seeds: tuple[int, ...]
    environment_seed: int
    sensor_seed: int
    weather: Weather
    quality: Quality
    gimbal: bool
    jitter_rad: float
    gust: Gust
    leaves: bool
    focal_px: float
    box_share: float  # share of the image that the main target's box should cover on average
    principal_px: tuple[float, float]
    corner_distortion: tuple[float, float, float, float] | None  # displacement / radius at the corner: k1 k2 p1 p2
    exposure_s: float
    distractors: int
    jpeg_quality: int
    h264_kbps: int | None


def cut_frames(rng: np.random.Generator, total: int, count: int, shortest: int, longest: int) -> list[int]:
    """`count` lengths between the bounds that add up to `total`, which must be possible."""
    lengths = rng.integers(shortest, longest + 1, count)
    while (missing := total - int(lengths.sum())) != 0:
        room = np.flatnonzero(lengths < longest if missing > 0 else lengths > shortest)
        chosen = rng.permutation(room)[: abs(missing)]
        lengths[chosen] += np.sign(missing)
    return [int(length) for length in lengths]


def allotted(rng: np.random.Generator, weights: Mapping[T, float], count: int) -> list[T]:
    """`count` values in random order, each as often as its weight says, to within one."""
    names, share = list(weights), np.array(list(weights.values()), dtype=np.float64)
    exact = share / share.sum() * count
    # A random offset makes the expectation exact where the count is too small for every value to occur.
    edges = np.floor(np.concatenate([[0.0], np.cumsum(exact)]) + rng.random()).astype(int)
    edges[0], edges[-1] = 0, count
    values = [name for name, n in zip(names, np.diff(edges), strict=True) for _ in range(n)]
    return [values[k] for k in rng.permutation(count)]


def spread_ranges(rng: np.random.Generator, frames: Sequence[int], bounds_m: tuple[float, float]) -> list[float]:
    """A range for each sequence such that the frames, concatenated in some order, fill the bounds evenly."""
    order = rng.permutation(len(frames))
    lengths = np.asarray(frames, dtype=np.float64)[order]
    middle = (np.cumsum(lengths) - 0.5 * lengths) / lengths.sum()
    ranges = np.empty(len(frames))
    ranges[order] = bounds_m[0] + (bounds_m[1] - bounds_m[0]) * middle
    return [round(float(r), 3) for r in ranges]


@cache
def mean_box_area_m2(airframe: str) -> float:
    """Area, m², of the box around the airframe's outline seen from afar, averaged over the attitudes of flight."""
    mesh = airframe_of(airframe_id(airframe)).mesh()
    vertices = mesh.vertices_m[mesh.part != Part.PROPELLER_DISC].astype(np.float64)
    rng = np.random.default_rng(0x0A5BEC)
    areas = []
    for _ in range(ASPECTS):
        bank, pitch, up = np.radians(np.clip(rng.normal(0.0, (20.0, 6.0, 12.0)), -45.0, 45.0))
        R_ned_body = R_from_euler(bank, pitch, rng.uniform(-np.pi, np.pi))
        R_ned_view = R_from_euler(0.0, up, 0.0)  # its y and z axes span the image
        width, height = np.ptp((vertices @ R_ned_body.T @ R_ned_view)[:, 1:], axis=0)
        areas.append(width * height)
    return float(np.mean(areas))


@dataclass(frozen=True)
class _Table:
    """Properties allotted over all sequences at once, so that shares match the preset; one column per field."""

    split: list[Split]
    frames: list[int]
    range_m: list[float]
    main: list[str]
    shown: list[int]
    focal_px: list[float]
    box_share: list[float]
    weather: list[Weather]
    quality: list[Quality]
    gimbal: list[bool]
    gust: list[Gust]
    leaves: list[bool]
    distorted: list[bool]
    compression: list[Compression]
    flight_seed: list[int]


def plan_dataset(preset: Preset, seed: int) -> tuple[SequencePlan, ...]:
    """Plans of all sequences, train first, then val, then test."""
    table = _dealt(preset, seed)
    return tuple(_sequence(preset, table, k, np.random.default_rng([seed, 0x5E90, k])) for k in range(len(table.split)))


def _dealt(preset: Preset, seed: int) -> _Table:
    rng = np.random.default_rng([seed, 0xBE7C])
    split: list[Split] = []
    frames: list[int] = []
    range_m: list[float] = []
    main: list[str] = []
    for name in SPLITS:
        if size := preset.splits.get(name):
            lengths = cut_frames(rng, size.frames, size.sequences, *preset.sequence_frames)
            split += [name] * size.sequences
            frames += lengths
            range_m += spread_ranges(rng, lengths, preset.range_m)
            main += allotted(rng, dict.fromkeys(preset.airframe_names(), 1.0), size.sequences)
    count = len(frames)
    focal_px, box_share = _lenses(rng, preset, frames, range_m, main)
    squeezes = allotted(rng, {k: c.weight for k, c in enumerate(preset.compression)}, count)
    return _Table(
        split,
        frames,
        range_m,
        main,
        _shown(rng, preset, frames),
        focal_px,
        box_share,
        weather=allotted(rng, preset.picture.weather, count),
        quality=allotted(rng, preset.picture.quality, count),
        gimbal=allotted(rng, _yes(preset.flight.gimbal_share), count),
        gust=allotted(rng, preset.flight.gust, count),
        leaves=allotted(rng, _yes(preset.flight.leaves_share), count),
        distorted=allotted(rng, _yes(preset.lens.distorted_share), count),
        compression=[preset.compression[k] for k in squeezes],
        # All flight seeds differ, so no pair of airframe and flight can occur in two splits.
        flight_seed=[int(s) for s in rng.choice(2**31, size=count, replace=False)],
    )


def _sequence(preset: Preset, table: _Table, k: int, rng: np.random.Generator) -> SequencePlan:
    shown, squeeze = table.shown[k], table.compression[k]
    company = [str(rng.choice(preset.airframe_names())) for _ in range(shown - 1)]
    return SequencePlan(
        index=k,
        split=table.split[k],
        frames=table.frames[k],
        fps=float(rng.choice(preset.fps)),
        range_m=table.range_m[k],
        airframes=(table.main[k], *company),
        shown=shown,
        flight_seed=table.flight_seed[k],
        livery_seeds=tuple(int(s) for s in rng.integers(2**31, size=1 + len(company))),
        environment_seed=int(rng.integers(2**31)),
        sensor_seed=int(rng.integers(2**31)),
        weather=table.weather[k],
        quality=table.quality[k],
        gimbal=table.gimbal[k],
        jitter_rad=round(1e-3 * float(rng.uniform(*preset.flight.jitter_mrad)), 9),
        gust=table.gust[k],
        leaves=table.leaves[k] and shown > 0,
        focal_px=table.focal_px[k],
        box_share=table.box_share[k],
        principal_px=_principal_px(rng, preset.size_wh_px),
        corner_distortion=_corner_distortion(rng) if table.distorted[k] else None,
        exposure_s=round(1e-3 * float(np.exp(rng.uniform(*np.log(preset.picture.exposure_ms)))), 7),
        distractors=int(rng.integers(*preset.picture.distractors, endpoint=True)),
        jpeg_quality=int(rng.integers(*squeeze.jpeg_quality, endpoint=True)),
        h264_kbps=None if squeeze.h264_kbps is None else int(rng.integers(*squeeze.h264_kbps, endpoint=True)),
    )


def _yes(share: float) -> dict[bool, float]:
    return {True: share, False: 1.0 - share}


def _shown(rng: np.random.Generator, preset: Preset, frames: Sequence[int]) -> list[int]:
    """Number of targets rendered in each sequence; empty ones have at least the requested share of frames."""
    wanted = preset.targets.empty_share * sum(frames)
    order = [int(k) for k in rng.permutation(len(frames))]
    shown = [1] * len(frames)
    empty = 0.0
    while empty < wanted:
        k = order.pop()
        shown[k] = 0
        empty += frames[k]
    two, three = (round(share * len(frames)) for share in (preset.targets.two_share, preset.targets.three_share))
    for k, number in zip(order, [2] * two + [3] * three, strict=False):
        shown[k] = number
    return shown


def _principal_px(rng: np.random.Generator, size_wh_px: tuple[int, int]) -> tuple[float, float]:
    x, y = (0.5 * (side - 1) + rng.normal(0.0, PRINCIPAL_SIGMA_PX * side / 1920) for side in size_wh_px)
    return round(float(x), 3), round(float(y), 3)


def _corner_distortion(rng: np.random.Generator) -> tuple[float, float, float, float]:
    """Barrel more often than pincushion, a few per cent at the corner, as is typical of such lenses."""
    radial = rng.uniform(-0.04, 0.015)
    return radial, radial * rng.uniform(-0.3, 0.1), float(rng.normal(0.0, 4e-4)), float(rng.normal(0.0, 4e-4))


def _lenses(
    rng: np.random.Generator, preset: Preset, frames: Sequence[int], ranges_m: Sequence[float], airframes: Sequence[str]
) -> tuple[list[float], list[float]]:
    """(focal length, px; share of the image) of each sequence, their mean over frames being the preset's.

    The ideal lens makes every airframe about as large at any range; available lenses limit it, so the size given to the
    others is found by bisection.
    """
    low, high = preset.lens.focal_px
    # Not every aircraft carries the longest lens; a common limit would concentrate sequences at it.
    longest = np.maximum(high * np.exp(-LONGEST_SCATTER * rng.random(len(frames))), low)
    scatter = np.exp(preset.lens.spread * np.clip(rng.normal(size=len(frames)), *LENS_LIMITS))
    area = np.array([mean_box_area_m2(name) for name in airframes]) / np.square(ranges_m)  # at focal length 1
    picture = float(preset.size_wh_px[0] * preset.size_wh_px[1])
    weight = np.asarray(frames) / sum(frames)

    def focal(size_px: float) -> Array:
        return np.clip(size_px * scatter / np.sqrt(area), low, longest)

    smallest, largest = 1.0, float(max(preset.size_wh_px))
    for _ in range(60):
        middle = 0.5 * (smallest + largest)
        share = float(weight @ (np.square(focal(middle)) * area)) / picture
        smallest, largest = (middle, largest) if share < preset.lens.box_share else (smallest, middle)
    chosen = focal(smallest)
    share_each = np.square(chosen) * area / picture
    return [round(float(f), 2) for f in chosen], [round(float(s), 6) for s in share_each]
