"""How MAVLink's bytes travel. Another medium is another class with these four methods."""

from __future__ import annotations

import re
import socket
from typing import Protocol

from edge.links.errors import LinkError

Address = tuple  # as the socket family writes it

DATAGRAM_MAX = 65_536
RECEIVE_BUFFER = 1 << 20


class Transport(Protocol):
    """One endpoint, never blocking, driven by one thread."""

    def fileno(self) -> int:
        """What a selector waits on."""

    def receive(self) -> tuple[bytes, Address] | None:
        """The next datagram and its sender; None if nothing waits."""

    def send(self, data: bytes, peer: Address) -> bool:
        """Send to a peer; False if it could not be sent now."""

    def close(self) -> None: ...


class Udp:
    """UDP: `udpin` is bound and answers whom it comes to trust, `udpout` talks to one address.

    Raises LinkError if the endpoint cannot be opened.
    """

    def __init__(self, endpoint: str) -> None:
        kind, host, port = _parts(endpoint)
        self.endpoint = endpoint
        self.peer: Address | None = None  # of udpout
        try:
            family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise LinkError(
                f"MAVLink endpoint {endpoint}: host {host!r} cannot be resolved: {error.strerror}"
            ) from error
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            if kind == "udpin":
                self._socket.bind(address)
            else:
                self._socket.bind(("", 0))
                self.peer = address
        except OSError as error:
            self._socket.close()
            raise LinkError(f"MAVLink endpoint {endpoint} cannot be opened: {error.strerror}") from error

    @property
    def port(self) -> int:
        """The local port."""
        return int(self._socket.getsockname()[1])

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> tuple[bytes, Address] | None:
        try:
            return self._socket.recvfrom(DATAGRAM_MAX)
        except OSError:
            # Nothing waits, or a peer's port is closed (ICMP): both mean no datagram.
            return None

    def send(self, data: bytes, peer: Address) -> bool:
        try:
            self._socket.sendto(data, peer)
        except OSError:
            return False
        return True

    def close(self) -> None:
        self._socket.close()


def _parts(endpoint: str) -> tuple[str, str, int]:
    match = re.fullmatch(r"(udpin|udpout):(?:\[([^\]]+)\]|([^:\s]+)):(\d+)", endpoint)
    if match is None:
        raise LinkError(f"MAVLink endpoint '{endpoint}' is not udpin:HOST:PORT or udpout:HOST:PORT")
    return match[1], match[2] or match[3], int(match[4])
