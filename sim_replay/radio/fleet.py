"""Many vehicles on one router and one watcher: whether each gets through, how late, and at what cost."""

from __future__ import annotations

import tempfile
import threading
import time
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from msgs.client import connect
from msgs.ground.feed import listening
from msgs.ground.fleet import TAKEN, Fleet
from sim_replay.play import PlayError
from sim_replay.radio.rig import START_S, Transport, Vehicle, ground
from sim_replay.radio.trial import CLOCK_TOLERANCE_S, DRAIN_S, Ledger, taker

MAX_AGE_S = 1.0  # of a pose that is shown


@dataclass(frozen=True)
class FleetOutcome:
    """Ages are of the poses shown, of all vehicles, from true exposure to being shown."""

    vehicles: int
    transport: Transport
    fps: float
    seconds: float
    shown_hz: float  # poses per second, all vehicles
    delivered_min: float  # share of the poses sent, of the worst vehicle
    delivered: float
    age_p50_s: float
    age_p95_s: float
    age_p99_s: float
    age_max_s: float
    refused: int
    late_shown: int
    processor_share: float  # of one core: router and watcher together


def fly_fleet(vehicles: int, seconds: float, fps: float = 20.0, transport: Transport = "quic") -> FleetOutcome:
    """Start this many vehicles as processes and watch them all. Raises PlayError if nothing is received from one."""
    uavs = [f"uav{number}" for number in range(1, vehicles + 1)]
    ledgers = {uav: Ledger() for uav in uavs}
    fleet = Fleet(max_age_s=MAX_AGE_S)
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="uavpose-fleet-")))
        router = stack.enter_context(ground(folder, transport, uavs))
        session = stack.enter_context(connect(router.loopback))
        stack.enter_context(listening(session, (), 0, taker(fleet, ledgers), fleet.alive, TAKEN))
        flying = [Vehicle(uav, router.endpoint(router.port), router.keys[uav], fps) for uav in uavs]
        for vehicle in flying:
            stack.callback(vehicle.close)
        for vehicle in flying:
            vehicle.wait_ready()
        for vehicle in flying:
            vehicle.begin()
        for ledger in ledgers.values():
            ledger.wait_for_first()
        if not all(row.alive for row in fleet.rows(time.time_ns())):
            raise PlayError(f"no sign of life from at least one vehicle within {START_S:.0f} s")
        used_s, began_s = time.process_time(), time.monotonic()
        threading.Event().wait(seconds)
        share = (time.process_time() - used_s) / (time.monotonic() - began_s)
        sent = {vehicle.uav: vehicle.end()["sent_pose"] for vehicle in flying}
        threading.Event().wait(DRAIN_S)
        refused = sum(row.refused.total() for row in fleet.rows(time.time_ns()))
    return _outcome(ledgers, sent, (fps, seconds, transport), refused, share)


def _outcome(
    ledgers: dict[str, Ledger],
    sent: dict[str, int],
    plan: tuple[float, float, Transport],
    refused: int,
    share: float,
) -> FleetOutcome:
    fps, seconds, transport = plan
    offered = {uav: ledger.offered(sent[uav]) for uav, ledger in ledgers.items()}
    shown = {uav: len(ledger.rows) for uav, ledger in ledgers.items()}
    rows = [row for ledger in ledgers.values() for row in ledger.rows]
    ages_s, arrivals_s = np.array([row[2] for row in rows]), np.array([row[0] for row in rows])
    p50_s, p95_s, p99_s = (float(value) for value in np.percentile(ages_s, [50, 95, 99]))
    return FleetOutcome(
        vehicles=len(ledgers),
        transport=transport,
        fps=fps,
        seconds=seconds,
        shown_hz=float(len(rows) / np.ptp(arrivals_s)),
        delivered_min=min(shown[uav] / offered[uav] for uav in ledgers),
        delivered=len(rows) / sum(offered.values()),
        age_p50_s=p50_s,
        age_p95_s=p95_s,
        age_p99_s=p99_s,
        age_max_s=float(ages_s.max()),
        refused=refused,
        late_shown=int((ages_s > MAX_AGE_S + CLOCK_TOLERANCE_S).sum()),
        processor_share=share,
    )
