"""`uavpose-replay faults`: play a timeline of faults on the real daemon and report the reactions and their times."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from edge.config import SHIPPED_MODEL
from edge.errors import InputError
from msgs.command_line import say_out
from sim_replay.demo import BUNDLED_SEQUENCE
from sim_replay.faults.actions import act
from sim_replay.faults.expectations import Seen, Since, Unmet, expect
from sim_replay.faults.judge import ages_ms, violations
from sim_replay.faults.messages import AUTOPILOT, SUBSCRIBER
from sim_replay.faults.rig import Rig, RigSettings, can_mount
from sim_replay.faults.timeline import ExpectExit, ExpectPoses, Signal, Start, Step, Timeline, load_timeline

TIMELINES = Path(__file__).parent / "timelines"
EXIT_UNMET = 1
ENDING = ("TERM", "KILL")  # and HUP, but for the daemon, which reloads
REPORT = "faults.json"

Say = Callable[[str], None]


@dataclass
class Outcome:
    """Result of a timeline: what was observed at each step, and violations."""

    title: str
    seen: list[dict[str, Any]] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    def recovery(self) -> str:
        """In one line: when processes ran again, when poses arrived again, and when the daemon ended on request."""
        told = [one["seen"] for one in self.seen if one["step"]["do"] in ("start", "expect_poses", "expect_exit")]
        return "; ".join(told)


def play_timeline(rig: Rig, timeline: Timeline, say: Say) -> Outcome:
    """Run every step on a running rig, once both peers receive poses; stops at the first unmet expectation.

    A process that has ended, though no step signalled or expected that, is a violation too.
    """
    outcome = Outcome(timeline.title)
    say(timeline.title)
    now_ns = time.time_ns()
    since = Since(now_ns, now_ns)
    asked_to_end: set[str] = set()
    try:
        expect(ExpectPoses(do="expect_poses"), rig, since)
        for step in timeline.step:
            if isinstance(step, Start):
                asked_to_end.discard(step.who)
            elif isinstance(step, Signal) and (step.name in ENDING or (step.name == "HUP" and step.who != "daemon")):
                asked_to_end.add(step.who)
            elif isinstance(step, ExpectExit):
                asked_to_end.add("daemon")
            since = _take(step, rig, since, outcome, say)
    except Unmet as error:
        outcome.wrong.append(str(error))
        say(f"  NOT MET: {error}")
    for who, process in rig.processes.items():
        if process.exit_code is not None and who not in asked_to_end:
            outcome.wrong.append(f"the {who} ended with exit code {process.exit_code}, which no step asked for")
    return outcome


def _take(step: Step, rig: Rig, since: Since, outcome: Outcome, say: Say) -> Since:
    what = step.model_dump(exclude_defaults=True)
    if step.do.startswith("expect_"):
        seen: Seen = expect(step, rig, since)
        outcome.seen.append({"step": what, "seen": seen.text, "took_s": round(seen.took_s, 3)})
        say(f"  {seen.text}")
        return since
    began_ns, counters = time.time_ns(), rig.witness.counters
    remark = act(step, rig)
    words = " ".join(f"{value}" if key == "do" else f"{key}={value}" for key, value in what.items())
    say(f"  {words} ({(time.time_ns() - began_ns) / 1e9:.2f} s){'' if remark is None else ': ' + remark}")
    if step.do == "hold":
        return since
    acted_ns = time.time_ns()
    if step.do == "start":
        counters = {} if step.who == "daemon" else counters
        took_s = (acted_ns - began_ns) / 1e9
        outcome.seen.append(
            {"step": what, "seen": f"the {step.who} up after {took_s:.2f} s", "took_s": round(took_s, 3)}
        )
    return Since(acted_ns, began_ns, counters)


def register(commands: Any) -> None:
    """Add the command to what add_subparsers() returned; it sets `run`, a function of the parsed arguments."""
    parser = commands.add_parser(
        "faults",
        help="inject faults into the real daemon's camera, links, disk and peers, and verify its recovery",
        description="Start the daemon with a camera, an autopilot, a zenoh router and a subscriber, carry out the "
        "acts of the timeline and wait for the reactions that it expects. Every message that a peer received is "
        f"checked: none may be stale. Bundled timelines: {', '.join(bundled())}. Writes faults.json and daemon.log. "
        "Exit code 0 if everything was as expected, 1 if not, 2 for an invalid timeline.",
    )
    parser.add_argument(
        "--timeline",
        required=True,
        action="append",
        metavar="FILE",
        help="TOML file, or name of a bundled timeline; may be repeated",
    )
    parser.add_argument("--out", type=Path, default=Path("out") / "faults", metavar="DIR", help="output folder")
    parser.add_argument(
        "--scene", type=Path, default=BUNDLED_SEQUENCE, metavar="DIR", help="BOP scene folder that the camera plays"
    )
    parser.add_argument("--model", type=Path, default=SHIPPED_MODEL, help="ONNX file (default: the shipped one)")
    parser.set_defaults(run=run)


def bundled() -> list[str]:
    """Names of the timelines that come with the package."""
    return sorted(path.stem for path in TIMELINES.glob("*.toml"))


def run(args: argparse.Namespace) -> int:
    """Play the timelines one after the other on one rig. Raises InputError for an invalid timeline."""
    timelines = [load_timeline(timeline_path(name)) for name in args.timeline]
    if not args.model.is_file():
        raise InputError(f"--model {args.model}: is not a file")
    for name, timeline in zip(args.timeline, timelines, strict=True):
        if timeline.signed != timelines[0].signed:
            raise InputError(f"{name}: signed differs from that of {args.timeline[0]}: run them separately")
    on_volume = [name for name, timeline in zip(args.timeline, timelines, strict=True) if timeline.volume]
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / REPORT).unlink(missing_ok=True)  # of an earlier run: this one may end without
    if on_volume and not can_mount(args.out):
        raise InputError(f"{on_volume[0]}: volume = true needs a host that lets a user mount (unshare --mount)")
    rig = Rig(RigSettings(args.out, args.scene, args.model, volume=bool(on_volume), signed=timelines[0].signed))
    with rig:
        outcomes = [play_timeline(rig, timeline, say_out) for timeline in timelines]
    wrong = [*(text for outcome in outcomes for text in outcome.wrong), *violations(rig.witness)]
    oldest_ms = {peer: max(ages_ms(rig.witness, peer), default=None) for peer in (AUTOPILOT, SUBSCRIBER)}
    report = {
        "timelines": [{"title": outcome.title, "seen": outcome.seen, "wrong": outcome.wrong} for outcome in outcomes],
        "age_max_ms": oldest_ms,
        "poses": {peer: len(ages_ms(rig.witness, peer)) for peer in (AUTOPILOT, SUBSCRIBER)},
        "wrong": wrong,
    }
    (args.out / REPORT).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")
    oldest = ", ".join(f"{peer} {'–' if ms is None else f'{ms:.0f}'}" for peer, ms in oldest_ms.items())
    for text in wrong:
        say_out(f"FAILED: {text}")
    say_out(f"{len(rig.witness.poses)} poses received, maximum age on receipt {oldest} ms; {len(wrong)} failures")
    return EXIT_UNMET if wrong else 0


def timeline_path(name: str) -> Path:
    """The file of a timeline: a bundled one, or a path. Raises InputError if it is neither."""
    if name in bundled():
        return TIMELINES / f"{name}.toml"
    if not Path(name).is_file():
        raise InputError(f"{name}: is neither a file nor a bundled timeline: {', '.join(bundled())}")
    return Path(name)
