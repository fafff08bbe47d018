"""One endpoint and the peer that it accepts ("heeds").

A peer that connects to us (`udpin`, `tcpin`) is accepted once it sends the heartbeat of an autopilot that may be ours,
until it is silent or sends messages of other aircraft only; before, nothing is sent to it. A peer that we connect to is
accepted from the start. If the accepted peer no longer brings our autopilot, is another aircraft that was taken for
ours, or, with signing, delays our autopilot's messages and replays them later, it is replaced when ours itself is
received.
"""

from __future__ import annotations

import logging
import re
from collections import Counter
from typing import Any

from edge.links.mavlink_endpoints import plain_host
from edge.links.mavlink_packing import Letter, Packer
from edge.links.mavlink_receive import Receiver
from edge.links.mavlink_recognition import Recognition
from edge.links.mavlink_table import RATE_LIMITS_HZ
from edge.links.mavlink_vehicle import LOST_NS
from edge.links.transports.medium import Address, Received, Transport

log = logging.getLogger(__name__)

# A heartbeat of component 1 in MAVLink 2 and 1. Of other senders than the accepted peer, only these are examined.
AUTOPILOT_HEARTBEAT = re.compile(rb"\xfd.[\x00\x01].{3}\x01\x00{3}|\xfe\x09.{2}\x01\x00", re.DOTALL)


class Endpoint:
    """Passes incoming messages that `judge` accepts, and packs outgoing ones."""

    def __init__(
        self, transport: Transport, allowed_hosts: list[str], refused: Counter[str], judge: Recognition, packer: Packer
    ) -> None:
        self.transport = transport
        self._allowed_hosts = allowed_hosts
        self._refused = refused
        self._judge = judge
        self._packer = packer
        self._receiver = Receiver(refused)
        # Other senders have a separate rate limit: a flood of theirs must not use up the autopilot's.
        self._stranger_receiver = Receiver(refused)
        self._found: Address | None = None
        self._heard_ns = 0

    @property
    def peer(self) -> Address | None:
        return self._found if self.transport.finds_peers else self.transport.peer

    def believed(self, received: Received, now_ns: int) -> list[Any]:
        """The well-formed, authentic messages of received bytes, if they are from the accepted peer."""
        peer = self.peer
        stranger = received.sender != peer
        if stranger and (reason := self._unheard(received)) is not None:
            self._refused[reason] += 1
            return []
        receiver = self._stranger_receiver if stranger else self._receiver
        messages = receiver.take(received.data, received.reader, now_ns)
        # No short circuit: displaces() also remembers other aircraft.
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
        # Noise, unsigned messages and those of other aircraft do not keep a peer accepted.
        if not all(self._judge.is_stranger(message) for message in messages):
            self._heard_ns = now_ns
        return messages

    def _unheard(self, received: Received) -> str | None:
        """Why the bytes of a sender other than the accepted peer are not examined, or None."""
        if self.peer is not None and not (self.transport.finds_peers and AUTOPILOT_HEARTBEAT.search(received.data)):
            return "address"
        if self._allowed_hosts and plain_host(received.sender[0]) not in self._allowed_hosts:
            return "host"
        return None

    def send(self, letter: Letter) -> bool:
        """Send to the accepted peer, if any; False if that failed. Raises ValueError if a value does not fit its
        field."""
        peer, repeats = self.peer, letter.message.get_msgId() in RATE_LIMITS_HZ
        return peer is None or self.transport.send(self._packer.packed(letter), peer, yields=repeats)

    def tick(self, now_ns: int) -> None:
        """Maintain connections, and drop a peer that is silent or disconnected."""
        self.transport.tick(now_ns)
        if self._found is None:
            return
        if now_ns - self._heard_ns > LOST_NS or not self.transport.reaches(self._found):
            log.warning("mavlink: %s: nothing of our autopilot heard from %s", self.transport.endpoint, self._found)
            self._found = None
