"""Files of a training run: `weights.pt` (half-precision averaged weights) and `resume.pt` (everything else).

Both are written to a temporary file and renamed, so a crash leaves the last complete one.
"""

from __future__ import annotations

import hashlib
import logging
import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from msgs.contract import samples_behind
from trainer.config import ConfigError, TrainerConfig, parse_config
from trainer.model import ADDED_HEADS, PoseNet
from trainer.unfinished import unfinished

WEIGHTS_NAME = "weights.pt"
RESUME_NAME = "resume.pt"
TRAINING_ONLY_PREFIX = "head_dense."
_log = logging.getLogger(__name__)


def write_atomic(path: Path, content: dict[str, Any]) -> None:
    """torch.save to a temporary file, flush to disk, rename. Raises ConfigError on failure, the old file unchanged."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with unfinished(path) as part, part.open("wb") as file:
            torch.save(content, file)
            file.flush()
            os.fsync(file.fileno())
    except (OSError, RuntimeError) as error:
        # torch's own error does not give the reason; the OSError behind it does.
        why = error if isinstance(error, OSError) else error.__context__
        if not isinstance(why, OSError):
            raise
        raise ConfigError(f"{path}: cannot be written: {why.strerror}") from error


def half_weights(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Matrices and kernels in half precision; vectors (norm statistics, biases) unchanged."""
    return {key: value.half() if value.ndim > 1 else value.clone() for key, value in state.items()}


def deployed_weights(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Weights without the training-only heads. Continued training needs those too: with new random ones, the other
    weights deteriorate."""
    return {key: value for key, value in state.items() if not key.startswith(TRAINING_ONLY_PREFIX)}


def added_heads(state: dict[str, Tensor]) -> tuple[str, ...]:
    """Which of ADDED_HEADS the network with these weights has."""
    return tuple(head for head in ADDED_HEADS if any(key.startswith(f"{head}.") for key in state))


def presence_beside(state: dict[str, Tensor]) -> int:
    """How many presence heads there are beside the first."""
    return len({key.split(".")[2] for key in state if key.startswith("head_presence.beside.")})


def weights_sha256(state: dict[str, Tensor]) -> str:
    """Hash of the deployed weights' names and values, sorted by name; independent of the file format."""
    digest = hashlib.sha256()
    for key in sorted(deployed_weights(state)):
        digest.update(key.encode())
        digest.update(state[key].detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


def save_weights(path: Path, averaged: nn.Module, config_text: str, training: dict[str, str | int | float]) -> None:
    """Write `weights.pt`: weights, the TOML they were trained with, and their origin."""
    write_atomic(path, {"weights": half_weights(averaged.state_dict()), "config": config_text, "training": training})


def load_file(path: Path) -> dict[str, Any]:
    """Read either file. Raises ConfigError naming it if it is missing or no checkpoint."""
    if path.is_dir():
        path = path / WEIGHTS_NAME
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except Exception as error:
        raise ConfigError(f"{path}: not a checkpoint of this program: {type(error).__name__}") from None
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: not a checkpoint of this program: holds a {type(content).__name__}")
    return content


def weights_to_start_from(path: Path, own: dict[str, Tensor]) -> tuple[dict[str, Tensor], str, int | None]:
    """For a network whose weights are `own`: those of another run that fit by name and shape, what to call that run,
    and the training samples behind it (None: unknown).

    Warns of the parts of the network that nothing fits. Raises ConfigError if nothing fits at all.
    """
    content = load_file(path)
    given = content.get("weights", {})
    fitting = {key: value for key, value in given.items() if key in own and own[key].shape == value.shape}
    if not fitting:
        raise ConfigError(f"{path}: contains no weights that fit this network")
    left = [key for key in own if key not in fitting]
    if left:
        parts = ", ".join(dict.fromkeys(key.partition(".")[0] for key in left))
        _log.warning("%s: does not fit %d of %d weights, which begin untrained: %s", path, len(left), len(own), parts)
    return fitting, f"weights {weights_sha256(given)[:16]}", samples_behind(content.get("training", {}))


def load_model(path: Path) -> tuple[PoseNet, TrainerConfig, dict[str, str | int | float], str]:
    """`weights.pt` to an evaluation-ready network (without training-only heads), its configuration, origin and hash."""
    content = load_file(path)
    if not {"weights", "config", "training"} <= content.keys():
        raise ConfigError(f"{path}: contains no weights; give the run folder or its {WEIGHTS_NAME}")
    config = parse_config(content["config"], f"{path} (config)")
    weights = deployed_weights(content["weights"])
    model = PoseNet(config.model.deployed(), added_heads(weights), presence_beside(weights))
    try:
        model.load_state_dict({key: value.float() if value.ndim > 1 else value for key, value in weights.items()})
    except RuntimeError:  # its message has a line for each of some hundred tensors
        raise ConfigError(f"{path}: its weights do not match the network that its [model] describes") from None
    return model.eval(), config, content["training"], weights_sha256(weights)
