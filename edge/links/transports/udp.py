"""UDP, IPv4 and IPv6: `udpin` is bound and answers whom it comes to trust, `udpout` talks to one address."""

from __future__ import annotations

import socket
from collections.abc import Sequence

from edge.links.mavlink_endpoints import NetworkEndpoint
from edge.links.transports.medium import DATAGRAM_MAX, Address, Received, local_port, opening, resolve
from msgs.mavlink import FrameReader

RECEIVE_BUFFER = 1 << 20


class Udp:
    """Raises LinkError if the endpoint cannot be opened."""

    def __init__(self, endpoint: NetworkEndpoint) -> None:
        self.endpoint = endpoint.text
        self.finds_peers = endpoint.kind == "udpin"
        self._reader = FrameReader(datagram=True)
        family, address = resolve(endpoint, socket.SOCK_DGRAM)
        self.peer: Address | None = None if self.finds_peers else address
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        with opening(endpoint, self._socket):
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            self._socket.bind(address if self.finds_peers else ("", 0))

    @property
    def port(self) -> int:
        """The local port."""
        return local_port(self._socket)

    def filenos(self) -> Sequence[int]:
        return (self._socket.fileno(),)

    def tick(self, now_ns: int) -> None:
        """UDP has no connection to look after."""

    def receive(self) -> Received | None:
        try:
            data, sender = self._socket.recvfrom(DATAGRAM_MAX)
        except OSError:
            # Nothing waits, or a peer's port is closed (ICMP): both mean no datagram.
            return None
        return Received(data, sender, self._reader)

    def send(self, data: bytes, peer: Address) -> bool:
        try:
            self._socket.sendto(data, peer)
        except OSError:
            return False
        return True

    def reaches(self, peer: Address) -> bool:
        return True

    def close(self) -> None:
        self._socket.close()
