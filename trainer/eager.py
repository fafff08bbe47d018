"""PyTorch eager mode as an engine of `uavpose-edge bench`: inference time of the network before export."""

from __future__ import annotations

from collections.abc import Callable
from importlib.resources import files
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from msgs.contract import ModelContract
from trainer.backbones import fuse_branches
from trainer.config import load_config
from trainer.model import PoseNet


def engine(
    path: Path, contract: ModelContract, image: NDArray[np.uint8], K: NDArray[np.float32], threads: int
) -> Callable[[], object] | None:
    """`edge.bench.engines.Engine`: the float network built from this package's config of the file's configuration, with
    random weights, which do not affect the time. None for an INT8 file, and for a file with another backbone than that
    configuration.
    """
    if contract.precision != "fp32":
        return None
    config = load_config(Path(str(files("trainer") / "configs" / f"{contract.configuration}.toml")))
    if contract.backbone != config.model.backbone:
        return None
    model = fuse_branches(PoseNet(config.model.deployed()).eval())
    inputs = torch.from_numpy(image), torch.from_numpy(K)

    def infer() -> object:
        # Set on every call: the number is global to the process, and benchmarks with other numbers are interleaved.
        torch.set_num_threads(threads)
        with torch.inference_mode():
            return model(*inputs)

    return infer
