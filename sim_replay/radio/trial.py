"""One radio link for some time: what the vehicle sent, what the ground showed, and its true age."""

from __future__ import annotations

import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
import zenoh

from msgs import topics
from msgs.client import connect, subscribe
from msgs.ground.feed import Incoming, listening
from msgs.ground.fleet import TAKEN, Fleet, TargetRow
from sim_replay.play import PlayError
from sim_replay.ports import LOOPBACK
from sim_replay.radio.channel import Channel
from sim_replay.radio.relay import RadioRelay
from sim_replay.radio.rig import SOCKET_KINDS, START_S, Transport, Vehicle, ground
from sim_replay.radio.vehicle import content_age_s

UAV = "uav1"
# Error of converting one clock to another; a pose that is really late exceeds it.
CLOCK_TOLERANCE_S = 0.01
DRAIN_S = 2.0
_NS = 1e9

Tool = Literal["poses", "watch"]


@dataclass(frozen=True)
class Plan:
    """`tool` receives on the ground: a program that takes poses only, or what `uavpose-ground watch` takes."""

    channel: Channel
    transport: Transport = "quic"
    tool: Tool = "poses"
    seconds: float = 30.0
    fps: float = 20.0
    max_age_s: float = 1.0
    seed: int = 0


@dataclass(frozen=True)
class Outcome:
    """Ages are of the poses shown, from true exposure to being shown."""

    channel: str
    transport: Transport
    tool: Tool
    sent: int  # poses put by the vehicle since the first one shown
    shown: int
    refused: int  # arrived, but too old or out of order
    late_shown: int  # truly older than the client allows, but shown: must be 0
    age_p50_s: float
    age_p95_s: float
    age_p99_s: float
    age_max_s: float
    gap_max_s: float  # the longest time without a pose, from the first one to the end of sending
    back_s: float | None  # from the end of the outage to the next pose; None: no outage, or none came
    up_kbps: float  # payload that the vehicle's session sent by radio

    @property
    def delivered(self) -> float:
        """Share of the poses sent that were shown."""
        return self.shown / self.sent if self.sent else 0.0


@dataclass
class Ledger:
    """Shown poses: time (UTC s), the publisher's sequence number, and true age."""

    rows: list[tuple[float, int, float]] = field(default_factory=list)
    changed: threading.Condition = field(default_factory=threading.Condition)

    def show(self, range_m: float, sequence: int, now_ns: int) -> None:
        now_s = now_ns / _NS
        with self.changed:
            self.rows.append((now_s, sequence, content_age_s(range_m, now_s)))
            self.changed.notify_all()

    def wait_for_first(self) -> None:
        with self.changed:
            if not self.changed.wait_for(lambda: self.rows, START_S):
                raise PlayError(f"no pose received within {START_S:.0f} s")

    def offered(self, sent: int) -> int:
        """Number of poses that could have been shown since the first one shown, of `sent` in all."""
        sequences = [row[1] for row in self.rows]
        # The last one may have been sent after the vehicle had counted.
        return max(sent, *sequences) - min(sequences) + 1


def play(plan: Plan) -> Outcome:
    """Play a plan in real time. Raises PlayError if the vehicle does not start or nothing arrives."""
    ledger = Ledger()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="uavpose-radio-")))
        router = stack.enter_context(ground(folder, plan.transport, [UAV]))
        upstream = (LOOPBACK, router.port)
        relay = stack.enter_context(RadioRelay(upstream, plan.channel, SOCKET_KINDS[plan.transport], plan.seed))
        session = stack.enter_context(connect(router.loopback))
        refused = stack.enter_context(_taking(plan, session, ledger))
        vehicle = Vehicle(UAV, router.endpoint(relay.port), router.keys[UAV], plan.fps)
        stack.callback(vehicle.close)
        vehicle.wait_ready()
        vehicle.begin()
        ledger.wait_for_first()
        bytes_before, began_s = relay.bytes_up, time.monotonic()
        restored_s = _wait_out(plan, relay)
        kbps = 8e-3 * (relay.bytes_up - bytes_before) / (time.monotonic() - began_s)
        ended_s = time.time()
        sent = vehicle.end()["sent_pose"]
        threading.Event().wait(DRAIN_S)  # what is in flight counts as late or lost, not as never sent
        return outcome_of(plan, ledger, sent, refused(), restored_s, ended_s, kbps)


def _wait_out(plan: Plan, relay: RadioRelay) -> float | None:
    """Wait for the trial's duration, with its outage; returns the outage's end (UTC s)."""
    wait = threading.Event().wait
    outage_s = plan.channel.outage_s
    if not outage_s:
        wait(plan.seconds)
        return None
    wait(plan.seconds / 3)
    relay.cut(True)
    wait(outage_s)
    relay.cut(False)
    restored_s = time.time()
    wait(max(plan.seconds * 2 / 3 - outage_s, 1.0))
    return restored_s


@contextmanager
def _taking(plan: Plan, session: zenoh.Session, ledger: Ledger) -> Iterator[Callable[[], int]]:
    """Record what the plan's tool shows in the ledger; yields a function that returns how many poses it has refused."""
    with _as_program(plan, session, ledger) if plan.tool == "poses" else _as_watch(plan, session, ledger) as refused:
        yield refused


@contextmanager
def _as_program(plan: Plan, session: zenoh.Session, ledger: Ledger) -> Iterator[Callable[[], int]]:
    poses = subscribe(session, UAV, max_age_s=plan.max_age_s)

    def take() -> None:
        for one in poses:
            ledger.show(float(np.linalg.norm(one.pose.t_cam_target_m)), one.sequence, time.time_ns())

    reader = threading.Thread(target=take, name="program", daemon=True)
    reader.start()
    try:
        yield poses.refused.total
    finally:
        poses.close()
        reader.join()


@contextmanager
def _as_watch(plan: Plan, session: zenoh.Session, ledger: Ledger) -> Iterator[Callable[[], int]]:
    fleet = Fleet(max_age_s=plan.max_age_s)
    with listening(session, [UAV], 0, taker(fleet, {UAV: ledger}), fleet.alive, TAKEN):
        yield lambda: sum(row.refused.total() for row in fleet.rows(time.time_ns()))


def taker(fleet: Fleet, ledgers: Mapping[str, Ledger]) -> Callable[[Incoming], None]:
    """Takes what arrives into the fleet, and each pose that it shows then into its vehicle's ledger."""

    def take(incoming: Incoming) -> None:
        now_ns = time.time_ns()
        shown = fleet.take(incoming, now_ns)
        attachment = topics.parse_attachment(incoming.attachment)
        if isinstance(shown, TargetRow) and attachment is not None:
            ledgers[shown.uav].show(shown.range_m, attachment[0], now_ns)

    return take


def outcome_of(
    plan: Plan, ledger: Ledger, sent: int, refused: int, restored_s: float | None, ended_s: float, kbps: float
) -> Outcome:
    """`sent`: number of poses put by the vehicle; `restored_s`, `ended_s`: UTC of the end of the outage, of sending."""
    rows = list(ledger.rows)
    shown_s = np.array([row[0] for row in rows])
    ages_s = np.array([row[2] for row in rows])
    p50_s, p95_s, p99_s = (float(value) for value in np.percentile(ages_s, [50, 95, 99]))
    after_s = shown_s[shown_s >= restored_s] if restored_s is not None else np.empty(0)
    return Outcome(
        channel=plan.channel.name,
        transport=plan.transport,
        tool=plan.tool,
        sent=ledger.offered(sent),
        shown=len(rows),
        refused=refused,
        late_shown=int((ages_s > plan.max_age_s + CLOCK_TOLERANCE_S).sum()),
        age_p50_s=p50_s,
        age_p95_s=p95_s,
        age_p99_s=p99_s,
        age_max_s=float(ages_s.max()),
        gap_max_s=float(np.diff(shown_s, append=max(ended_s, shown_s[-1])).max()),
        back_s=float(after_s[0] - restored_s) if restored_s is not None and after_s.size else None,
        up_kbps=kbps,
    )
