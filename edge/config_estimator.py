"""Configuration of what turns frames into poses: the model, the targets' size, the estimator."""

from __future__ import annotations

from pathlib import Path

from pydantic import Field, model_validator

from edge.config_path import ConfigPath
from edge.estimator.given_size import TargetSize
from edge.estimator.providers import Provider
from msgs.settings import Section

SHIPPED_MODEL = Path(__file__).parent / "estimator" / "models" / "mf-uavpose6d-edge-int8.onnx"


class ModelSettings(Section):
    path: ConfigPath = Field(default=SHIPPED_MODEL, description="ONNX file with its contract in the metadata")
    provider: Provider = Field(
        default="cpu",
        description="execution provider; if it is not available, or fails, the CPU takes over, with a warning",
    )
    threads: int = Field(default=2, ge=1, le=64, description="CPU threads per inference")
    spinning: bool = Field(
        default=False,
        description="threads spin between inferences: faster on an idle machine, slower beside other load",
    )


class EstimatorSettings(Section):
    max_targets: int = Field(default=4, ge=1, le=4, description="maximum number of simultaneously tracked targets")
    acquire_every_n: int = Field(
        default=15,
        ge=1,
        description="while tracking, search every N frames: the whole frame and, if it is large, its tiles in turn",
    )


class TargetSettings(Section):
    """Size of the aircraft to be seen, from its data sheet. Without it, the range of an aircraft that the model was not
    trained on is wrong by a third or more. With a wrong size, the range is wrong by as much: leave it out where
    aircraft of different types may be in view."""

    wingspan_m: float | None = Field(default=None, ge=0.5, le=100, description="wingspan, metres; needs length_m")
    length_m: float | None = Field(
        default=None, ge=0.3, le=100, description="from nose to tail, metres; needs wingspan_m"
    )

    @model_validator(mode="after")
    def _both(self) -> TargetSettings:
        if (self.wingspan_m is None) != (self.length_m is None):
            raise ValueError("give both wingspan_m and length_m, or neither")
        return self

    def size(self) -> TargetSize | None:
        """None: not given."""
        if self.wingspan_m is None or self.length_m is None:
            return None
        return TargetSize(self.wingspan_m, self.length_m)
