"""A degraded link between daemon and autopilot: delay, jitter, loss and reordering of datagrams. Pure."""

from __future__ import annotations

import argparse
import heapq
import random
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields

DELAY_MS_MAX = 5000.0
SEED = 0


@dataclass(frozen=True)
class LinkFaults:
    """The same in both directions."""

    delay_ms: float = 0.0  # of every datagram
    jitter_ms: float = 0.0  # in addition, uniform from 0; the order is kept
    loss: float = 0.0  # share that never arrives
    reorder: float = 0.0  # share that is overtaken by the next one

    @property
    def late_ms_max(self) -> float:
        """Longest time until the last datagram has arrived."""
        return self.delay_ms + self.jitter_ms

    def arguments(self) -> list[str]:
        """As command-line arguments for `add_options`."""
        given = {name: value for name, value in asdict(self).items() if value}
        return [word for name, value in given.items() for word in (_option(name), str(value))]


def add_options(parser: argparse._ActionsContainer) -> None:
    """One option per fault, `--link-delay-ms` and so on."""
    words = {
        "delay_ms": ("MS", f"delay of every datagram, 0 to {DELAY_MS_MAX:g}"),
        "jitter_ms": ("MS", "additional random delay, uniform from 0 to MS"),
        "loss": ("SHARE", "share of datagrams that are lost, 0 to 1"),
        "reorder": ("SHARE", "share of datagrams that the next one overtakes, 0 to 1"),
    }
    for one in fields(LinkFaults):
        metavar, text = words[one.name]
        kind = _milliseconds if metavar == "MS" else _share
        parser.add_argument(_option(one.name), type=kind, default=0.0, metavar=metavar, help=text)


def link_faults(args: argparse.Namespace) -> LinkFaults:
    """The faults requested on the command line."""
    return LinkFaults(*(getattr(args, f"link_{one.name}") for one in fields(LinkFaults)))


class Lane:
    """One direction. Takes datagrams in order of time (ns of any one clock), returns those that have arrived."""

    def __init__(self, faults: LinkFaults, seed: int = SEED) -> None:
        self._faults = faults
        self._chance = random.Random(seed)
        self._waiting: list[tuple[int, int, bytes]] = []  # due, tie-break, datagram
        self._number = 0
        self._last_due_ns = 0
        self._held: bytes | None = None

    def put(self, datagram: bytes, now_ns: int) -> None:
        """Send one datagram."""
        if self._chance.random() < self._faults.loss:
            return
        if self._held is None and self._chance.random() < self._faults.reorder:
            self._held = datagram
            return
        late_ms = self._faults.delay_ms + self._chance.uniform(0.0, self._faults.jitter_ms)
        self._last_due_ns = max(now_ns + round(late_ms * 1e6), self._last_due_ns)
        self._push(datagram)
        if self._held is not None:
            self._push(self._held)
            self._held = None

    def due(self, now_ns: int) -> list[bytes]:
        """Datagrams that have arrived by `now_ns`, in the order of arrival."""
        out = []
        while self._waiting and self._waiting[0][0] <= now_ns:
            out.append(heapq.heappop(self._waiting)[2])
        return out

    def next_due_ns(self) -> int | None:
        """Arrival time of the next one; None: none is in flight."""
        return self._waiting[0][0] if self._waiting else None

    def _push(self, datagram: bytes) -> None:
        heapq.heappush(self._waiting, (self._last_due_ns, self._number, datagram))
        self._number += 1


def _option(name: str) -> str:
    return f"--link-{name.replace('_', '-')}"


def _between(low: float, high: float) -> Callable[[str], float]:
    def value(text: str) -> float:
        try:
            number = float(text)
        except ValueError:
            number = low - 1.0
        if not low <= number <= high:
            raise argparse.ArgumentTypeError(f"'{text}' is not a number from {low:g} to {high:g}")
        return number

    return value


_milliseconds = _between(0.0, DELAY_MS_MAX)
_share = _between(0.0, 1.0)
