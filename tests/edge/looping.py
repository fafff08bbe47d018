"""The daemon's loop on frames that a test draws, with a search that ends when the test lets it."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from edge.config import Config, ConfigFile
from edge.daemon import Pipeline
from edge.estimator.estimator import Estimator
from edge.estimator.own_parts import OwnParts
from edge.estimator.regions import Region
from edge.health import Reason
from edge.outlets import Outlets
from edge.reload import Reloader
from edge.requests import RequestQueue
from edge.status_board import StatusBoard
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import Array, CameraInfo, Estimate, Frame, FrameMeta, Report

from .toy_scene import SIZE_WH, TARGET_WH, K, draw

HELD, OTHER = (500.5, 420.5), (1400.5, 700.5)
PERIOD_NS = 33_000_000


def box_around(center_px: tuple[float, float]) -> Array:
    half = (np.array(TARGET_WH) - 1) / 2 + 0.5
    return np.array([*(np.array(center_px) - half), *(np.array(center_px) + half)])


def frame(index: int, *centers_px: tuple[float, float]) -> Frame:
    picture = np.maximum.reduce([draw(center) for center in centers_px])
    time_ns = 1_000_000_000 + index * PERIOD_NS
    return Frame(FrameMeta(index, time_ns, time_ns), picture, K)


class Gated(Estimator):
    """Its search of the whole frame ends when it is let, with what it is told."""

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.gate, self.begun = threading.Event(), threading.Event()
        self.sees: list[Estimate] | Exception = []

    def anywhere(
        self, frame: Frame, known_boxes: Sequence[Array], refused: Counter[str], region: Region | None = None
    ) -> list[Estimate]:
        self.begun.set()
        assert self.gate.wait(60)
        if isinstance(self.sees, Exception):
            raise self.sees
        return self.sees


class Ear(Outlets):
    """Keeps what the loop tells."""

    def __init__(self) -> None:
        super().__init__(None, None)
        self.reports: list[Report] = []
        self.events: list[tuple[int, str]] = []
        self.shown: list[Frame] = []

    def event(self, level: int, text: str) -> None:
        self.events.append((level, text))

    def publish(self, report: Report) -> None:
        self.reports.append(report)

    def show(self, frame: Frame) -> None:
        self.shown.append(frame)


class Supply:
    """Frames one after the other."""

    def start(self, settle: Any) -> None: ...

    def newest(self, timeout_s: float) -> Frame | None:
        return None

    def reasons(self, now_ns: int) -> tuple[Reason, ...]:
        return ()

    def counters(self) -> dict[str, int]:
        return {"captured": 0, "dropped": 0}

    def stop(self) -> None: ...


@contextmanager
def looping(
    gated: Gated,
    max_targets: int = 4,
    mount: Mapping[str, float] | None = None,
    readout_ms: float = 0.0,
    own_parts: OwnParts | None = None,
    camera_mount: str = "fixed",
) -> Iterator[tuple[Pipeline, Ear, RequestQueue]]:
    config = Config.model_validate({
        "camera": {"type": "sequence", "path": "/scene", "readout_ms": readout_ms, "mount": camera_mount},
        "zenoh": {"enabled": False}, "mavlink": {"enabled": camera_mount == "gimbal"},
        "estimator": {"acquire_every_n": 5, "max_targets": max_targets}, "mount": mount or {},
    })  # fmt: skip
    board = StatusBoard(ConfigFile(Path("c.toml"), "", config), gated.model, CameraInfo("toy", SIZE_WH, K, 30.0))
    ear, requests = Ear(), RequestQueue()
    pipeline = Pipeline(board, gated, OwnShipBuffer(), ear, Supply(), requests, Reloader(), own_parts)
    pipeline.search.start()
    try:
        yield pipeline, ear, requests
    finally:
        gated.gate.set()
        pipeline.search.stop()
