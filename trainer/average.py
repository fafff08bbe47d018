"""The mean of several runs' weights; often better than each, if they started from the same (Wortsman et al., 2022)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from trainer.checkpoint import RESUME_NAME, WEIGHTS_NAME, deployed_weights, load_file, load_model, write_atomic
from trainer.config import ConfigError, made_folder

# Cosine between the matrices of one part of two networks. It is about 0 if they began with different random weights,
# however long they were trained, and far above this if they began alike, even millions of training windows ago.
LEAST_ALIKE = 0.3
_log = logging.getLogger(__name__)


def average(runs: Sequence[Path], out: Path) -> Path:
    """Write weights.pt with the mean of the runs' weights into `out`; configuration and origin are the last run's.

    Raises ConfigError for fewer than two runs, for different network configurations, and for unrelated weights. Warns
    of runs trained on the same windows.
    """
    if len(runs) < 2:
        raise ConfigError("average needs at least two runs")
    if (out / RESUME_NAME).exists():
        raise ConfigError(f"{out}: contains a run that can be resumed; give another --out")
    contents = [load_file(run) for run in runs]
    _, configs, _, hashes = zip(*map(load_model, runs), strict=True)
    for run, config in zip(runs, configs, strict=True):
        if config.model.deployed() != configs[-1].model.deployed():
            raise ConfigError(f"{run}: its [model] differs from that of {runs[-1]}")
    for run, content in zip(runs, contents, strict=True):
        _refuse_unrelated(run, content["weights"], runs[-1], contents[-1]["weights"])
    _warn_of_the_same_windows(runs, [config.data.seed for config in configs])
    known = {(source.path.resolve(), source.split) for source in configs[-1].data.datasets}
    for run, config in zip(runs, configs, strict=True):
        for source in config.data.datasets:
            if (source.path.resolve(), source.split) not in known:
                told = "%s: was trained on %s (%s), of which the mean, with the last run's configuration, knows nothing"
                _log.warning(told, run, source.path, source.split)
    last, every = contents[-1], [content["weights"] for content in contents]
    weights = {
        # Training-only heads may be missing in some runs; they are averaged over the others.
        name: torch.stack([w[name].double() for w in every if name in w]).mean(0).to(value.dtype)
        if value.is_floating_point()
        else value
        for name, value in last["weights"].items()
    }
    training = last["training"] | {"mean_of": ", ".join(sha256[:16] for sha256 in hashes)}
    path = made_folder(out) / WEIGHTS_NAME
    write_atomic(path, last | {"weights": weights, "training": training})
    return path


def _refuse_unrelated(run: Path, weights: dict[str, Tensor], last_run: Path, last: dict[str, Tensor]) -> None:
    """Raises ConfigError naming the parts of the network, such as heads, that began with other random weights."""
    mine, others = _matrices(weights), _matrices(last)
    unrelated = [
        part
        for part in others
        if part in mine and mine[part] @ others[part] < LEAST_ALIKE * mine[part].norm() * others[part].norm()
    ]
    if unrelated:
        raise ConfigError(
            f"{run}: has nothing in common with {last_run} in {', '.join(unrelated)}: a mean of unrelated weights is "
            "of no use; give runs that started from the same weights, and refine only their mean"
        )


def _warn_of_the_same_windows(runs: Sequence[Path], seeds: list[int]) -> None:
    """A continuation whose configuration kept the seed goes through the same windows once more."""
    for seed in sorted(set(seeds)):
        alike = " and ".join(str(run) for run, its in zip(runs, seeds, strict=True) if its == seed)
        if seeds.count(seed) > 1:
            told = "%s were trained with the same [data] seed, %d, so on much the same windows: the mean gains little"
            _log.warning(told, alike, seed)


def _matrices(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    """All matrices and kernels of each deployed part of the network, as one vector; the scales of norms are alike in
    all networks."""
    parts: dict[str, list[Tensor]] = {}
    for name, value in sorted(deployed_weights(weights).items()):
        if value.ndim > 1:
            parts.setdefault(name.partition(".")[0], []).append(value.double().flatten())
    return {part: torch.cat(values) for part, values in parts.items()}
