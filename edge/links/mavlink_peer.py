"""One endpoint and whom it heeds there.

Who may call, on UDP and as a TCP server, is heeded once it shows the heartbeat of an autopilot that we listen to, and
until it falls silent; until then nothing is sent to it. Who was dialled is heeded from the start. Where messages are
signed, whoever holds back what the autopilot says and plays it later is heeded until the autopilot itself is heard.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable
from typing import Any

from edge.links.mavlink_endpoints import plain_host
from edge.links.mavlink_receive import Receiver
from edge.links.mavlink_vehicle import LOST_NS
from edge.links.transports.medium import Address, Received, Transport

log = logging.getLogger(__name__)


class Endpoint:
    """`introduces` says whether a message is such a heartbeat, `authentic` leaves out what is not signed as it must,
    `outruns` says whether a stranger's proves that the peer's are old; None: nothing does."""

    def __init__(
        self,
        transport: Transport,
        allowed_hosts: list[str],
        refused: Counter[str],
        authentic: Callable[[list[Any]], list[Any]],
        introduces: Callable[[Any], bool],
        outruns: Callable[[Any, int], bool] | None,
    ) -> None:
        self.transport = transport
        self._allowed_hosts = allowed_hosts
        self._refused = refused
        self._authentic = authentic
        self._introduces = introduces
        self._outruns = outruns
        self._receiver = Receiver(refused)
        # Strangers have a rate limit of their own: their flood must not use up the autopilot's.
        self._stranger_receiver = Receiver(refused)
        self._found: Address | None = None
        self._heard_ns = 0

    @property
    def peer(self) -> Address | None:
        return self._found if self.transport.finds_peers else self.transport.peer

    def believed(self, received: Received, now_ns: int) -> list[Any]:
        """The messages of received bytes that are sound, authentic and from whom we heed."""
        peer = self.peer
        stranger = received.sender != peer
        if stranger and (reason := self._unheard(received)) is not None:
            self._refused[reason] += 1
            return []
        receiver = self._stranger_receiver if stranger else self._receiver
        messages = receiver.take(received.data, received.reader, now_ns)
        if stranger and peer is not None and not self._outrun_by(messages, now_ns):
            self._refused["address"] += 1
            return []
        messages = self._authentic(messages)
        if stranger:
            if not any(self._introduces(message) for message in messages):
                self._refused["stranger"] += 1
                return []
            self._found = received.sender
            log.info("mavlink: %s: autopilot at %s", self.transport.endpoint, received.sender)
        if messages:  # of noise, or of what is not signed, nobody is kept
            self._heard_ns = now_ns
        return messages

    def _outrun_by(self, messages: list[Any], now_ns: int) -> bool:
        return self._outruns is not None and any(self._outruns(message, now_ns) for message in messages)

    def _unheard(self, received: Received) -> str | None:
        """Why a stranger's bytes are not even looked at, or None."""
        if self.peer is not None and (self._outruns is None or not self.transport.finds_peers):
            return "address"
        if self._allowed_hosts and plain_host(received.sender[0]) not in self._allowed_hosts:
            return "host"
        return None

    def send(self, data: bytes) -> bool:
        """Send to whom we heed, if there is anybody; False if that failed."""
        peer = self.peer
        return peer is None or self.transport.send(data, peer)

    def tick(self, now_ns: int) -> None:
        """Let time pass: connections come and go, and who is silent is heeded no more."""
        self.transport.tick(now_ns)
        if self._found is None:
            return
        if now_ns - self._heard_ns > LOST_NS or not self.transport.reaches(self._found):
            log.warning("mavlink: %s: nothing heard from %s", self.transport.endpoint, self._found)
            self._found = None
