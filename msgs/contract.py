"""The contract between the trainer, which exports a model, and the daemon, which flies it.

It is stored inside the ONNX file (metadata key `uavpose_contract`, JSON), so that a file documents its own inputs,
outputs and origin. The graph's interface:

    inputs   image  uint8   [N, H, W, 3]  BGR pixels, as OpenCV decodes them; normalisation is inside the graph
             K      float32 [N, 3, 3]     intrinsics of exactly these pixels (pixel centres at integers)
    outputs  score        float32 [N, M]        that a peak is a target, 0..1; peaks in descending order of the heatmap
             center_px    float32 [N, M, 2]     centre of the visible box, pixels of `image`
             size_px      float32 [N, M, 2]     width and height of the visible box
             origin_px    float32 [N, M, 2]     projection of the target's body origin
             t_cam_target_m  float32 [N, M, 3]
             R_cam_target    float32 [N, M, 3, 3]
             sigma        float32 [N, M, 6]     1-sigma of (u px, v px, log Z, rotation x, y, z rad in `cam`)

H and W are any multiples of 32; M = `max_peaks`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PositiveInt

METADATA_KEY = "uavpose_contract"
CONTRACT_VERSION = 1
INPUT_NAMES = ("image", "K")
OUTPUT_NAMES = ("score", "center_px", "size_px", "origin_px", "t_cam_target_m", "R_cam_target", "sigma")


class ScoreCalibration(BaseModel):
    """Maps a peak's score to the probability that it is a target, which also depends on the target's apparent size.

    logit p = offset + slope logit(score) + size_slope ln(min(shown, size_cap)), where `shown` is the geometric mean of
    the box's sides, in pixels of the network or of the frame, whichever are fewer. The defaults leave the score
    unchanged.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    offset: float = 0.0
    slope: float = Field(default=1.0, gt=0)
    size_slope: float = 0.0
    size_cap_px: float = Field(default=1.0, gt=0)

    def probability(self, score: float, shown_px: float) -> float:
        """Probability for a score in 0..1 with a box of `shown_px`; 0 if either is not finite."""
        if not (math.isfinite(score) and math.isfinite(shown_px)):
            return 0.0
        score = min(max(score, _SCORE_LEAST), 1.0 - _SCORE_LEAST)
        size = math.log(min(max(shown_px, 1.0), self.size_cap_px))
        logit = self.offset + self.slope * math.log(score / (1.0 - score)) + self.size_slope * size
        return 1.0 / (1.0 + math.exp(-min(max(logit, -_LOGIT_MOST), _LOGIT_MOST)))


_SCORE_LEAST = 1e-6
_LOGIT_MOST = 30.0


def samples_behind(training: Mapping[str, str | int | float]) -> int | None:
    """Training samples behind weights, summed over all runs; None if their file does not record it (older files)."""
    begun = str(training.get("started_from", ""))
    before = training.get("samples_before", None if begun.startswith("weights ") else 0)
    return None if before is None or "samples" not in training else int(training["samples"]) + int(before)


def _span(low_high: tuple[float, float]) -> tuple[float, float]:
    if not 0.0 < low_high[0] < low_high[1]:
        raise ValueError("takes two numbers above 0, the lower one first")
    return low_high


def _span_or_point(low_high: tuple[float, float]) -> tuple[float, float]:
    return low_high if 0.0 < low_high[0] == low_high[1] else _span(low_high)


Span = Annotated[tuple[float, float], AfterValidator(_span)]


class ModelContract(BaseModel):
    """Everything that the daemon, or a user, needs to know about a model."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    version: int = Field(CONTRACT_VERSION, description="version of this contract's layout")
    name: str = Field(description="name of the model")
    configuration: Literal["edge", "paper"]
    backbone: str
    precision: Literal["fp32", "int8"]
    max_peaks: int = Field(ge=1, description="M: targets decoded for each image")
    acquire_size_wh: tuple[PositiveInt, PositiveInt] = Field(description="network input of the whole frame, pixels")
    acquire_fit: Literal["letterbox", "squash"] = Field(description="how a whole frame is fitted into it")
    track_size_wh: tuple[PositiveInt, PositiveInt] | None = Field(
        description="network input of a track window; None: no track stage"
    )
    track_window_scale: float = Field(
        gt=1.0, description="side of the window on the frame / longer side of the target's box"
    )
    acquire_score: ScoreCalibration = ScoreCalibration()
    track_score: ScoreCalibration = ScoreCalibration()
    acquire_score_min: float = Field(ge=0, le=1, description="less probable of frame and windows together: no target")
    track_score_min: float = Field(ge=0, le=1, description="a window's peak of lower probability is no target")
    pixel_mean_bgr: tuple[float, float, float] | None = Field(
        None, description="what the graph subtracts from a pixel's bytes; None: the file is older than this key"
    )
    pixel_std_bgr: tuple[float, float, float] | None = Field(None, description="and divides the rest by")
    depth_limits_m: Span = Field(
        (50.0, 600.0), description="the graph keeps its depths within; one told at a limit may lie beyond it"
    )
    trained_range_m: Span
    # May be a single value: whole frames of one fixed camera have one focal length.
    trained_focal_px: Annotated[tuple[float, float], AfterValidator(_span_or_point)]
    trained_box_px: Span = Field(description="longer side of the visible box in network pixels, as trained")
    airframes: list[str] = Field(description="airframe classes in the training data")
    data: str = Field("", description="what it was trained on; empty: the file is older than this key")
    training: dict[str, str | int | float] = Field(
        description="seed, samples of the last run and of those it began from, resolution, commit"
    )
    metrics: dict[str, float] = Field(description="measured when the file was made; empty if not measured")
    weights_sha256: str = Field(description="hash of the float weights the graph was made from")

    @property
    def scores_calibrated(self) -> bool:
        """Whether the scores of tracks are probabilities; otherwise they are the network's own."""
        stage = self.acquire_score if self.track_size_wh is None else self.track_score
        return stage != ScoreCalibration()
