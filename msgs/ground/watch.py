"""`uavpose-ground watch`: live table of vehicles, their health and their targets."""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass

import zenoh
from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.live import Live
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from msgs.cdr import DiagnosticArray, Log
from msgs.command_line import output
from msgs.ground.feed import Incoming, linked, listening, session
from msgs.ground.fleet import HEALTH_STALE_NS, SET_BACK_NS, TAKEN, DirectionRow, Fleet, Row, TargetRow, VehicleRow
from msgs.session import TlsFiles
from msgs.wire import Refusal

REFRESH_S = 0.25
PLAIN_PERIOD_S = 2.0
STALE_S = 1.0
_LEVEL_STYLE = {0: "green", 1: "yellow", 2: "bold red"}
_NS = 1_000_000_000


class Terminal(Console):
    """Standard output. Leaves it to the command line what follows when nobody reads it any more."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


@dataclass(frozen=True)
class WatchOptions:
    """Which vehicles to show, and how."""

    endpoint: str
    tls: TlsFiles | None = None
    uavs: Sequence[str] = ()  # empty: all
    domain: int = 0
    max_age_s: float = 2.0
    as_json: bool = False


def watch(options: WatchOptions, stop: threading.Event, console: Console, say: Callable[[str], None]) -> int:
    """Show the vehicles until `stop` is set; returns 0. Raises InputError for a bad endpoint, OutputError on a full
    disk, BrokenPipeError if nobody reads them any more."""
    fleet = Fleet(domain=options.domain, max_age_s=options.max_age_s)
    show = _watch_json if options.as_json else _watch_table
    with session(options.endpoint, options.tls, stop, say) as opened:
        if opened is not None:
            show(options, fleet, opened, stop, console)
    return 0


def _watch_table(
    options: WatchOptions, fleet: Fleet, opened: zenoh.Session, stop: threading.Event, console: Console
) -> None:
    def take(incoming: Incoming) -> None:
        fleet.take(incoming, time.time_ns())

    def picture(*, one_line: bool) -> Group:
        now_ns = time.time_ns()
        return table(fleet.rows(now_ns), linked(opened), options.endpoint, now_ns, one_line=one_line)

    with listening(opened, options.uavs, options.domain, take, fleet.alive, TAKEN):
        if not console.is_terminal or console.is_dumb_terminal:  # a picture cannot be replaced there
            ended = False
            while not ended:
                ended = stop.wait(PLAIN_PERIOD_S)
                with output():
                    console.print(picture(one_line=False))
            return
        with Live(Fitted(picture(one_line=True)), console=console, auto_refresh=False) as live:
            ended = False
            while not ended:
                ended = stop.wait(REFRESH_S)
                live.update(Fitted(picture(one_line=True)), refresh=True)


@dataclass(frozen=True)
class Fitted:
    """A picture cut to the height of the screen; the last line then says how many lines are hidden."""

    picture: Group

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        lines = console.render_lines(self.picture, options, pad=False)
        if len(lines) > console.height:
            hidden = len(lines) - (console.height - 1)
            lines = lines[: console.height - 1]
            told = Text(f"… {hidden} more lines: enlarge the window, or choose with --uav", "yellow", no_wrap=True)
            lines += console.render_lines(told, options, pad=False)
        for line in lines:
            yield from line
            yield Segment.line()


def _watch_json(
    options: WatchOptions, fleet: Fleet, opened: zenoh.Session, stop: threading.Event, console: Console
) -> None:
    """One JSON object per line: `pose`, `direction` (range unknown), `health`, `event`, `refused` (how many samples),
    `vehicle` (present or gone) and `link` (up or down).

    Raises OutputError if the lines cannot be written, as into a file on a full disk, BrokenPipeError if nobody reads
    them any more.
    """
    lock, broken = threading.Lock(), list[OSError]()

    def tell(**values: object) -> None:
        line = json.dumps(values)
        with lock:
            if broken:
                return
            try:
                console.file.write(line + "\n")
                console.file.flush()
            except OSError as error:
                broken.append(error)
                stop.set()

    def take(incoming: Incoming) -> None:
        now_ns = time.time_ns()
        match fleet.take(incoming, now_ns):
            case TargetRow() as row:
                tell(type="pose", age_s=(now_ns - row.stamp_ns) / _NS, **asdict(row))
            case DirectionRow() as row:
                tell(type="direction", age_s=(now_ns - row.stamp_ns) / _NS, **asdict(row))
            case DiagnosticArray(stamp_ns=stamp_ns, status=status):
                one = status[0]
                tell(
                    type="health",
                    uav=incoming.uav,
                    stamp_ns=stamp_ns,
                    level=one.level,
                    health=one.message,
                    values=dict(one.values),
                )
            case Log() as event:
                tell(type="event", uav=incoming.uav, stamp_ns=event.stamp_ns, level=event.level, event=event.msg)

    def alive(uav: str, here: bool) -> None:
        fleet.alive(uav, here)
        tell(type="vehicle", uav=uav, alive=here)

    with listening(opened, options.uavs, options.domain, take, alive, TAKEN):
        told: bool | None = None
        counted = dict[str, Counter[Refusal]]()
        while True:
            up = linked(opened)
            if up != told:
                tell(type="link", up=up)
                told = up
            for row in fleet.rows(time.time_ns()):
                if row.refused != counted.get(row.uav, Counter()):
                    tell(type="refused", uav=row.uav, counts={why.value: number for why, number in row.refused.items()})
                    counted[row.uav] = row.refused
            if stop.wait(REFRESH_S):
                break
    if broken:
        with output():
            raise broken[0]


def table(vehicles: Sequence[VehicleRow], up: bool, endpoint: str, now_ns: int, *, one_line: bool = False) -> Group:
    """The tables at `now_ns` (UTC): one row per target, and one per vehicle; with `one_line`, health and event are cut
    to what fits on one line, and are wrapped otherwise.

    A bearing with a `c` is measured from the optical axis to the right, as the vehicle's attitude is unknown. A range
    of `?` is not known: no pose is sent of that target, only its direction. Of a vehicle without targets, the
    table says why most samples were refused.
    """
    link = Text(f"{endpoint}: up" if up else f"{endpoint}: no link", style="green" if up else "bold red")
    fleet = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    found = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    # Eighty columns suffice for short names; longer cells wrap: truncated, 1218.2 m would read 12….
    found.add_column("target", overflow="fold")
    for name in ("range m", "±", "close m/s", "brg °", "el °", "hdg/pit/rol °", "±°", "score", "age s"):
        found.add_column(name, justify="right", overflow="fold")
    for name in ("vehicle", "link", "health", "poses/s", "refused", "last event"):
        fleet.add_column(name, overflow="fold")
    for one in vehicles:
        for target in one.targets:
            stale = (now_ns - target.heard_ns) / _NS > STALE_S
            found.add_row(*_cells(target, now_ns), style="dim" if stale else None)
        here = Text("here", style="green") if one.alive else Text("gone", style="bold red")
        health, event = _health(one, now_ns), Text(_printable(one.event) or "–")
        refused = Text(str(one.refused.total()))
        if one.refused and not one.targets:
            refused.append(f": {one.refused.most_common(1)[0][0].value}")
        for text in (health, refused, event) if one_line else ():
            text.no_wrap, text.overflow = True, "ellipsis"
        fleet.add_row(one.uav, here, health, f"{one.pose_rate_hz:.1f}", refused, event)
    return Group(link, found, fleet)


def _health(row: VehicleRow, now_ns: int) -> Text:
    """Dimmed, with its age, once it is stale; omitted if it was received before our clock was set back."""
    age_s = (now_ns - row.health_heard_ns) / _NS
    if not row.health_heard_ns or age_s < -SET_BACK_NS / _NS:
        return Text("–", style="dim")
    text = _printable(row.health)
    if row.alive and age_s <= HEALTH_STALE_NS / _NS:
        return Text(text, style=_LEVEL_STYLE.get(row.level, "dim"))
    return Text(f"{text} ({max(age_s, 0.0):.0f} s ago)", style="dim")


def _printable(text: str) -> str:
    """Removes control characters, so that received text cannot control the terminal."""
    return "".join(one if one.isprintable() else " " for one in text)


def _cells(row: Row, now_ns: int) -> tuple[str, ...]:
    name, age = f"{row.uav}/{row.target}", f"{(now_ns - row.stamp_ns) / _NS:.2f}"
    bearing = f"{row.bearing_deg:.1f}" + ("" if row.frame == "ned" else "c"), f"{row.elevation_deg:+.1f}"
    if isinstance(row, DirectionRow):
        return name, "?", "?", "–", *bearing, "–", "?", "–", age
    roll, pitch, heading = row.attitude_deg or (None, None, None)
    return (
        name,
        f"{row.range_m:.1f}",
        f"{row.sigma_range_m:.1f}",
        "–" if row.closing_mps is None else f"{row.closing_mps:+.1f}",
        *bearing,
        "–" if heading is None else f"{heading:.0f}/{pitch:+.0f}/{roll:+.0f}",
        "?" if row.sigma_rotation_deg is None else f"{row.sigma_rotation_deg:.0f}",
        "–" if row.score is None else f"{row.score:.2f}",
        age,
    )
