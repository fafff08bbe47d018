"""What must be observed after a fault; each expectation waits for its event and reports the time it took."""

from __future__ import annotations

import re
import time
from dataclasses import dataclass, field
from functools import singledispatch

from sim_replay.faults.messages import AUTOPILOT, SUBSCRIBER
from sim_replay.faults.rig import Rig
from sim_replay.faults.timeline import (
    ExpectCounter,
    ExpectExit,
    ExpectPoses,
    ExpectSaid,
    ExpectSilence,
    ExpectState,
    ExpectStill,
)

POSES_ENOUGH = 3
NS = 1_000_000_000


@dataclass(frozen=True)
class Since:
    """The reference from which waiting counts."""

    acted_ns: int  # UTC, end of the last act
    began_ns: int  # UTC, its beginning: the daemon may react before the act has ended
    counters: dict[str, int] = field(default_factory=dict)  # of the last diagnostics before it


@dataclass(frozen=True)
class Seen:
    """`took_s` counts from the end of the last act; `text` says what was observed."""

    text: str
    took_s: float


class Unmet(AssertionError):
    """An expectation was not met in time; the text is a sentence."""


@singledispatch
def expect(step: object, rig: Rig, since: Since) -> Seen:
    """Wait for what a step expects. Raises Unmet."""
    raise TypeError(f"{type(step).__name__} expects nothing")


@expect.register
def _poses(step: ExpectPoses, rig: Rig, since: Since) -> Seen:
    peers = (AUTOPILOT, SUBSCRIBER) if step.at == "both" else (step.at,)
    witness = rig.witness

    def enough() -> bool:
        return all(len(witness.poses_at(peer, since.acted_ns)) >= POSES_ENOUGH for peer in peers)

    if not witness.wait_for(enough, step.within_s):
        counts = ", ".join(f"{len(witness.poses_at(peer, since.acted_ns))} at the {peer}" for peer in peers)
        raise Unmet(f"no {POSES_ENOUGH} new poses at each peer within {step.within_s:g} s: {counts}")
    took_s = {peer: (witness.poses_at(peer, since.acted_ns)[0].arrival_ns - since.acted_ns) / NS for peer in peers}
    text = ", ".join(f"the {peer} after {s:.2f} s" for peer, s in took_s.items())
    return Seen(f"poses again: {text}", max(took_s.values()))


@expect.register
def _silence(step: ExpectSilence, rig: Rig, since: Since) -> Seen:
    peers = (AUTOPILOT, SUBSCRIBER) if step.at == "both" else (step.at,)

    def last_ns() -> int:
        return max((p.arrival_ns for p in rig.witness.poses if p.peer in peers), default=0)

    def silent() -> bool:
        return time.time_ns() - max(last_ns(), since.began_ns) >= step.for_s * NS

    if not rig.witness.wait_for(silent, step.within_s):
        lasted_s = (time.time_ns() - max(last_ns(), since.began_ns)) / NS
        raise Unmet(f"no silence of {step.for_s:g} s within {step.within_s:g} s, but of {lasted_s:.1f} s")
    took_s = max(last_ns() - since.acted_ns, 0) / NS
    return Seen(f"silence at {' and '.join(peers)} for {step.for_s:g} s, the last pose after {took_s:.2f} s", took_s)


@expect.register
def _state(step: ExpectState, rig: Rig, since: Since) -> Seen:
    witness = rig.witness

    def told() -> bool:
        return witness.counted_ns > since.began_ns and re.search(step.pattern, witness.state) is not None

    if not witness.wait_for(told, step.within_s):
        raise Unmet(f"the state was not '{step.pattern}' within {step.within_s:g} s, but '{witness.state}'")
    took_s = max(witness.counted_ns - since.acted_ns, 0) / NS
    return Seen(f"the state after {took_s:.2f} s: {witness.state}", took_s)


@expect.register
def _said(step: ExpectSaid, rig: Rig, since: Since) -> Seen:
    def lines() -> list[tuple[int, str]]:
        return [(ns, line) for ns, line in rig.witness.said if ns >= since.began_ns and re.search(step.pattern, line)]

    if not rig.witness.wait_for(lambda: bool(lines()), step.within_s):
        raise Unmet(f"the daemon did not say '{step.pattern}' within {step.within_s:g} s")
    said_ns, line = lines()[0]
    took_s = max(said_ns - since.acted_ns, 0) / NS
    return Seen(f"the daemon said after {took_s:.2f} s: {line}", took_s)


@expect.register
def _counter(step: ExpectCounter, rig: Rig, since: Since) -> Seen:
    witness = rig.witness

    def growth() -> int:
        return witness.counters.get(step.name, 0) - since.counters.get(step.name, 0)

    if not witness.wait_for(lambda: witness.counted_ns >= since.began_ns and growth() >= step.by, step.within_s):
        told = f"{step.name}{_unheard(step.name, rig)} did not grow by {step.by} within {step.within_s:g} s"
        raise Unmet(f"{told}, but by {growth()}")
    took_s = max(witness.counted_ns - since.acted_ns, 0) / NS
    return Seen(f"{step.name} grew by {growth()}", took_s)


@expect.register
def _still(step: ExpectStill, rig: Rig, since: Since) -> Seen:
    witness = rig.witness
    grown_ns, count = witness.counted_ns, witness.counters.get(step.name, 0)

    def still() -> bool:
        nonlocal grown_ns, count
        if witness.counters.get(step.name, 0) != count:
            grown_ns, count = witness.counted_ns, witness.counters.get(step.name, 0)
        # Measured between diagnostics: if none arrive, that proves nothing.
        return witness.counted_ns - grown_ns >= step.for_s * NS

    if not witness.wait_for(still, step.within_s):
        lasted_s = (witness.counted_ns - grown_ns) / NS
        raise Unmet(f"{step.name} was not still for {step.for_s:g} s within {step.within_s:g} s, but {lasted_s:.1f} s")
    took_s = max(grown_ns - since.acted_ns, 0) / NS
    told = f"{step.name}{_unheard(step.name, rig)} stood still for {step.for_s:g} s, from {took_s:.2f} s on"
    return Seen(told, took_s)


def _unheard(name: str, rig: Rig) -> str:
    """A note if the diagnostics have never contained this counter: it never counted, or its name is misspelt."""
    return "" if name in rig.witness.counters else " (which the daemon has not told of)"


@expect.register
def _exit(step: ExpectExit, rig: Rig, since: Since) -> Seen:
    if not rig.witness.wait_for(lambda: rig.daemon.exit_code is not None, step.within_s):
        raise Unmet(f"the daemon still runs after {step.within_s:g} s")
    took_s = max(time.time_ns() - since.acted_ns, 0) / NS
    code = rig.daemon.reap()
    if code != step.code:
        raise Unmet(f"the daemon ended with exit code {code}, not {step.code}")
    return Seen(f"the daemon ended with exit code {code} after {took_s:.2f} s", took_s)
