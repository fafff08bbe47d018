"""The link to the autopilot: one thread that owns the sockets and serial ports and drives the station."""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from pathlib import Path

from edge import clock
from edge.config import MavlinkSettings
from edge.health import Condition
from edge.links.mavlink_packing import Letter, Packer
from edge.links.mavlink_peer import Endpoint
from edge.links.mavlink_station import Station
from edge.links.mavlink_vehicle import Contact
from edge.links.signing import Signing, open_signing
from edge.links.transports import open_transport
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import CameraInfo, Report
from msgs.mavlink import dialect

log = logging.getLogger(__name__)

TICK_S = 0.05
HEARING_A_TURN_NS = 10_000_000  # receiving time per endpoint and turn, so that a flood cannot block reports
HELD_UP_MAX_NS = 100_000_000  # between the check of a report's age and its sending
EVENTS_WAITING = 64
STOP_TIMEOUT_S = 5.0


def signing_of(settings: MavlinkSettings) -> Signing | None:
    """Signing as configured; None: unsigned. Raises InputError for an unusable key file."""
    if settings.signing_key is None:
        return None
    return open_signing(settings.signing_key, signing_state_of(settings, settings.signing_key), clock.utc_ns)


def signing_state_of(settings: MavlinkSettings, signing_key: Path) -> Path:
    """The file that stores the last timestamp used with the key."""
    return settings.signing_state or Path(f"{signing_key}.timestamp")


class MavlinkLink:
    """MAVLink on the endpoints of `settings`. No method except start and stop ever blocks."""

    def __init__(
        self,
        settings: MavlinkSettings,
        own_ship: OwnShipBuffer,
        camera_info: CameraInfo,
        requests: RequestQueue,
        signing: Signing | None = None,
    ) -> None:
        self._settings = settings
        self._signing = signing
        self._station = Station(settings, own_ship, camera_info, requests, signing)
        self._endpoints: list[Endpoint] = []
        self._counted = self._count()  # replaced as a whole by the thread, so that readers need no lock
        self._mail_lock = threading.Lock()
        self._report: Report | None = None
        self._condition: Condition | None = None
        self._events: deque[tuple[int, str, bool]] = deque(maxlen=EVENTS_WAITING)
        self._replaced = self._lost_events = 0
        self._sleep = clock.SleepWatch()
        self._stopping = threading.Event()
        self._wake, self._woken = socket.socketpair()
        self._thread: threading.Thread | None = None
        self._next_tick_ns = 0
        self._told: tuple[int | None, int | None] | None = None  # system and autopilot that were logged

    def start(self) -> None:
        """Open the endpoints and begin. Raises LinkError if one cannot be opened."""
        station = self._station
        for number, text in enumerate(self._settings.endpoints):
            transport, packer = open_transport(text), Packer(number, self._signing)
            hosts = self._settings.allowed_hosts
            self._endpoints.append(Endpoint(transport, hosts, station.refused, station.recognition, packer))
        for end in (self._wake, self._woken):
            end.setblocking(False)
        if not clock.stepped():  # in lock-step mode, settle() runs the turns instead
            self._thread = threading.Thread(target=self._run, name="mavlink", daemon=True)
            self._thread.start()

    def publish(self, report: Report) -> None:
        """Leave a report for the thread; one it has not taken yet is replaced and counted."""
        with self._mail_lock:
            self._replaced += self._report is not None
            self._report = report
        self._poke()

    def set_health(self, condition: Condition) -> None:
        """To be called in every iteration of the loop: without it, HEARTBEAT stops."""
        with self._mail_lock:
            self._condition = condition

    def event(self, severity: int, text: str, of_state: bool = False) -> None:
        """A message to the operator; `severity` is a MAV_SEVERITY (3 error, 4 warning, 6 info). `of_state`: it reports
        the daemon's state and is valid until the next one that does."""
        with self._mail_lock:
            self._lost_events += len(self._events) == EVENTS_WAITING
            self._events.append((severity, text, of_state))
        self._poke()

    def settle(self) -> None:
        """In lock-step mode, one turn on the caller's thread: send what is queued, receive, run what is due."""
        for part in self._turn():
            part()
        self._counted = self._count()

    def stop(self) -> None:
        """Send what is queued, end the thread and close the sockets. May be called twice, or without start."""
        self._stopping.set()
        self._poke()
        ended = True
        if self._thread is not None:
            self._thread.join(STOP_TIMEOUT_S)
            ended = not self._thread.is_alive()
            self._thread = None
        if self._signing is not None and ended:
            self._signing.rest()
        for endpoint in self._endpoints:
            endpoint.transport.close()
        self._endpoints.clear()
        self._wake.close()
        self._woken.close()

    def counters(self) -> dict[str, int]:
        """As of the thread's last tick; exact once it is stopped."""
        with self._mail_lock:
            return {**self._counted, "reports_replaced": self._replaced, "events_lost": self._lost_events}

    @property
    def ports(self) -> list[int]:
        """Local port of each endpoint that has one, in the settings' order."""
        return [port for endpoint in self._endpoints if (port := endpoint.transport.port) is not None]

    def _poke(self) -> None:
        # A full socket has wake-ups enough; a closed one means that the thread has ended.
        with contextlib.suppress(OSError):
            self._wake.send(b"\0")

    def _run(self) -> None:
        stopping = False
        while not stopping:
            waited = self._tried(self._wait)
            stopping = self._stopping.is_set()  # checked before the turn, so that it still sends all that is queued
            done = [self._tried(part) for part in self._turn()]
            if not (waited and all(done)):
                self._stopping.wait(TICK_S)  # no busy loop if every turn fails
        self._counted = self._count()

    def _tried(self, part: Callable[[], None]) -> bool:
        """Run a part; whether it succeeded. A failure loses only that part: an exception that ended the thread would
        silently end the link."""
        try:
            part()
        except Exception:
            self._station.counters["failed"] += 1
            log.exception("mavlink: a part of the link failed")
            return False
        return True

    def _turn(self) -> Iterator[Callable[[], None]]:
        """The parts of a turn, independent of each other: an endpoint that fails stops neither the others nor the
        heartbeat."""
        yield self._deliver
        for number, endpoint in enumerate(self._endpoints):
            yield partial(self._hear, number, endpoint)
        now_ns = clock.monotonic_ns()
        if now_ns >= self._next_tick_ns:
            self._next_tick_ns = now_ns + round(TICK_S * 1e9)
            for endpoint in self._endpoints:
                yield partial(self._maintain, endpoint, now_ns)
            yield partial(self._tick, now_ns)
            self._counted = self._count()

    def _wait(self) -> None:
        """Wait until there is something to receive or send, or the next tick is due."""
        poll = select.poll()  # a new one each time, as connections come and go; it has no kernel resources
        poll.register(self._woken, select.POLLIN)
        for endpoint in self._endpoints:
            for fileno in endpoint.transport.filenos():
                poll.register(fileno, select.POLLIN)
        poll.poll(max(0.0, (self._next_tick_ns - clock.monotonic_ns()) / 1e6))

    def _count(self) -> dict[str, int]:
        station = self._station
        counted = {
            **station.counters,
            **{f"refused_{reason}": count for reason, count in station.refused.items()},
            "reboots": station.vehicle.reboots,
            "rates_asked_again": station.vehicle.asked_again,
            "rates_refused": station.vehicle.refusals,
            "timesync_jumps": station.timesync.jumps,
        }
        uncertainty_ns = station.timesync.uncertainty_ns
        return counted if uncertainty_ns is None else {**counted, "timesync_uncertainty_us": uncertainty_ns // 1000}

    def _deliver(self) -> None:
        """Send what the loop has queued."""
        with contextlib.suppress(BlockingIOError):
            self._woken.recv(65536)
        with self._mail_lock:
            report, self._report = self._report, None
            condition, self._condition = self._condition, None
            events = list(self._events)
            self._events.clear()
        now_ns = clock.monotonic_ns()
        if condition is not None:
            self._station.health(condition, now_ns)
        if report is not None:
            try:
                self._send(self._in_time(report, now_ns))
            except ValueError as error:
                self._unpackable(error)
        for severity, text, of_state in events:
            self._send(self._station.event(severity, text, now_ns, of_state))

    def _in_time(self, report: Report, now_ns: int) -> Iterator[Letter]:
        """The report's messages one by one; ends if the process was held up after the report's age was checked, or the
        computer has slept since the last report."""
        for letter in self._station.report(report, now_ns):
            if self._sleep.slept_ns() or clock.monotonic_ns() - now_ns > HELD_UP_MAX_NS:
                self._station.counters["held_up"] += 1
                return
            yield letter

    def _hear(self, number: int, endpoint: Endpoint) -> None:
        now_ns = clock.monotonic_ns()
        until_ns = now_ns + HEARING_A_TURN_NS
        while now_ns < until_ns and (received := endpoint.transport.receive()) is not None:
            now_ns = clock.monotonic_ns()
            messages = endpoint.believed(received, now_ns)
            self._send(self._station.take(messages, number, now_ns), [endpoint])

    def _maintain(self, endpoint: Endpoint, now_ns: int) -> None:
        endpoint.tick(now_ns)
        self._station.counters["send_failed"] += endpoint.transport.dropped()

    def _tick(self, now_ns: int) -> None:
        was = self._station.vehicle.contact
        out = self._station.tick(now_ns)
        if was is Contact.HEARD and self._station.vehicle.contact is Contact.LOST:
            log.warning("mavlink: the autopilot's heartbeat has stopped")
        vehicle = self._station.vehicle
        if vehicle.contact is Contact.HEARD and (vehicle.system_id, vehicle.autopilot) != self._told:
            self._told = (vehicle.system_id, vehicle.autopilot)
            for sentence in self._station.withheld():
                log.warning("mavlink: %s", sentence)
        for sentence in self._station.news(now_ns):
            log.warning("mavlink: %s", sentence)
            self.event(dialect.MAV_SEVERITY_WARNING, sentence)
        self._send(out.everywhere)
        home = self._station.home
        if home is not None:
            self._send(out.home, self._endpoints[home : home + 1])

    def _send(self, letters: Iterable[Letter], endpoints: Sequence[Endpoint] | None = None) -> None:
        for letter in letters:
            try:
                for endpoint in self._endpoints if endpoints is None else endpoints:
                    self._station.counters["send_failed"] += not endpoint.send(letter)
            except ValueError as error:
                self._unpackable(error)

    def _unpackable(self, error: ValueError) -> None:
        """A value does not fit its field: the message is not sent."""
        self._station.counters["unpackable"] += 1
        log.warning("mavlink: not sent: %s", error)
