"""The composition of a dataset: the preset file's schema, the shipped presets, and the airframes kept for testing."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from edge.errors import InputError
from msgs.settings import Pair, Section, parse_settings, read_text
from sim_replay.airframes import AIRFRAMES, airframe_id
from sim_replay.airframes.invented import dataset_names
from sim_replay.render.environment import Weather
from sim_replay.render.sensor import Quality

Split = Literal["train", "val", "test"]
Gust = Literal["calm", "light", "moderate"]

SPLITS: tuple[Split, ...] = ("train", "val", "test")
SHIPPED = ("fw-uav6d", "unseen", "stress")
SIDE_MAX_PX = 8192  # of a picture: what OpenGL in software draws
RANGE_LIMITS_M = (95.0, 510.0)  # in the middle of a sequence; sim_replay.flight finds no encounter outside them

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Weight = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


def _rises(name: str, bounds: tuple[float, float]) -> None:
    if bounds[0] > bounds[1]:
        raise ValueError(f"{name} must not fall: {bounds[0]} is above {bounds[1]}")


def _some_weight(name: str, weights: Mapping[Any, float]) -> None:
    if sum(weights.values()) <= 0:
        raise ValueError(f"{name}: no weight is above 0")


class SplitSize(Section):
    sequences: int = Field(ge=1, description="how many sequences")
    frames: int = Field(ge=1, description="frames of all of them together")


class Airframes(Section):
    only: list[str] = Field(default_factory=list, description="names of the airframes to use; empty: all")
    not_those_of: str | None = Field(default=None, description="shipped preset whose `only` is left out here")
    invented: int = Field(
        default=0, ge=0, description="so many that nobody built, of parts of those, instead of them; 0: none"
    )

    @model_validator(mode="after")
    def _known(self) -> Airframes:
        names = [airframe.name for airframe in AIRFRAMES]
        for name in self.only:
            if name not in names:
                raise ValueError(f"only: no airframe is called {name!r}; there are {', '.join(names)}")
        if self.not_those_of is not None and self.not_those_of not in SHIPPED:
            raise ValueError(f"not_those_of: no shipped preset is called {self.not_those_of!r}")
        if self.only and self.not_those_of:
            raise ValueError("give only or not_those_of, not both")
        return self


class Lens(Section):
    focal_px: Pair[Positive] = Field(default=(1200.0, 8000.0), description="shortest and longest there are")
    box_share: float = Field(
        default=0.012, gt=0.0, le=0.1, description="mean share of the picture that the target's visible box covers"
    )
    spread: float = Field(
        default=0.5, ge=0.0, le=1.0, description="scatter (sigma) of the logarithm of the lens chosen"
    )
    distorted_share: Share = Field(default=0.0, description="share of sequences whose lens distorts")

    @model_validator(mode="after")
    def _order(self) -> Lens:
        _rises("focal_px", self.focal_px)
        return self


class Flight(Section):
    gimbal_share: Share = Field(
        default=0.6, description="share of sequences filmed from a gimbal; the rest is bolted on"
    )
    jitter_mrad: Pair[Weight] = Field(default=(0.02, 0.3), description="camera shake, rms, drawn between these")
    gust: dict[Gust, Weight] = Field(
        default={"calm": 1.0, "light": 1.0, "moderate": 1.0}, description="weights of the air's states"
    )
    leaves_share: Share = Field(default=0.0, description="share of sequences in which the target leaves and returns")

    @model_validator(mode="after")
    def _order(self) -> Flight:
        _rises("jitter_mrad", self.jitter_mrad)
        _some_weight("gust", self.gust)
        return self


class Targets(Section):
    two_share: Share = Field(default=0.0, description="share of sequences with two targets")
    three_share: Share = Field(default=0.0, description="share of sequences with three targets")
    empty_share: Share = Field(default=0.0, description="share of frames that lie in sequences without any target")

    @model_validator(mode="after")
    def _sum(self) -> Targets:
        if self.two_share + self.three_share + self.empty_share > 1.0:
            raise ValueError("two_share, three_share and empty_share together exceed 1")
        return self


class Picture(Section):
    weather: dict[Weather, Weight] = Field(min_length=1, description="weights of the kinds of weather")
    quality: dict[Quality, Weight] = Field(min_length=1, description="weights of the kinds of camera")
    exposure_ms: Pair[Positive] = Field(default=(0.5, 5.0), description="shutter time, drawn between these")
    distractors: Pair[int] = Field(default=(0, 2), description="birds and specks in a sequence, between these")

    @model_validator(mode="after")
    def _order(self) -> Picture:
        _rises("exposure_ms", self.exposure_ms)
        _rises("distractors", self.distractors)
        _some_weight("weather", self.weather)
        _some_weight("quality", self.quality)
        if self.distractors[0] < 0:
            raise ValueError("distractors cannot be fewer than 0")
        return self


class Compression(Section):
    weight: Positive = Field(default=1.0, description="how often it is drawn")
    jpeg_quality: Pair[int] = Field(default=(85, 95), description="of the stored pictures, drawn between these")
    h264_kbps: Pair[int] | None = Field(
        default=None, description="pass the sequence through H.264 at a bitrate drawn between these before storing it"
    )

    @model_validator(mode="after")
    def _range(self) -> Compression:
        _rises("jpeg_quality", self.jpeg_quality)
        if not 1 <= self.jpeg_quality[0] <= self.jpeg_quality[1] <= 100:
            raise ValueError("jpeg_quality lies between 1 and 100")
        if self.h264_kbps is not None:
            _rises("h264_kbps", self.h264_kbps)
            if self.h264_kbps[0] < 50:
                raise ValueError("h264_kbps must be at least 50")
        return self


class Preset(Section):
    """A whole dataset. Every key but the first four tables has a default."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$", description="lower case, digits and hyphens")
    description: str = Field(default="", description="one sentence, copied into the dataset")
    splits: dict[Split, SplitSize] = Field(min_length=1, description="how many sequences and frames each split has")
    picture: Picture
    size_wh_px: Pair[int] = Field(default=(1920, 1080), description="width and height of the pictures")
    fps: list[Positive] = Field(
        default_factory=lambda: [10.0, 15.0, 30.0], min_length=1, description="rates drawn from"
    )
    sequence_frames: Pair[int] = Field(default=(40, 160), description="shortest and longest sequence")
    range_m: Pair[Positive] = Field(default=(100.0, 500.0), description="distances, spread evenly over frames")
    airframes: Airframes = Airframes()
    lens: Lens = Lens()
    flight: Flight = Flight()
    targets: Targets = Targets()
    compression: list[Compression] = Field(default_factory=lambda: [Compression()], min_length=1)

    @model_validator(mode="after")
    def _possible(self) -> Preset:
        _rises("range_m", self.range_m)
        if self.range_m[0] < RANGE_LIMITS_M[0] or self.range_m[1] > RANGE_LIMITS_M[1]:
            raise ValueError("range_m must lie within {:g} and {:g} m".format(*RANGE_LIMITS_M))
        _rises("sequence_frames", self.sequence_frames)
        shortest, longest = self.sequence_frames
        if shortest < 2:
            raise ValueError("sequence_frames must be at least 2")
        if min(self.size_wh_px) < 64 or max(self.size_wh_px) > SIDE_MAX_PX:
            raise ValueError(f"size_wh_px must be at least 64 by 64 and at most {SIDE_MAX_PX} by {SIDE_MAX_PX}")
        if any(side % 2 for side in self.size_wh_px) and any(c.h264_kbps for c in self.compression):
            raise ValueError("size_wh_px must be even where compression has h264_kbps")
        frame_ms = 1000.0 / max(self.fps)
        if self.picture.exposure_ms[1] > frame_ms:
            raise ValueError(f"picture.exposure_ms must not exceed a frame's {frame_ms:g} ms at fps {max(self.fps):g}")
        for name, size in self.splits.items():
            if not size.sequences * shortest <= size.frames <= size.sequences * longest:
                raise ValueError(
                    f"splits.{name}: {size.frames} frames cannot be cut into {size.sequences} sequences of "
                    f"{shortest} to {longest}"
                )
        self.airframe_names()  # raises if few parts cannot give as many as requested
        return self

    def airframe_names(self) -> tuple[str, ...]:
        """The airframes that this dataset shows: in the fleet's order, or invented ones."""
        if self.airframes.only:
            chosen = set(self.airframes.only)
        else:
            left_out = self.airframes.not_those_of
            chosen = {airframe.name for airframe in AIRFRAMES}
            chosen -= set(load_preset(left_out).airframes.only) if left_out else set()
        names = tuple(airframe.name for airframe in AIRFRAMES if airframe.name in chosen)
        invented = self.airframes.invented
        return dataset_names(invented, [airframe_id(name) for name in names]) if invented else names


def held_out_airframes() -> tuple[str, ...]:
    """Airframes of the `unseen` preset: no training image may show them."""
    return load_preset("unseen").airframe_names()


def preset_text(name_or_path: str) -> tuple[str, str]:
    """(location, text) of a shipped preset or a TOML file. Raises InputError."""
    if name_or_path in SHIPPED:
        resource = files("sim_replay").joinpath("presets", f"{name_or_path}.toml")
        return f"{name_or_path}.toml", resource.read_text(encoding="utf-8")
    path = Path(name_or_path)
    if path.suffix != ".toml":
        raise InputError(f"no preset is called {name_or_path!r}; there are {', '.join(SHIPPED)}, or name a .toml file")
    return str(path), read_text(path, InputError)


def load_preset(name_or_path: str) -> Preset:
    """Read a shipped preset by name, or a file. Raises InputError: one line per error, each naming file and key."""
    return parse_preset(*preset_text(name_or_path))


def parse_preset(place: str, text: str) -> Preset:
    """The preset in `text`, which is located at `place`. Raises InputError."""
    return parse_settings(text, place, Preset, InputError)
