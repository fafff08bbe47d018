"""`uavpose-replay radio` and `uavpose-replay fleet`: bad links and many vehicles, measured on this machine."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict
from importlib.util import find_spec
from typing import Any, get_args

from edge.errors import InputError
from sim_replay.radio.channel import CHANNELS
from sim_replay.radio.fleet import fly_fleet
from sim_replay.radio.rig import Transport
from sim_replay.radio.trial import Outcome, Plan, Tool, play

EXIT_LATE = 1
VEHICLES_MAX = 64


def register(commands: Any) -> None:
    """Add the commands to what add_subparsers() returned; each sets `run`, a function of the parsed arguments."""
    radio = commands.add_parser(
        "radio",
        help="run the daemon's zenoh link over simulated slow, lossy and interrupted radios and check every pose shown",
        description="Connect a vehicle's zenoh session to a router with certificates through a relay on loopback that "
        "behaves like a radio. Prints the share of poses delivered and their true age when shown. "
        "Links: " + "; ".join(f"{name}: {one.what}" for name, one in CHANNELS.items()) + ". "
        "Exit code 0 if no pose older than --max-age was shown as valid, 1 if one was.",
    )
    radio.add_argument(
        "--link", action="append", choices=list(CHANNELS), help="radio link (default: all); may be repeated"
    )
    radio.add_argument(
        "--transport", action="append", choices=get_args(Transport), help="transport (default: both); may be repeated"
    )
    radio.add_argument(
        "--tool",
        action="append",
        choices=get_args(Tool),
        help="receiver on the ground: a program that takes poses only, or what `uavpose-ground watch` "
        "takes (default: both); may be repeated",
    )
    radio.add_argument("--seconds", type=_positive, default=30.0, help="duration of each trial (default 30)")
    radio.add_argument("--fps", type=_positive, default=20.0, help="poses per second (default 20)")
    radio.add_argument(
        "--max-age",
        type=_positive,
        default=1.0,
        metavar="S",
        help="the client refuses poses older than S seconds (default 1)",
    )
    radio.add_argument("--json", action="store_true", help="print one JSON array instead of a table")
    radio.set_defaults(run=run_radio)
    fleet = commands.add_parser(
        "fleet",
        help="connect many simulated vehicles to one router and watch them all",
        description="Start each vehicle as a process with the daemon's zenoh session and its own certificate; router "
        "and watcher share one process. Exit code 0 if no pose older than 1 s was shown as valid, 1 if one was.",
    )
    fleet.add_argument(
        "--vehicles",
        type=_vehicles,
        default=10,
        metavar="N",
        help=f"number of vehicles, up to {VEHICLES_MAX} (default 10)",
    )
    fleet.add_argument("--transport", choices=get_args(Transport), default="quic", help="transport (default quic)")
    fleet.add_argument("--seconds", type=_positive, default=30.0, help="duration (default 30)")
    fleet.add_argument("--fps", type=_positive, default=20.0, help="poses per second of each vehicle (default 20)")
    fleet.add_argument("--json", action="store_true", help="print one JSON object instead of a line")
    fleet.set_defaults(run=run_fleet)


def _vehicles(text: str) -> int:
    if not text.isdecimal() or not 1 <= int(text) <= VEHICLES_MAX:
        raise argparse.ArgumentTypeError(f"'{text}' is not an integer from 1 to {VEHICLES_MAX}")
    return int(text)


def _positive(text: str) -> float:
    with suppress(ValueError):
        if 0.0 < (value := float(text)) <= 3600.0:
            return value
    raise argparse.ArgumentTypeError(f"'{text}' is not a positive number up to 3600")


def run_radio(args: argparse.Namespace) -> int:
    """Play every requested combination. Raises InputError without the package that makes certificates."""
    _need_certificates()
    outcomes = []
    for link in args.link or CHANNELS:
        for transport in args.transport or get_args(Transport):
            for tool in args.tool or get_args(Tool):
                plan = Plan(CHANNELS[link], transport, tool, args.seconds, args.fps, args.max_age)
                outcomes.append(play(plan))
                if not args.json:
                    print(table(outcomes[-1:], head=len(outcomes) == 1), flush=True)
    if args.json:
        print(json.dumps([{**asdict(one), "delivered": one.delivered} for one in outcomes], indent=2))
    return EXIT_LATE if any(one.late_shown for one in outcomes) else 0


def run_fleet(args: argparse.Namespace) -> int:
    """Raises InputError without the package that makes certificates."""
    _need_certificates()
    one = fly_fleet(args.vehicles, args.seconds, args.fps, args.transport)
    if args.json:
        print(json.dumps(asdict(one), indent=2))
    else:
        ages = "/".join(f"{1e3 * s:.0f}" for s in (one.age_p50_s, one.age_p95_s, one.age_p99_s, one.age_max_s))
        print(
            f"{one.vehicles} vehicles over {one.transport} at {one.fps:g} Hz for {one.seconds:g} s: {one.shown_hz:.0f} "
            f"poses/s shown, {one.delivered:.1%} delivered (worst vehicle {one.delivered_min:.1%}), age {ages} ms "
            f"p50/p95/p99/max, {one.refused} refused, {one.late_shown} shown too late, router and watcher together "
            f"used {one.processor_share:.0%} of a core"
        )
    return EXIT_LATE if one.late_shown else 0


def _need_certificates() -> None:
    if find_spec("cryptography") is None:
        raise InputError("certificates need the extra `ground`: pip install '.[ground]'")


def table(outcomes: Sequence[Outcome], head: bool = True) -> str:
    """Markdown; ages in milliseconds."""
    lines = [
        "| link | transport | tool | sent | delivered | p50 | p95 | p99 | max ms | refused | shown too late "
        "| longest gap s | recovered after s | uplink kbit/s |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for one in outcomes:
        ages = " | ".join(f"{1e3 * s:.0f}" for s in (one.age_p50_s, one.age_p95_s, one.age_p99_s, one.age_max_s))
        back = "–" if one.back_s is None else f"{one.back_s:.1f}"
        lines.append(
            f"| {one.channel} | {one.transport} | {one.tool} | {one.sent} | {one.delivered:.1%} | {ages} "
            f"| {one.refused} | {one.late_shown} | {one.gap_max_s:.2f} | {back} | {one.up_kbps:.0f} |"
        )
    return "\n".join(lines if head else lines[2:])
