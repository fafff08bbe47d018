"""Status answers of the daemon: zenoh queries on `uavpose/@v1/<uav>/info`, `config` and `model`, answered in JSON.

`info` is its state, at most a second old (`age_s`); `config` is the configuration in use, without passwords in
addresses; `model` is the model's contract, hash and file.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import zenoh
from zenoh import handlers

from edge import clock
from edge.addresses import no_passwords
from edge.config import ConfigFile
from edge.estimator.model import Model
from edge.health import HealthSnapshot
from edge.types import CameraInfo
from msgs.topics import check_uav_name

DISTRIBUTION = "mf-uavpose6d-edge"


class StatusBoard:
    """Written by the loop, always as whole values; read from any thread."""

    def __init__(self, file: ConfigFile, model: Model, camera: CameraInfo) -> None:
        self.file = file
        self.model = model
        self.camera = camera
        self.image_size_wh = camera.image_size_wh  # of the newest frame; before the first, as the camera was opened
        self.snapshot: HealthSnapshot | None = None
        self._start_ns = clock.monotonic_ns()
        self._version = importlib.metadata.version(DISTRIBUTION)

    def facts(self) -> dict[str, str]:
        """What the daemon runs with, in short."""
        return {"version": self._version, "model_sha256": self.model.sha256, "model_provider": self.model.provider}

    def info(self) -> dict[str, Any]:
        snapshot, now_ns = self.snapshot, clock.monotonic_ns()
        width, height = self.image_size_wh
        told: dict[str, Any] = {
            "vehicle": self.file.config.vehicle.name,
            "pid": os.getpid(),
            "uptime_s": round((now_ns - self._start_ns) / 1e9, 3),
            "camera": f"{self.camera.name} {width}x{height}",
            **self.facts(),
        }
        if snapshot is not None:
            told |= {
                "age_s": round((now_ns - snapshot.time_ns) / 1e9, 3),
                "state": snapshot.condition.state.value,
                "activity": snapshot.condition.activity.value,
                "reasons": list(snapshot.condition.texts),
                "reason_kinds": [reason.kind for reason in snapshot.condition.reasons],
                "tracks": snapshot.tracks,
                "frame_rate_hz": round(snapshot.frame_rate_hz, 2),
                "counters": dict(snapshot.counters),
                "latency_ms": {stage: asdict(p) for stage, p in snapshot.latency_ms.items()},
            }
        return told

    def config(self) -> dict[str, Any]:
        return {"file": str(self.file.path), "config": no_passwords(self.file.config.model_dump(mode="json"))}

    def model_card(self) -> dict[str, Any]:
        model = self.model
        return {
            "file": str(model.path),
            "sha256": model.sha256,
            "provider": model.provider,
            "fallback_reason": model.fallback_reason,
            "contract": model.contract.model_dump(mode="json"),
        }


def key_of(uav: str, what: str) -> str:
    """Key for queries of `what` (info, config, model) of a vehicle; `uav` may be `*`."""
    return f"uavpose/@v1/{uav if uav == '*' else check_uav_name(uav)}/{what}"


def declare_status(session: zenoh.Session, board: StatusBoard) -> Callable[[], None]:
    """Answer queries, on zenoh's receiving thread, until the returned function is called."""
    uav = board.file.config.vehicle.name
    asked = {"info": board.info, "config": board.config, "model": board.model_card}
    declared = []
    for what, tell in asked.items():
        key = key_of(uav, what)
        declared.append(session.declare_queryable(key, handlers.Callback(_answer(key, tell), indirect=False)))

    def undeclare() -> None:
        for queryable in declared:
            queryable.undeclare()

    return undeclare


def _answer(key: str, tell: Callable[[], dict[str, Any]]) -> Callable[[zenoh.Query], None]:
    def on_query(query: zenoh.Query) -> None:
        with query:
            query.reply(key, json.dumps(tell()), encoding=zenoh.Encoding.APPLICATION_JSON)

    return on_query
