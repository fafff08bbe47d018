"""One endpoint and whom it heeds there.

Who may call, on UDP and as a TCP server, is heeded once it shows the heartbeat of an autopilot that we listen to, and
until it falls silent, or speaks for other aircraft alone; before, nothing is sent to it. Who was dialled is heeded from
the start. Another's autopilot that was taken for ours, and where messages are signed whoever holds back what ours says
and plays it later, is heeded until ours itself is heard.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from typing import Any, Protocol

from edge.links.mavlink_endpoints import plain_host
from edge.links.mavlink_packing import Letter, Packer
from edge.links.mavlink_receive import Receiver
from edge.links.mavlink_vehicle import LOST_NS
from edge.links.transports.medium import Address, Received, Transport

log = logging.getLogger(__name__)

# What a heartbeat of component 1 looks like, in MAVLink 2 and 1. Of those who are not heeded nothing else is looked at.
AUTOPILOT_HEARTBEAT = re.compile(rb"\xfd.[\x00\x01].{3}\x01\x00{3}|\xfe\x09.{2}\x01\x00", re.DOTALL)


class Judge(Protocol):
    """Who knows which autopilot is ours (`Recognition`)."""

    def authentic(self, messages: list[Any]) -> list[Any]:
        """Leaves out what is not signed as it must."""

    def introduces(self, message: Any, now_ns: int) -> bool:
        """Whether it is a heartbeat for which its sender is heeded where nobody is; another's is remembered."""

    def displaces(self, message: Any, now_ns: int) -> bool:
        """Whether it is one for which its sender is heeded in the place of another."""

    def is_stranger(self, message: Any) -> bool:
        """Whether it is of another aircraft, for which nobody is heeded."""


class Endpoint:
    """Of messages that come in it lets pass what `judge` believes, and packs for itself what goes out."""

    def __init__(
        self, transport: Transport, allowed_hosts: list[str], refused: Counter[str], judge: Judge, packer: Packer
    ) -> None:
        self.transport = transport
        self._allowed_hosts = allowed_hosts
        self._refused = refused
        self._judge = judge
        self._packer = packer
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
        # All are looked at: other aircraft are remembered by it.
        if stranger and peer is not None and not any([self._judge.displaces(message, now_ns) for message in messages]):
            self._refused["address"] += 1
            return []
        messages = self._judge.authentic(messages)
        if stranger:
            if not any([self._judge.introduces(message, now_ns) for message in messages]):
                self._refused["stranger"] += 1
                return []
            self._found = received.sender
            log.info("mavlink: %s: autopilot at %s", self.transport.endpoint, received.sender)
        # Of noise, of what is not signed, or of what other aircraft say, nobody is kept.
        if not all(self._judge.is_stranger(message) for message in messages):
            self._heard_ns = now_ns
        return messages

    def _unheard(self, received: Received) -> str | None:
        """Why a stranger's bytes are not even looked at, or None."""
        if self.peer is not None and not (self.transport.finds_peers and AUTOPILOT_HEARTBEAT.search(received.data)):
            return "address"
        if self._allowed_hosts and plain_host(received.sender[0]) not in self._allowed_hosts:
            return "host"
        return None

    def send(self, letter: Letter) -> bool:
        """Send to whom we heed, if there is anybody; False if that failed. Raises ValueError for a value that no field
        holds."""
        peer = self.peer
        return peer is None or self.transport.send(self._packer.packed(letter), peer)

    def tick(self, now_ns: int) -> None:
        """Let time pass: connections come and go, and who is silent is heeded no more."""
        self.transport.tick(now_ns)
        if self._found is None:
            return
        if now_ns - self._heard_ns > LOST_NS or not self.transport.reaches(self._found):
            log.warning("mavlink: %s: nothing of our autopilot heard from %s", self.transport.endpoint, self._found)
            self._found = None
