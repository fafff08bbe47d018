"""Training and evaluation data as configured: rendered windows, windows from datasets, or both."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from sim_replay.bop import BopError, find_scenes
from trainer.config import ConfigError, ContractConfig, DataConfig, DatasetSource
from trainer.data import Sampler
from trainer.dataset_windows import ACQUIRE_WIDTH_PX, DatasetSampler, MixedSampler, spans

if TYPE_CHECKING:
    from sim_replay.render.flown import FlownFrames, FlownShare


_log = logging.getLogger(__name__)
RENDERED = "rendered"  # name of the renderer among the datasets


def _shares(config: DataConfig, judging: bool) -> list[tuple[DatasetSource | None, float]]:
    """What windows are drawn from, with shares that add up to 1; None, the last, is the renderer."""
    used = [one for one in config.datasets if (one.validation_split if judging else one.split) is not None]
    found: list[tuple[DatasetSource | None, float]] = [(one, one.share) for one in used]
    if not found or config.rendered_share > 0.0:
        found.append((None, 1.0 - sum(one.share for one in used)))
    # Datasets without a validation split leave their shares to the others in proportion.
    whole = sum(share for _, share in found)
    return [(source, share / whole) for source, share in found]


def _open_window_sampler(config: DataConfig, seed: int, size_px: int, judging: bool, flown: FlownShare) -> Sampler:
    from sim_replay.airframes.invented import Invention  # needs the renderer's packages
    from sim_replay.sampler import WindowSampler

    view = config.acquire_view
    samplers: list[Sampler] = []
    drawn = _shares(config, judging)
    for source, _ in drawn:
        if source is not None:
            split = source.validation_split if judging else source.split
            samplers.append(DatasetSampler(source.path, split, seed, size_px, config.acquire_share, view))
            continue
        # Evaluation windows show the fleet only, none of it flown, whatever the shares in training.
        invention = Invention(0.0 if judging else config.invented_share)
        shares_drawn = config.acquire_share, config.empty_share
        ids = config.airframe_ids if judging else _drawn_ids(config)
        samplers.append(WindowSampler(seed, size_px, ids, *shares_drawn, invention, view, flown))
    return samplers[0] if len(samplers) == 1 else MixedSampler(samplers, [share for _, share in drawn])


def validated_from(config: DataConfig, counts: Sequence[int]) -> dict[str, NDArray[np.bool_]]:
    """Which validation windows, in consecutive batches of `counts`, come from where: masks [N] by the dataset's folder
    (its whole path, if the name is another's too) or RENDERED. Empty if all come from one place."""
    drawn = _shares(config, judging=True)
    paths = [None if source is None else source.path.resolve() for source, _ in drawn]
    names = [RENDERED if path is None else path.name for path in paths]
    names = [
        name if path is None or names.count(name) == 1 else str(path.relative_to(path.anchor))
        for name, path in zip(names, paths, strict=True)
    ]
    if len(set(names)) < 2:
        return {}
    whose: list[str] = []
    for count in counts:
        first = len(whose)
        own = spans([share for _, share in drawn], first, first + count)
        whose += [name for name, (start, stop) in zip(names, own, strict=True) for _ in range(start, stop)]
    return {name: np.array([one == name for one in whose]) for name in names}


def _drawn_ids(config: DataConfig) -> list[int] | None:
    """The airframes as often as they are to be drawn."""
    return None if config.airframe_ids is None else [*config.airframe_ids, *config.hard_airframe_ids]


def _flown(config: DataConfig) -> FlownShare:
    from sim_replay.airframes import AIRFRAMES
    from sim_replay.render.flown import NONE_FLOWN, FlownShare

    if not config.flown:
        return NONE_FLOWN
    known = _drawn_ids(config) or range(len(AIRFRAMES))
    return FlownShare(config.flown_share, _read_once(tuple(config.flown), tuple(known)))


@lru_cache(1)
def _read_once(folders: tuple[Path, ...], airframe_ids: tuple[int, ...]) -> FlownFrames:
    from sim_replay.render.flown import read_flown

    try:
        return read_flown(folders, airframe_ids)
    except BopError as error:
        raise ConfigError(str(error)) from error


def refuse_unreadable(config: DataConfig) -> None:
    """Raises ConfigError if a dataset for training or validation is unusable; a check before hours of training."""
    _flown(config)
    size_px = 32  # any: the labels do not depend on it
    show_targets: dict[str, list[bool]] = {"train": [], "validate": []}
    scenes: dict[str, set[Path]] = {"train": set(), "validate": set()}
    for source in config.datasets:
        for purpose, split in zip(show_targets, (source.split, source.validation_split), strict=True):
            if split is not None:
                opened = DatasetSampler(
                    source.path, split, config.seed, size_px, config.acquire_share, config.acquire_view
                )
                opened.refuse_broken_pictures()
                show_targets[purpose].append(opened.shows_targets)
                scenes[purpose] |= opened.scene_folders
    if both := scenes["train"] & scenes["validate"]:
        raise ConfigError(f"{min(both)}: is both trained on and validated on: give another split or validation_split")
    for purpose, shown in show_targets.items():
        if config.rendered_share == 0.0 and shown and not any(shown):
            raise ConfigError(
                f"data.datasets: no image to {purpose} on shows a target, and there are no rendered windows"
            )


def trained_scenes(source: DatasetSource) -> set[Path]:
    """Folders of the scenes of a training split, without links; none, with a warning, where the dataset is not there.

    A split `train` takes in every `train_...`: the one that there was need not be the only one now.
    """
    try:
        scenes = find_scenes(source.path)
    except BopError as error:  # moved, or a relative path of another working directory
        _log.warning("%s: the network was trained on it, so whether other datasets share its images is unknown", error)
        return set()
    return {s.folder.resolve() for s in scenes if s.split and f"{s.split}_".startswith(f"{source.split}_")}


def warn_of_unseen_reduction(contract: ContractConfig) -> None:
    """Warn if the acquire stage is to see frames larger or smaller than they are in training and evaluation windows."""
    width_px = min(contract.acquire_size_wh[0], contract.acquire_size_wh[1] * 16 / 9)
    low_px, high_px = ACQUIRE_WIDTH_PX
    if contract.acquire_fit == "letterbox" and not low_px <= width_px <= high_px:
        _log.warning(
            "contract.acquire_size_wh: frames of 16:9 will be reduced to a width of %.0f px, but windows to train and "
            "to measure on are of frames %.0f to %.0f px wide: whole frames will be searched worse than metrics say",
            *(width_px, low_px, high_px),
        )


def window_sampler(config: DataConfig, seed: int, size_px: int, held_out: bool = False) -> Callable[[], Sampler]:
    """A picklable opener of rendered and dataset windows; the renderer starts in the process that calls it.

    `held_out` windows come from images that are not trained on, as those of the validation seed always do. Raises
    ConfigError if a flown dataset is unusable.
    """
    from sim_replay.render.flown import NONE_FLOWN

    judging = held_out or seed == config.validation_seed
    return partial(_open_window_sampler, config, seed, size_px, judging, NONE_FLOWN if judging else _flown(config))


def _open_refinement_sampler(
    config: DataConfig,
    seed: int,
    size_px: int,
    strangers: float,
    datasets: Sequence[Path],
    dataset_share: float,
    split: str | None,
    flown: FlownShare,
) -> Sampler:
    from sim_replay.airframes.invented import KEPT_BACK_VARIANTS, Invention
    from sim_replay.sampler import WindowSampler

    invention = Invention(strangers, KEPT_BACK_VARIANTS)
    acquire = config.acquire_share
    drawn = invention, config.acquire_view, flown
    rendered = WindowSampler(seed, size_px, config.airframe_ids, acquire, config.empty_share, *drawn)
    if not datasets or dataset_share == 0.0:
        return rendered
    cut = [DatasetSampler(path, split, seed, size_px, acquire, config.acquire_view) for path in datasets]
    each = dataset_share / len(cut)
    return MixedSampler([rendered, *cut], [1.0 - dataset_share, *[each] * len(cut)])


def refinement_sampler(
    config: DataConfig,
    seed: int,
    size_px: int,
    strangers: float,
    datasets: Sequence[Path] = (),
    dataset_share: float = 0.0,
    split: str | None = None,
) -> Callable[[], Sampler]:
    """Like `window_sampler`, for `refine`. Of the targets in rendered windows, a share of `strangers` are generated
    aircraft that training never uses. The `datasets` must be others than those trained on, where the
    network's errors are too small; an unreadable one raises ConfigError."""
    for path in datasets:
        DatasetSampler(path, split, seed, size_px, config.acquire_share, config.acquire_view)
    rest = dataset_share, split, _flown(config)
    return partial(_open_refinement_sampler, config, seed, size_px, strangers, datasets, *rest)
