"""Other inference engines to time the same network with, provided by other installed packages.

A package registers one under the entry point group GROUP, so the daemon depends on none of them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from edge.bench import openvino
from msgs.contract import ModelContract

GROUP = "uavpose_edge.bench_engines"


class Engine(Protocol):
    """Returns a call that runs one inference on image [1, H, W, 3] and K [1, 3, 3]; None: cannot run this file."""

    def __call__(
        self, path: Path, contract: ModelContract, image: NDArray[np.uint8], K: NDArray[np.float32], threads: int
    ) -> Callable[[], object] | None: ...


def other_engines() -> Mapping[str, Engine]:
    """By name: `openvino` if installed, and those of the entry points whose requirements are installed.

    Loading one may take seconds.
    """
    found: dict[str, Engine] = {"openvino": openvino.engine} if openvino.version() is not None else {}
    for entry in entry_points(group=GROUP):
        try:
            found[entry.name] = entry.load()
        except ModuleNotFoundError as error:
            print(f"{entry.name} is not timed: the package {error.name} is missing", file=sys.stderr)
    return found
