"""Commands over zenoh: queries on `uavpose/@v1/<uav>/cmd/<name>` with a JSON object, answered with one.

| command  | body                              | done                                                             |
|----------|-----------------------------------|------------------------------------------------------------------|
| `track`  | `{"box": [x0, y0, x1, y1]}`       | look for a target there; shares of the picture's width and height |
| `select` | `{"target": "t1"}`                | choose a target that is tracked, by its name                     |
| `stop`   | `{}`                              | drop all targets                                                 |
| `record` | `{"on": true}` or `{"on": false}` | begin a recording, or end it                                     |
| `reload` | `{}`                              | read the configuration and the model again; answered when it is done |
| `rate`   | `{"max_hz": 10}` or `{"max_hz": null}` | send poses, odometry, directions no more often; null: every one |

The answer is `{"ok": true, "command": ..., "done": ...}` or `{"ok": false, "command": ..., "error": "a sentence"}`.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import zenoh
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator
from zenoh import handlers

from edge import clock
from edge.links.allowance import Allowance
from edge.requests import AskReload, ReloadOutcome, Request, SelectTarget, StopTracking, TrackBox
from msgs.recording import Recorder
from msgs.settings import dotted, faults_of

log = logging.getLogger(__name__)

BODY_BYTES_MAX = 4096
LOGGED_AT_ONCE, LOGGED_NS = 32, 1_000_000_000  # then one line a second, however many commands arrive
Share = Annotated[float, Field(ge=0.0, le=1.0, allow_inf_nan=False)]


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Track(_Body):
    box: list[Share] = Field(min_length=4, max_length=4)

    @model_validator(mode="after")
    def _corners(self) -> Track:
        x0, y0, x1, y1 = self.box
        if x1 <= x0 or y1 <= y0:
            raise ValueError("a box is [left, top, right, bottom] with left < right and top < bottom")
        return self


class Select(_Body):
    target: str

    @field_validator("target")
    @classmethod
    def _named(cls, target: str) -> str:
        if not re.fullmatch(r"t[0-9]{1,3}", target):
            raise ValueError("a target is named t0, t1, …")
        return target


class Stop(_Body):
    pass


class Record(_Body):
    on: bool


class Rate(_Body):
    max_hz: Annotated[float, Field(ge=0.1, le=240.0, allow_inf_nan=False)] | None


class Reload(_Body):
    pass


Command = Track | Select | Stop | Record | Rate | Reload
COMMANDS: dict[str, type[Command]] = {
    "track": Track,
    "select": Select,
    "stop": Stop,
    "reload": Reload,
    "record": Record,
    "rate": Rate,
}


class Refused(Exception):
    """A command is not carried out; the text says why, for a person."""


@dataclass(frozen=True)
class Actions:
    """The functions that commands can call; None: not available on this vehicle."""

    request: Callable[[Request], bool] | None  # False: too many are waiting
    recorder: Recorder | None
    set_rate: Callable[[float | None], None]
    reload: AskReload | None
    targets: Callable[[], Mapping[str, int]] = dict  # currently tracked: name to track id


def commands_key(uav: str) -> str:
    return f"uavpose/@v1/{uav}/cmd/*"


def parse(name: str, body: bytes) -> Command:
    """The command, or Refused. An empty body is an empty object."""
    if name not in COMMANDS:
        raise Refused(f"no such command; there are {', '.join(COMMANDS)}")
    if len(body) > BODY_BYTES_MAX:
        raise Refused(f"a body of {len(body)} bytes is too long")
    try:
        return COMMANDS[name].model_validate_json(body or b"{}")
    except ValidationError as error:
        first = faults_of(error)[0]
        key = dotted(first.location)
        raise Refused(f"{key}: {first.reason}" if key else first.reason) from error


def carry_out(command: Track | Select | Stop | Record | Rate, actions: Actions) -> dict[str, Any]:
    """Carry out the command and return what was done, or raise Refused. Never waits."""
    match command:
        case Record(on=on):
            if actions.recorder is None:
                raise Refused("this vehicle has no recorder")
            actions.recorder.switch(on)
            if on and not actions.recorder.recording:
                raise Refused("switched on, but the disk takes nothing just now; it is tried again and again")
            return {"recording": on}
        case Rate(max_hz=max_hz):
            actions.set_rate(max_hz)
            return {"max_hz": max_hz}
        case Track() | Select() | Stop():
            if actions.request is None:
                raise Refused("this vehicle does not take requests")
            asked: Request = StopTracking()
            if isinstance(command, Select):
                asked = SelectTarget(_track_id(command.target, actions.targets()))
            elif isinstance(command, Track):
                x0, y0, x1, y1 = command.box
                asked = TrackBox((x0, y0, x1, y1))
            if not actions.request(asked):
                raise Refused("too many requests wait; try again")
            return command.model_dump()


def _track_id(name: str, targets: Mapping[str, int]) -> int:
    """Raises Refused for a target that is not tracked."""
    if name not in targets:
        raise Refused(f"no target {name}; there {'are ' + ', '.join(sorted(targets)) if targets else 'is none'}")
    return targets[name]


def answer(name: str, body: bytes, actions: Actions, reply: Callable[[dict[str, Any]], None]) -> None:
    """Pass the answer to `reply`: at once, or from another thread when a reload has finished."""

    def done(what: dict[str, Any]) -> None:
        reply({"ok": True, "command": name, "done": what})

    def refused(why: str) -> None:
        reply({"ok": False, "command": name, "error": why})

    def reloaded(outcome: ReloadOutcome) -> None:
        if not outcome.flies:
            return refused(outcome.said)
        keys = {"taken_over": list(outcome.taken_over), "needs_restart": list(outcome.needs_restart)}
        return done({"said": outcome.said, "model_sha256": outcome.model_sha256, **keys})

    try:
        command = parse(name, body)
        if not isinstance(command, Reload):
            done(carry_out(command, actions))
        elif actions.reload is None:
            raise Refused("this vehicle does not reload")
        elif not actions.reload(reloaded):
            raise Refused("a reload is under way; try again")
    except Refused as error:
        refused(str(error))


def declare_commands(session: zenoh.Session, uav: str, actions: Actions) -> zenoh.Queryable:
    """Answer commands until the queryable is undeclared, on zenoh's receiving thread."""

    allowance = Allowance(LOGGED_AT_ONCE, LOGGED_NS)

    def on_query(query: zenoh.Query) -> None:
        key = str(query.key_expr)
        if "*" in key:
            # A single query must neither command several vehicles at once nor run every command.
            with query:
                refused = {"ok": False, "command": key.rpartition("/")[2], "error": "name one vehicle and one command"}
                query.reply_err(json.dumps(refused), encoding=zenoh.Encoding.APPLICATION_JSON)
            return

        def reply(said: dict[str, Any]) -> None:
            if allowance.take(clock.monotonic_ns()):
                log.info("command over zenoh: %s", said)
            try:
                with query:
                    query.reply(key, json.dumps(said), encoding=zenoh.Encoding.APPLICATION_JSON)
            except zenoh.ZError as error:
                log.warning("command over zenoh: not answered: %s", error)

        body = b"" if query.payload is None else query.payload.to_bytes()
        answer(key.rpartition("/")[2], body, actions, reply)

    return session.declare_queryable(commands_key(uav), handlers.Callback(on_query, indirect=False))
