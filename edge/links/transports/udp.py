"""UDP, IPv4 and IPv6: `udpin` is bound and sends to an accepted peer, `udpout` sends to one address at a time."""

from __future__ import annotations

import logging
import socket
from collections.abc import Sequence

from edge import clock
from edge.links.errors import LinkError
from edge.links.mavlink_endpoints import NetworkEndpoint
from edge.links.transports.lookup import Lookup, Places
from edge.links.transports.medium import DATAGRAM_MAX, Address, Received, local_port, opening, resolve
from msgs.mavlink import FrameReader

log = logging.getLogger(__name__)

RECEIVE_BUFFER = 1 << 20
SILENT_NS = 5_000_000_000  # after this silence the host may have another address


def _bound(endpoint: NetworkEndpoint, family: socket.AddressFamily, address: Address) -> socket.socket:
    """A bound socket. Raises LinkError if that fails."""
    with opening(endpoint, family, socket.SOCK_DGRAM) as opened:
        opened.setblocking(False)
        opened.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        opened.bind(address)
    return opened


class Udp:
    """`udpin`. Raises LinkError if the endpoint cannot be opened."""

    finds_peers = True
    peer: Address | None = None

    def __init__(self, endpoint: NetworkEndpoint) -> None:
        self.endpoint = endpoint.text
        self._reader = FrameReader(datagram=True)
        self._socket = _bound(endpoint, *resolve(endpoint, socket.SOCK_DGRAM)[0])

    @property
    def port(self) -> int | None:
        """The local port."""
        return local_port(self._socket)

    def filenos(self) -> Sequence[int]:
        return (self._socket.fileno(),)

    def tick(self, now_ns: int) -> None:
        """Nothing to do: peers send to us first."""

    def receive(self) -> Received | None:
        try:
            data, sender = self._socket.recvfrom(DATAGRAM_MAX)
        except OSError:
            # No data, or a peer's port is closed (ICMP): both mean no datagram.
            return None
        return Received(data, sender, self._reader)

    def send(self, data: bytes, peer: Address, *, yields: bool = False) -> bool:
        try:
            self._socket.sendto(data, peer)
        except OSError:
            return False
        return True

    def dropped(self) -> int:
        return 0  # no datagram waits

    def reaches(self, peer: Address) -> bool:
        return True

    def close(self) -> None:
        self._socket.close()


class UdpCaller:
    """`udpout`: one host, resolved until it has an address, and again after each SILENT_NS without data from there.

    Several addresses are then tried in turn.
    """

    finds_peers = False

    def __init__(self, endpoint: NetworkEndpoint) -> None:
        self.endpoint = endpoint.text
        self.peer: Address | None = None
        self._named = endpoint
        self._lookup = Lookup(endpoint, socket.SOCK_DGRAM)
        self._reader = FrameReader(datagram=True)
        self._socket: socket.socket | None = None
        self._heard = self._told = False
        self._called_ns: dict[Address, int] = {}  # by address of the host: when it was last tried
        now_ns = clock.monotonic_ns()
        self._look_at_ns = now_ns
        self.tick(now_ns)

    @property
    def port(self) -> int | None:
        return None if self._socket is None else local_port(self._socket)

    def filenos(self) -> Sequence[int]:
        return () if self._socket is None else (self._socket.fileno(),)

    def tick(self, now_ns: int) -> None:
        if self._heard:
            self._heard, self._look_at_ns = False, now_ns + SILENT_NS
        if now_ns < self._look_at_ns or (places := self._lookup.answer()) is None:
            return
        self._look_at_ns = now_ns + SILENT_NS
        try:
            if isinstance(places, LinkError):
                raise places
            self._call_next(places, now_ns)
        except LinkError as error:
            if not self._told:
                log.warning("mavlink: %s; trying again", error)
            self._told = True

    def receive(self) -> Received | None:
        if self._socket is None:
            return None
        try:
            data, sender = self._socket.recvfrom(DATAGRAM_MAX)
        except OSError:
            return None
        self._heard = self._heard or sender == self.peer
        return Received(data, sender, self._reader)

    def send(self, data: bytes, peer: Address, *, yields: bool = False) -> bool:
        try:
            return self._socket is not None and self._socket.sendto(data, peer) > 0
        except OSError:
            return False

    def dropped(self) -> int:
        return 0

    def reaches(self, peer: Address) -> bool:
        return peer == self.peer

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()

    def _call_next(self, places: Places, now_ns: int) -> None:
        """Use the address tried longest ago, as name resolution returns several in any order.

        One that this host cannot reach at all, for lack of a route, is skipped. Raises LinkError if all are.
        """
        before_ns = self._called_ns
        self._called_ns = {address: before_ns.get(address, -1) for _, address in places}
        failed: LinkError | None = None
        for family, address in sorted(places, key=lambda place: self._called_ns[place[1]]):
            self._called_ns[address] = now_ns
            try:
                self._call(family, address)
            except LinkError as error:
                failed = error
                continue
            # Otherwise logged already: for a peer that never sends, addresses are tried in turn indefinitely.
            if address not in before_ns or self._told:
                log.info("mavlink: %s: calling %s", self.endpoint, address)
                self._told = False
            return
        if failed is not None:
            raise failed

    def _call(self, family: socket.AddressFamily, address: Address) -> None:
        """Raises LinkError if this host cannot reach the address at all."""
        with opening(self._named, family, socket.SOCK_DGRAM) as probe:
            probe.connect(address)  # sends nothing, and fails if there is no route
        probe.close()
        if self._socket is None or self._socket.family != family:
            opened = _bound(self._named, family, ("", 0))
            self.close()
            self._socket = opened
        self.peer = address
