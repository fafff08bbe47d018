"""The trainer's typed configuration, read from TOML. Unknown keys are refused; errors name the file and the key."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Literal

from pydantic import ConfigDict, Field, Strict, field_validator, model_validator

from msgs.contract import Span
from msgs.settings import Pair, Section, WrittenPath, load_settings, parse_settings
from sim_replay.sample import AcquireView

Side = Annotated[int, Field(ge=32, multiple_of=32)]  # of a network input, pixels
Seed = Annotated[int, Field(ge=0, lt=2**32)]  # torch takes 64 bits, of the seed times a million
Z_RANGE_M = (50.0, 600.0)  # depths that a network can predict
REFINED_HEADS = ("refinement", "presence", "choice")  # that `refine` can train, each alone
REFINED_BY_DEFAULT = REFINED_HEADS[:2]  # the third is not better everywhere (docs/ablation.md)
BackboneName = Literal["efficientnet_lite0", "repvit_m0_9", "repvit_m0_9_relu", "repvit_small"]


class ConfigError(ValueError):
    """An invalid configuration; the message names the file and the key."""


class RenderingError(RuntimeError):
    """A rendering process failed; the message carries its traceback."""


def made_folder(path: Path) -> Path:
    """Create the folder if it does not exist, and return it. Raises ConfigError if it cannot be created or written."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be made a folder: {error.strerror}") from None
    refuse_no_folder(path)
    return path


def refuse_no_folder(path: Path) -> None:
    """Raises ConfigError if made_folder could not create a writable folder; a check before a long computation."""
    there = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not there.is_dir():
        raise ConfigError(f"{path}: cannot be made a folder: {there} is a file")
    if not os.access(there, os.W_OK | os.X_OK):
        raise ConfigError(f"{path}: cannot be written: {there} is read-only, or belongs to another user")


class Table(Section):
    """A section all of whose numbers are finite."""

    model_config = ConfigDict(allow_inf_nan=False)


class ModelConfig(Table):
    configuration: Literal["edge", "paper"] = Field(description="which of the two configurations this is")
    backbone: BackboneName
    pretrained: bool = Field(description="start from public ImageNet weights (efficientnet_lite0 only)")
    channels: int = Field(128, ge=8, description="C of F_global")
    hidden: int = Field(256, ge=8, description="width of the embedding, of gamma and beta, and of the branches")
    soft_argmax_sigma_cells: float | None = Field(None, gt=0, description="sigma_g in cells; absent: W_f / 32")
    box_anchor_px: float | None = Field(None, gt=0, description="scale anchor a in pixels; absent: (0.1 W, 0.1 H)")
    origin_range: float = Field(1.25, gt=0, description="lambda_o")
    focal: Literal["mean", "geometric"] = Field(description="(fx + fy) / 2 or sqrt(fx fy)")
    center: Literal["heatmap", "regressed"] = Field(
        "heatmap", description="where a target's features come from: a heatmap's peak, or the whole image's mean"
    )
    ray: bool = Field(True, description="PAM: modulate by the observation ray, and turn rotations by it")
    topology: bool = Field(True, description="DTS: the eight-point context, beside the dense region")
    depth: Literal["direct", "plain", "rotation_aware"] = Field(
        description="Z itself, or APDD with a scale that is free or made of latent extents seen from R"
    )
    uncertainty: bool = Field(description="train the head that tells sigma and corrects the range")
    hypotheses: int = Field(
        1, ge=1, description="rotations proposed for a target, each for headings around its own; the likeliest is said"
    )
    dense: bool = Field(description="train the mask and object-coordinate heads, which export drops")
    max_peaks: int = Field(4, ge=1, description="M: targets decoded for each image")

    def deployed(self) -> ModelConfig:
        """Configuration for inference: without training-only heads, and without loading pretrained weights."""
        return self.model_copy(update={"pretrained": False, "dense": False})

    @model_validator(mode="after")
    def _pretrained_exists(self) -> ModelConfig:
        if self.pretrained and self.backbone != "efficientnet_lite0":
            raise ValueError(f"there are no public weights for backbone {self.backbone!r}: set pretrained = false")
        return self


class LossConfig(Table):
    """Weights of the joint loss; `heatmap`, `size`, `translation`, `rotation` are the paper's lambda_1..4."""

    heatmap: float = Field(50.0, ge=0)
    size: float = Field(4.0, ge=0)
    translation: float = Field(4.0, ge=0)
    rotation: float = Field(25.0, ge=0)
    depth: float = Field(20.0, ge=0, description="mu_1, on log Z")
    planar: float = Field(50.0, ge=0, description="mu_2, on T_xy / Z")
    depth_beta: float = Field(1.0, gt=0, description="where SmoothL1 of log Z turns from square to linear")
    size_beta: float = Field(0.1, gt=0, description="where SmoothL1 of log w and log h turns from square to linear")
    rotation_6d: float = Field(5.0, ge=0, description="eta")
    hypothesis: float = Field(0.0, ge=0, description="cross-entropy of the rotation hypotheses")
    center: float = Field(0.0, ge=0, description="soft-argmax centre, in cells")
    origin: float = Field(0.0, ge=0, description="projected body origin, in longer box sides")
    mask: float = Field(0.0, ge=0)
    noc: float = Field(0.0, ge=0)
    uncertainty: float = Field(0.0, ge=0)


class DatasetSource(Table):
    """A BOP dataset whose images are trained on in addition to rendered windows."""

    path: WrittenPath
    split: str = Field("train", description="folder of the dataset that is trained on")
    validation_split: str | None = Field(None, description="folder to validate on; absent: rendered windows only")
    share: float = Field(gt=0, le=1, description="of every batch")


class DataConfig(Table):
    seed: Seed
    validation_seed: Seed
    airframe_ids: list[int] | None = Field(None, description="absent: the sampler's own choice")
    hard_airframe_ids: list[int] = Field([], description="of those, drawn twice as often in training as the others")
    acquire_share: float = Field(0.3, ge=0, le=1, description="share of views as the acquire stage sees them")
    acquire_view: AcquireView = Field(
        "crop", description="a window of the reduced frame, or the whole frame squashed, as contract.acquire_fit has it"
    )
    empty_share: float = Field(0.12, ge=0, lt=1, description="share of windows without a target")
    invented_share: float = Field(0.0, ge=0, le=1, description="of rendered targets: no member of the fleet")
    flown: list[WrittenPath] = Field(
        [], description="generated datasets (with or without pictures) whose poses and cameras rendered windows take"
    )
    flown_share: float = Field(0.0, ge=0, le=1, description="of the rendered windows: show a frame of `flown` anew")
    replays: int = Field(
        0, ge=0, description="steps over earlier windows, mirrored and relit, after each over new ones"
    )
    replay_windows: int = Field(
        100_000, ge=2, description="the last windows, which those are of: 0.18 MB each at 224 px"
    )
    batch_size: int = Field(ge=2)
    workers: int = Field(1, ge=1, description="rendering processes")
    prefetch: int = Field(4, ge=1, description="batches kept ready by each worker")
    validation_samples: int = Field(256, ge=8)
    datasets: list[DatasetSource] = Field([], description="absent: rendered windows alone")

    @field_validator("airframe_ids")
    @classmethod
    def _of_the_fleet(cls, ids: list[int] | None) -> list[int] | None:
        from sim_replay.airframes import AIRFRAMES

        if ids is not None and (not ids or len(set(ids)) < len(ids) or not set(ids) <= set(range(len(AIRFRAMES)))):
            raise ValueError(f"must be some of the fleet's numbers, 0 to {len(AIRFRAMES) - 1}, each once")
        return ids

    @property
    def rendered_share(self) -> float:
        """Share of rendered windows in every batch: the remainder after the datasets."""
        rest = 1.0 - sum(source.share for source in self.datasets)
        return rest if rest > 1e-6 else 0.0

    @model_validator(mode="after")
    def _shares_fit(self) -> DataConfig:
        if sum(source.share for source in self.datasets) > 1.0 + 1e-9:
            raise ValueError("the shares of datasets add up to more than 1")
        return self

    @model_validator(mode="after")
    def _hard_ones_are_among_them(self) -> DataConfig:
        if self.hard_airframe_ids and not set(self.hard_airframe_ids) <= set(self.airframe_ids or []):
            raise ValueError("hard_airframe_ids must be some of airframe_ids")
        return self

    @model_validator(mode="after")
    def _flown_have_a_share(self) -> DataConfig:
        if bool(self.flown) != (self.flown_share > 0.0):
            raise ValueError("flown and flown_share need each other")
        return self

    @model_validator(mode="after")
    def _seeds_differ(self) -> DataConfig:
        if self.seed == self.validation_seed:
            raise ValueError("validation_seed must differ from seed: the validation windows are held out")
        return self


class SizeStage(Table):
    from_progress: float = Field(ge=0, lt=1, description="share of the run after which this size is used")
    size_px: Side


class ScheduleConfig(Table):
    samples: int = Field(ge=1, description="planned number of training samples")
    warmup_samples: int = Field(ge=0)
    lr: float = Field(5e-4, gt=0)
    lr_final: float = Field(1e-5, gt=0)
    backbone_lr_scale: float = Field(1.0, gt=0)
    frozen_blocks: int = Field(
        0,
        ge=0,
        description="first blocks (of a RepViT: stages) that stay, with the stem, as the run began; 0: all learn",
    )
    fixed_norms: bool = Field(
        False, description="norm statistics stay as the run began, which must be from trained weights: a faster step"
    )
    weight_decay: float = Field(0.01, ge=0)
    gradient_clip: float = Field(5.0, gt=0)
    ema_decay: float = Field(0.999, ge=0, lt=1)
    teacher_until: float = Field(0.4, ge=0, le=1, description="progress at which true centres and boxes stop guiding")
    rounded_from: float = Field(
        1.0, ge=0, le=1, description="progress from which convolutions see the rounding of INT8; 1: never"
    )
    sizes: list[SizeStage] = Field(min_length=1)

    @model_validator(mode="after")
    def _sizes_start_and_rise(self) -> ScheduleConfig:
        starts = [stage.from_progress for stage in self.sizes]
        if starts[0] != 0 or starts != sorted(set(starts)):
            raise ValueError("sizes must start at from_progress = 0 and rise")
        return self


class RunConfig(Table):
    threads: int = Field(2, ge=1, description="CPU threads of the training process")
    bf16: bool = Field(True, description="run the convolutions in bfloat16")
    log_every_steps: int = Field(25, ge=1)
    validate_every_samples: int = Field(8000, ge=1)
    checkpoint_every_s: float = Field(120.0, gt=0)


class ContractConfig(Table):
    """Parts of the model's contract that export cannot measure."""

    name: str
    acquire_size_wh: Pair[Side]
    acquire_fit: Literal["letterbox", "squash"]
    track_size_wh: Pair[Side] | None = None
    track_window_scale: float = Field(gt=1.0)
    trained_range_m: Annotated[Span, Strict(False)] | None = Field(
        None, description="depths; absent: 100 to 500 m of rendered windows, and those that the datasets' targets have"
    )

    @model_validator(mode="after")
    def _windows_are_square(self) -> ContractConfig:
        if self.track_size_wh is not None and len(set(self.track_size_wh)) > 1:
            raise ValueError("track_size_wh must be square: training windows are")
        return self


class TrainerConfig(Table):
    model: ModelConfig
    loss: LossConfig
    data: DataConfig
    schedule: ScheduleConfig
    run: RunConfig
    contract: ContractConfig

    @model_validator(mode="after")
    def _trained_as_used(self) -> TrainerConfig:
        squashed = self.contract.acquire_fit == "squash"
        if squashed != (self.data.acquire_view == "frame"):
            raise ValueError(
                'data.acquire_view = "frame" and contract.acquire_fit = "squash" belong together: '
                "the acquire stage must see what it was trained on"
            )
        width_px, height_px = self.contract.acquire_size_wh
        if squashed and width_px != height_px:
            raise ValueError("contract.acquire_size_wh must be square where frames are squashed: training windows are")
        return self


def parse_config(text: str, source: str) -> TrainerConfig:
    """TOML text to a configuration. Raises ConfigError naming `source` and every invalid key."""
    return parse_settings(text, source, TrainerConfig, ConfigError)


def load_config(path: Path) -> TrainerConfig:
    """Read a TOML file. Raises ConfigError if it is missing or invalid."""
    return load_settings(path, TrainerConfig, ConfigError)
