"""State of the autopilot: received or not, which one, reboots, and the rates of the messages that we requested.

A pure state machine: every time is an argument, the only output is decisions.

    WAITING --autopilot heartbeat--> HEARD --no heartbeat for 5 s--> LOST --heartbeat--> HEARD

Rates are requested for one message at a time by MAV_CMD_SET_MESSAGE_INTERVAL, and again if a rate drops: another peer
may have overwritten it. After a refusal or no answer the pause grows, to at most RETRY_MAX_NS. A message that stands in
for another is requested only if that one was requested without success.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from enum import Enum

from edge.links.mavlink_succession import Succession
from edge.tracking.clock import RebootDetector, StepDetector

LOST_NS = 5_000_000_000
ACK_TIMEOUT_NS = 1_000_000_000
RETRY_NS = 3_000_000_000
RETRY_MAX_NS = 30_000_000_000
RATE_WINDOW_NS = 2_500_000_000  # not a multiple of the longest period, 1 s: jitter would change the count
RATE_ENOUGH = 0.7  # of the requested rate
IN_VAIN = 2  # requests without any message received


class Contact(Enum):
    WAITING = "waiting"
    HEARD = "heard"
    LOST = "lost"


@dataclass
class Stream:
    """One message that we request at a rate."""

    message_id: int
    rate_hz: float
    arrivals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=1024))
    asked_ns: int | None = None
    times_asked: int = 0
    pause_ns: int = RETRY_NS

    def measured_hz(self, now_ns: int) -> float:
        """Rate over RATE_WINDOW_NS."""
        while self.arrivals_ns and now_ns - self.arrivals_ns[0] > RATE_WINDOW_NS:
            self.arrivals_ns.popleft()
        return len(self.arrivals_ns) * 1e9 / RATE_WINDOW_NS

    def due(self, now_ns: int) -> bool:
        """Whether to request it: never requested, or requested long enough ago and still too slow."""
        if self.asked_ns is None:
            return True
        if self.measured_hz(now_ns) >= RATE_ENOUGH * self.rate_hz:
            self.pause_ns = RETRY_NS
            return False
        return now_ns - self.asked_ns >= self.pause_ns

    def asked(self, now_ns: int) -> None:
        if self.asked_ns is not None:
            self.pause_ns = min(2 * self.pause_ns, RETRY_MAX_NS)
        self.asked_ns = now_ns
        self.times_asked += 1


class Vehicle:
    """`system_id` None: from the first autopilot heartbeat; changes after it falls silent by the rules of `Succession`.

    `rates_hz` by message id; `stands_in`: id of a substitute message to the id of the message that it stands in for.
    """

    def __init__(
        self, system_id: int | None, rates_hz: dict[int, float], stands_in: dict[int, int] | None = None
    ) -> None:
        self.contact = Contact.WAITING
        self.system_id = system_id
        self.autopilot: int | None = None  # MAV_AUTOPILOT
        self.reboots = 0
        self.asked_again = 0
        self.refusals = 0  # answers other than ACCEPTED
        self._fixed = system_id is not None
        self._succession = Succession()
        self._heartbeat_ns: int | None = None
        self._spoke_ns: int | None = None
        self._boot = RebootDetector()
        self._rates_hz = dict(rates_hz)
        self._stands_in = stands_in or {}
        self._streams, self._steps = self._new_streams(), StepDetector()
        self._in_flight: tuple[int, int] | None = None  # message id, asked ns

    def heartbeat(self, system_id: int, autopilot: int | None, now_ns: int) -> bool:
        """An autopilot's heartbeat; False if it is another vehicle's. `autopilot` None: its kind is not changed."""
        if self._fixed and system_id != self.system_id:
            return False
        if not self._fixed and not self._succession.takes(system_id, self._silent(now_ns), now_ns):
            return False
        if self.system_id not in (None, system_id):
            self._forget()
        self.system_id = system_id
        self.autopilot = self.autopilot if autopilot is None else autopilot
        self._heartbeat_ns = self._spoke_ns = now_ns
        self.contact = Contact.HEARD
        return True

    def spoke(self, now_ns: int) -> None:
        """A message of any kind from our autopilot."""
        self._spoke_ns = now_ns
        self._succession.spoke(now_ns)

    def noticed(self, system_id: int, now_ns: int) -> None:
        """An autopilot's heartbeat from an address that is not accepted: it does not make it ours, and may never be."""
        self._succession.noticed(system_id, now_ns)

    def was_own(self, system_id: int) -> bool:
        """Whether a system was our own until it fell silent, and another one is now."""
        return self._succession.is_former(system_id)

    def is_stranger(self, system_id: int) -> bool:
        """Whether a system is known to be another aircraft's."""
        return self._succession.is_stranger(system_id)

    def boot_time(self, boot_ms: int) -> bool:
        """A timestamp of the autopilot; True if it shows that the autopilot has rebooted."""
        if not self._boot.rebooted(boot_ms):
            return False
        self.reboots += 1
        self.ask_anew()
        return True

    def clock_set_back(self, message_id: int, sequence: int, boot_ms: int) -> bool:
        """The same timestamp, with its message's id and sequence number; True if the clock was set back without a
        reboot."""
        return self._steps.set_back(message_id, sequence, boot_ms)

    def arrived(self, message_id: int, now_ns: int) -> None:
        if message_id in self._streams:
            self._streams[message_id].arrivals_ns.append(now_ns)

    def acknowledged(self, accepted: bool) -> None:
        """The answer to the pending request."""
        if self._in_flight is not None:
            self.refusals += not accepted
            self._in_flight = None

    def ask_anew(self) -> None:
        """Request all rates again: the autopilot may have lost them, or is received on another link now, where its
        messages have other numbers and delays."""
        self._streams, self._steps = self._new_streams(), StepDetector()
        self._in_flight = None

    def tick(self, now_ns: int) -> None:
        """Detect loss of the heartbeat."""
        if self.contact is Contact.HEARD and self._heartbeat_ns is not None and now_ns - self._heartbeat_ns > LOST_NS:
            self.contact = Contact.LOST
            self.ask_anew()

    def request(self, now_ns: int) -> tuple[int, float] | None:
        """(message id, Hz) to request now, or None."""
        if self.contact is not Contact.HEARD:
            return None
        if self._in_flight is not None and now_ns - self._in_flight[1] < ACK_TIMEOUT_NS:
            return None
        self._in_flight = None
        for stream in self._streams.values():
            if self._needed(stream, now_ns) and stream.due(now_ns):
                self.asked_again += stream.asked_ns is not None
                stream.asked(now_ns)
                self._in_flight = (stream.message_id, now_ns)
                return stream.message_id, stream.rate_hz
        return None

    def _needed(self, stream: Stream, now_ns: int) -> bool:
        if stream.message_id not in self._stands_in:
            return True
        better = self._streams[self._stands_in[stream.message_id]]
        return better.times_asked >= IN_VAIN and better.measured_hz(now_ns) == 0.0

    def _silent(self, now_ns: int) -> bool:
        # Any message shows that it is present, even if a congested line loses its heartbeats.
        quiet = self._spoke_ns is None or now_ns - self._spoke_ns > LOST_NS
        return quiet and self.contact is not Contact.HEARD

    def _forget(self) -> None:
        self._boot = RebootDetector()
        self.ask_anew()

    def _new_streams(self) -> dict[int, Stream]:
        return {message_id: Stream(message_id, rate_hz) for message_id, rate_hz in self._rates_hz.items()}
