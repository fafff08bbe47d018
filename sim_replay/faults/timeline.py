"""The schema of a timeline: steps in order, each an act on the rig or an expectation.

title = "The autopilot's link is cut for six seconds"

[[step]]
do = "link"
which = "mavlink"
cut = true

[[step]]
do = "hold"
for_s = 6.0

[[step]]
do = "link"
which = "mavlink"

[[step]]
do = "expect_poses"
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, field_validator, model_validator

from edge.errors import InputError
from msgs.mavlink import dialect
from msgs.settings import Section, load_settings

Who = Literal["camera", "daemon", "autopilot", "router", "subscriber"]
Peer = Literal["autopilot", "subscriber", "both"]
Seconds = Annotated[float, Field(gt=0, le=600)]


def _expression(pattern: str) -> str:
    try:
        re.compile(pattern)
    except re.error as error:
        raise ValueError(f"is not a regular expression: {error}") from error
    return pattern


Pattern = Annotated[str, AfterValidator(_expression)]
WITHIN_S = 60.0  # enough for a loaded machine; the time it took is reported


class Hold(Section):
    """Leave everything as it is."""

    do: Literal["hold"]
    for_s: Seconds


class Start(Section):
    do: Literal["start"]
    who: Who
    system_id: int = Field(default=1, ge=1, le=255, description="autopilot: its MAVLink system id")
    rebooted: bool = Field(default=False, description="autopilot: its boot clock starts at 0")
    clock_ahead_s: float = Field(
        default=0.0, ge=-60, le=60, description="autopilot: its boot clock minus the previous one's"
    )

    @model_validator(mode="after")
    def _does_something(self) -> Start:
        of_autopilot = self.model_fields_set & {"system_id", "rebooted", "clock_ahead_s"}
        if self.who != "autopilot" and of_autopilot:
            raise ValueError(f"{min(of_autopilot)} applies to an autopilot, not to the {self.who}")
        return self


class Signal(Section):
    """STOP freezes a process, CONT resumes it; KILL and TERM wait for its end."""

    do: Literal["signal"]
    who: Who
    name: Literal["TERM", "KILL", "HUP", "STOP", "CONT"]


class Camera(Section):
    """How the camera behaves from now on; what is left out returns to normal."""

    do: Literal["camera"]
    frozen: bool = Field(default=False, description="the same image with new stamps")
    covered: bool = Field(default=False, description="images of noise, nearly black")
    stamp_offset_s: float = Field(default=0.0, ge=-60, le=60, description="added to each stamp")
    stamp_jitter_s: float = Field(
        default=0.0, ge=0, le=60, description="alternately added and subtracted, frame by frame"
    )


class Link(Section):
    """State of a link from now on; what is left out returns to normal, so `which` alone restores it."""

    do: Literal["link"]
    which: Literal["mavlink", "zenoh"] = Field(description="daemon to autopilot, or daemon to router")
    cut: bool = False
    delay_ms: float = Field(default=0.0, ge=0, le=10_000)
    corrupt: float = Field(default=0.0, ge=0, le=1, description="share of packets with a flipped bit")
    drop: list[str] = Field(default_factory=list, description="names of the MAVLink messages that the link drops")

    @field_validator("drop")
    @classmethod
    def _known(cls, names: list[str]) -> list[str]:
        for name in names:
            if not hasattr(dialect, f"MAVLINK_MSG_ID_{name}"):
                raise ValueError(f"{name} is not a MAVLink message")
        return names

    @model_validator(mode="after")
    def _does_something(self) -> Link:
        if self.which == "zenoh" and self.drop:
            raise ValueError("drop lists MAVLink messages, which the zenoh link does not carry")
        return self


class Flood(Section):
    """Datagrams to the daemon's MAVLink port, as fast as it reads them."""

    do: Literal["flood"]
    what: Literal["random", "hostile", "replay"] = Field(
        description="random bytes; well-formed frames with absurd content; a replay of what the autopilot sent"
    )
    sender: Literal["autopilot", "stranger"] = Field(description="from the address that the daemon accepts, or another")
    total_bytes: int = Field(gt=0, le=1_000_000_000)


class SlowSubscriber(Section):
    """A second subscriber, frozen once it has subscribed, or removed."""

    do: Literal["slow_subscriber"]
    there: bool = True


class Disk(Section):
    """What the recorder's disk accepts from now on; what is left out returns to normal."""

    do: Literal["disk"]
    full: bool = Field(default=False, description="no space left on the volume; needs `volume = true`")
    read_only: bool = Field(default=False, description="mounted read-only; needs `volume = true`")
    file_max_bytes: int | None = Field(default=None, gt=0, description="no file grows beyond this (RLIMIT_FSIZE)")


class ModelFile(Section):
    """The file named in the configuration; `signal daemon HUP` makes the daemon read it."""

    do: Literal["model_file"]
    content: Literal["good", "cut_short"]


class Load(Section):
    """Busy processes for each core."""

    do: Literal["load"]
    times: int = Field(ge=1, le=16)
    for_s: Seconds


class ExpectPoses(Section):
    """Three new poses of frames exposed after the last act."""

    do: Literal["expect_poses"]
    at: Peer = "both"
    within_s: Seconds = WITHIN_S


class ExpectSilence(Section):
    """No pose for this long."""

    do: Literal["expect_silence"]
    at: Peer = "both"
    for_s: Seconds
    within_s: Seconds = WITHIN_S


class ExpectState(Section):
    """The daemon's state and its reasons, as a subscriber receives them in the diagnostics."""

    do: Literal["expect_state"]
    pattern: Pattern = Field(
        description="regular expression, matched against the state in the diagnostics, e.g. 'fault; no frame'"
    )
    within_s: Seconds = WITHIN_S


class ExpectSaid(Section):
    """A line of the daemon's log since the last act; the log counts repetitions within a minute, and keeps one."""

    do: Literal["expect_said"]
    pattern: Pattern = Field(description="regular expression")
    within_s: Seconds = WITHIN_S


class ExpectCounter(Section):
    """A counter in the daemon's diagnostics, as a subscriber receives them, has grown since the last act."""

    do: Literal["expect_counter"]
    name: str
    by: int = Field(default=1, ge=1)
    within_s: Seconds = WITHIN_S


class ExpectStill(Section):
    """Such a counter does not grow for this long."""

    do: Literal["expect_still"]
    name: str
    for_s: Seconds
    within_s: Seconds = WITHIN_S


class ExpectExit(Section):
    do: Literal["expect_exit"]
    code: int = Field(description="of the daemon; minus the signal's number if a signal ended it")
    within_s: Seconds = WITHIN_S


Step = Annotated[
    Hold
    | Start
    | Signal
    | Camera
    | Link
    | Flood
    | SlowSubscriber
    | Disk
    | ModelFile
    | Load
    | ExpectPoses
    | ExpectSilence
    | ExpectState
    | ExpectSaid
    | ExpectCounter
    | ExpectStill
    | ExpectExit,
    Field(discriminator="do"),
]


class Timeline(Section):
    """It begins once both peers receive poses."""

    title: str
    signed: bool = Field(default=False, description="daemon and autopilot sign everything that they send")
    volume: bool = Field(default=False, description="recordings go to a separate small volume (needs unshare)")
    step: list[Step] = Field(min_length=1)

    @model_validator(mode="after")
    def _has_its_volume(self) -> Timeline:
        for number, step in enumerate(self.step, 1):
            if isinstance(step, Disk) and (step.full or step.read_only) and not self.volume:
                raise ValueError(f"step {number}: full and read_only need `volume = true` at the top")
        return self


def load_timeline(path: Path) -> Timeline:
    """Raises InputError: one line per error, each naming file, step and key."""
    return load_settings(path, Timeline, InputError, _step_and_key)


def _step_and_key(location: tuple[str | int, ...]) -> str:
    if location == ("step",):
        return "[[step]]"
    place = [f"step {part + 1}" if isinstance(part, int) else part for part in location if part != "step"]
    return ", ".join(place)
