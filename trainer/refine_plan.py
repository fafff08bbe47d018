"""What `uavpose-trainer refine` is asked for, and what of it is refused."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from sim_replay.bop import BopError, names_split
from sim_replay.datasets import open_dataset
from trainer.checkpoint import added_heads, presence_beside
from trainer.config import REFINED_BY_DEFAULT, ConfigError, DataConfig
from trainer.heads import BESIDE_MOST
from trainer.sources import trained_scenes


class RefinePlan(NamedTuple):
    """How much to render and how long to train on it. The seed must differ from the network's training seeds."""

    seed: int
    windows: int = 100_000
    epochs: int = 8
    strangers: float = 0.35  # share of rendered targets that are generated airframes, unseen by the network
    datasets: tuple[Path, ...] = ()  # with images on which the network was not trained
    split: str | None = None  # of each dataset; None: all that are there, as long as none is a test split
    dataset_share: float = 0.5  # of the windows, from the images of the datasets, if there are any
    flown: tuple[Path, ...] = ()  # datasets whose poses and cameras are rendered anew; none: the checkpoint's, if any
    flown_share: float = 0.5  # of the rendered windows with a target, if any are flown
    heads: tuple[str, ...] = REFINED_BY_DEFAULT  # of REFINED_HEADS; the others stay as they are
    beside: bool = False  # the presence heads that there are stay, too: another one is trained, alone


def refuse_beside(heads: Collection[str], weights: dict[str, Tensor], named: Path) -> None:
    """Raises ConfigError unless another presence head can be trained beside those of the checkpoint `named`."""
    if set(heads) != {"presence"}:
        raise ConfigError("--beside: of the heads, only that of presence can be several; give --heads presence")
    if "head_presence" not in added_heads(weights):
        raise ConfigError(f"{named}: has no presence head for another one to be beside; leave out --beside")
    if presence_beside(weights) == BESIDE_MOST:
        raise ConfigError(f"{named}: has {1 + BESIDE_MOST} presence heads, and can have no more")


def refined_on(plan: RefinePlan, data: DataConfig) -> list[str]:
    """Whose images the heads learn from: "dataset, split name".

    Raises ConfigError if a dataset has images on which the network was trained, or a test split that nobody named, or
    is unreadable.
    """
    sources = data.datasets if plan.datasets else []
    trained_on = {folder for source in sources for folder in trained_scenes(source)}
    told = []
    for path in plan.datasets:
        try:
            dataset = open_dataset(path, plan.split)
        except BopError as error:
            raise ConfigError(f"--dataset {error}") from error
        scenes = dataset.scenes
        if trained_on & {scene.folder.resolve() for scene in scenes}:
            raise ConfigError(f"--dataset {path}: the network was trained on it; give another, or another --split")
        tests = [s.split for s in scenes if (s.split or "").startswith("test") and not names_split(path, s)]
        if plan.split is None and tests:
            raise ConfigError(f"--dataset {path}: contains the split {tests[0]!r}, for evaluation; choose by --split")
        told += [f"{dataset.name}, split {split}" for split in sorted({s.split for s in scenes if s.split is not None})]
    return told if plan.dataset_share > 0.0 else []
