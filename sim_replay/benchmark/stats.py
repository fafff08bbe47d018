"""`uavpose-replay stats`: statistics of a BOP dataset, measured from its files, beside the paper's figures."""

from __future__ import annotations

import json
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.progress import Progress
from rich.table import Table

from edge.errors import InputError
from msgs.settings import read_toml
from sim_replay.bop import BopError, BopFrame, BopScene, find_scenes, object_names
from sim_replay.bop.fields import integer, load_object
from sim_replay.bop.scene import picture_size_wh
from sim_replay.evaluation.judge import is_seen
from sim_replay.label_fit import Labelled, lies_beside_its_box

RANGE_EDGES_M = tuple(range(100, 501, 50))
# FW-UAV6DPose according to the paper's dataset section. It prints 7,725 training images; its total requires 8,425.
PAPER = {
    "sequences": "161",
    "frames": "15,325",
    "splits": "train 8,425 (7,725 printed), val 2,400, test 4,500",
    "picture": "1920×1080",
    "range": "about 100–500 m",
    "box_share": "about 1.20 %",
}


@dataclass
class _Counts:
    """Values collected while scenes are read."""

    sequences: Counter[str] = field(default_factory=Counter)  # by split
    frames: Counter[str] = field(default_factory=Counter)
    pictures: Counter[tuple[int, int]] = field(default_factory=Counter)  # width, height; once per scene that has it
    targets_in_frame: Counter[int] = field(default_factory=Counter)
    airframes: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))  # frames, by split
    flights: dict[str, set[tuple[str, int]]] = field(default_factory=lambda: defaultdict(set))
    range_m: list[float] = field(default_factory=list)
    focal_px: list[float] = field(default_factory=list)  # each that a scene has, once per scene
    box_share: list[float] = field(default_factory=list)
    beside_box: list[bool] = field(default_factory=list)
    visible_fraction: list[float] = field(default_factory=list)
    below_camera: list[bool] = field(default_factory=list)  # where the world is known to be local NED
    distorted: int = 0  # scenes


def dataset_statistics(root: Path, on_scene: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Measure a BOP dataset, split or scene folder. Raises InputError, naming file and key.

    Targets marked as hidden are not counted. Ranges are distances of target origins from the camera; box shares are
    those of the first visible target in each frame, its visible box over the image's area. Sizes of images that a scene
    lists but lacks are those of its first image, or from its camera.json if there are only labels. A value that the
    files do not contain is None.
    """
    counts = _Counts()
    try:
        scenes = find_scenes(root)
        names_of = cache(object_names)  # by dataset: the same number is another object in each
        for scene in scenes:
            _take_scene(counts, scene, names_of(scene.root))
            on_scene()
    except BopError as error:
        raise InputError(str(error)) from error
    return {"dataset": str(root), **_recipe(root), **_summary(counts)}


def _take_scene(counts: _Counts, scene: BopScene, names: Mapping[int, str]) -> None:
    split = scene.split or scene.folder.parent.name
    frames = scene.frames
    if not frames:
        return
    sizes = _picture_sizes(scene)
    counts.sequences[split] += 1
    counts.frames[split] += len(frames)
    counts.pictures.update(set(sizes))
    counts.focal_px += sorted({float(np.sqrt(frame.K[0, 0] * frame.K[1, 1])) for frame in frames})
    counts.distorted += frames[0].distortion is not None
    flown = _toml(scene.folder / "sequence.toml")
    for frame, (width, height) in zip(frames, sizes, strict=True):
        _take_frame(counts, split, frame, width * height, names, in_ned=bool(flown))
        fits = (lies_beside_its_box(Labelled(t, frame.K, frame.distortion, scene.folder)) for t in frame.targets)
        counts.beside_box += [beside for beside in fits if beside is not None]
    if flown.get("airframe") and "flight_seed" in flown:
        seed = flown["flight_seed"]
        if not isinstance(seed, int):
            raise InputError(f"{scene.folder / 'sequence.toml'}: flight_seed is not a whole number: {seed!r}")
        counts.flights[split].add((str(flown["airframe"]), seed))


def _take_frame(
    counts: _Counts, split: str, frame: BopFrame, area_px: int, names: Mapping[int, str], *, in_ned: bool
) -> None:
    seen = [target for target in frame.targets if is_seen(target)]  # BOP lists hidden ones too
    counts.targets_in_frame[len(seen)] += 1
    for k, target in enumerate(seen):
        counts.range_m.append(float(np.linalg.norm(target.t_cam_target_m)))
        box = target.box_visible_xyxy_px
        if k == 0 and box is not None and area_px:
            counts.box_share.append(float(np.prod(box[2:] - box[:2])) / area_px)
        if target.whole_px:
            counts.visible_fraction.append((target.visible_px or 0) / target.whole_px)
        if in_ned and frame.R_cam_world is not None:
            # A target further down than the camera is seen against the ground.
            counts.below_camera.append(bool(frame.R_cam_world[:, 2] @ target.t_cam_target_m > 0.0))
        counts.airframes[split][names.get(target.object_id, f"object {target.object_id}")] += 1


def _picture_sizes(scene: BopScene) -> list[tuple[int, int]]:
    """Width and height of each frame's image, see `dataset_statistics`; zeros if nothing tells. Raises BopError."""
    sizes: dict[int, tuple[int, int]] = {}
    for frame in scene.frames:
        with suppress(BopError):  # it is missing, or cannot be read
            sizes[frame.image_id] = picture_size_wh(scene.image_path(frame))
    first = next(iter(sizes.values()), None) or _size_of_camera(scene.folder / "camera.json")
    return [sizes.get(frame.image_id, first) for frame in scene.frames]


def _size_of_camera(path: Path) -> tuple[int, int]:
    """Width and height in a camera.json; zeros where it, or the file, lacks them. Raises BopError."""
    entry = load_object(path, optional=True)
    width, height = (integer(path, "camera", entry, name) if name in entry else 0 for name in ("width", "height"))
    return width, height


def _toml(path: Path) -> dict[str, Any]:
    return read_toml(path, InputError) if path.is_file() else {}


def _recipe(root: Path) -> dict[str, Any]:
    made = _toml(root / "dataset.toml")
    return {key: made.get(key) for key in ("command", "preset", "seed", "every", "complete")}


def _spread(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    low, middle, high = (float(v) for v in np.percentile(values, (5, 50, 95)))
    return {
        "mean": float(np.mean(values)),
        "min": min(values),
        "p5": low,
        "median": middle,
        "p95": high,
        "max": max(values),
    }


def _summary(counts: _Counts) -> dict[str, Any]:
    frames = counts.frames.total()
    histogram, _ = np.histogram(counts.range_m, bins=[0.0, *RANGE_EDGES_M, np.inf])
    edges = ["below 100", *(f"{a}-{a + 50}" for a in RANGE_EDGES_M[:-1]), "500 and above"]
    return {
        "sequences": dict(counts.sequences),
        "frames": dict(counts.frames),
        "pictures": {f"{width}x{height}": n for (width, height), n in counts.pictures.items()},
        "range_m": _spread(counts.range_m),
        "range_histogram_m": dict(zip(edges, (int(n) for n in histogram), strict=True)),
        "box_share": _spread(counts.box_share),
        "beside_box_share": float(np.mean(counts.beside_box)) if counts.beside_box else None,
        "focal_px": _spread(counts.focal_px),
        "distorted_sequences": counts.distorted,
        "targets_per_frame": {str(n): counts.targets_in_frame[n] for n in sorted(counts.targets_in_frame)},
        "target_free_share": counts.targets_in_frame[0] / frames if frames else None,
        "visible_fraction": _spread(counts.visible_fraction),
        "partly_hidden_share": float(np.mean(np.array(counts.visible_fraction) < 0.98))
        if counts.visible_fraction
        else None,
        "below_camera_share": float(np.mean(counts.below_camera)) if counts.below_camera else None,
        "airframes": {split: dict(sorted(names.items())) for split, names in counts.airframes.items()},
        "airframe_flights_in_two_splits": _shared(counts.flights),
    }


def _shared(flights: dict[str, set[tuple[str, int]]]) -> int:
    seen = Counter(flight for split in flights.values() for flight in split)
    return sum(number > 1 for number in seen.values())


def statistics_table(s: dict[str, Any]) -> Table:
    """The statistics as a table, beside the paper's."""
    table = Table(title=escape(str(s["dataset"])), show_lines=False)
    for column in ("", "dataset", "paper"):
        table.add_column(column)
    for row in _rows(s):
        table.add_row(*map(escape, row))
    return table


def _rows(s: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    yield "sequences", _of_splits(s["sequences"]), PAPER["sequences"]
    yield "frames", f"{sum(s['frames'].values()):,}", PAPER["frames"]
    yield "frames by split", _of_splits(s["frames"]), PAPER["splits"]
    yield "image size", ", ".join(name.replace("x", "×") for name in s["pictures"]), PAPER["picture"]
    if r := s["range_m"]:
        yield "range", f"{r['min']:.0f}–{r['max']:.0f} m, mean {r['mean']:.0f} m", PAPER["range"]
        total = sum(s["range_histogram_m"].values())
        for name, count in s["range_histogram_m"].items():
            yield f"  {name} m", f"{100 * count / total:.1f} %", ""
    if b := s["box_share"]:
        spread = f"(5th to 95th percentile: {100 * b['p5']:.2f}–{100 * b['p95']:.2f} %)"
        yield "visible box / image area, mean", f"{100 * b['mean']:.3f} % {spread}", PAPER["box_share"]
    if s["beside_box_share"] is not None:
        yield "poses that project beside their box", f"{100 * s['beside_box_share']:.1f} %", "not given"
    if f := s["focal_px"]:
        yield "focal length", f"{f['min']:.0f}–{f['max']:.0f} px, median {f['median']:.0f}", "not given"
    yield "sequences with distortion", str(s["distorted_sequences"]), "not given"
    yield "targets per frame: frames", ", ".join(f"{n}: {c:,}" for n, c in s["targets_per_frame"].items()), "1"
    if s["target_free_share"] is not None:
        yield "frames without a target", f"{100 * s['target_free_share']:.1f} %", "not given"
    if v := s["visible_fraction"]:
        hidden = f"{100 * s['partly_hidden_share']:.1f} % of the targets below 0.98"
        yield "visible fraction", f"mean {v['mean']:.3f}; {hidden}", "not given"
    if s["below_camera_share"] is not None:
        yield "targets below the camera", f"{100 * s['below_camera_share']:.1f} %", "not given"
    yield (
        "airframes by split",
        ", ".join(f"{split} {len(names)}" for split, names in s["airframes"].items()),
        "not given",
    )
    yield "airframes", ", ".join(sorted({name for names in s["airframes"].values() for name in names})), "not given"
    yield "airframe/flight pairs in two splits", str(s["airframe_flights_in_two_splits"]), "not given"


def _of_splits(counts: dict[str, int]) -> str:
    return f"{sum(counts.values()):,}: " + ", ".join(f"{name} {count:,}" for name, count in counts.items())


def run(dataset: Path, as_json: bool) -> int:
    """Measure and print. Raises InputError."""
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=as_json or not console.is_terminal) as bar:
        task = bar.add_task("reading scenes", total=None)
        statistics = dataset_statistics(dataset, lambda: bar.advance(task))
    if as_json:
        print(json.dumps(statistics, indent=2))
    else:
        Console().print(statistics_table(statistics))
    return 0
