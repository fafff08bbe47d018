"""What every medium has in common."""

from __future__ import annotations

import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple, Protocol

from edge.links.errors import LinkError
from edge.links.mavlink_endpoints import NetworkEndpoint
from msgs.mavlink import FrameReader

Address = tuple[Any, ...]  # as the socket family writes it; of a serial port its device

DATAGRAM_MAX = 65_536  # bytes
CHUNK_MAX = 4096  # bytes of a stream at once
PENDING_MAX = 32_768  # bytes a byte stream may fall behind by, before whole messages are left out


class Received(NamedTuple):
    data: bytes
    sender: Address
    reader: FrameReader  # of the connection the data came by


class Transport(Protocol):
    """One endpoint, never blocking, driven by one thread."""

    endpoint: str

    @property
    def port(self) -> int | None:
        """The local port, where others may call."""

    @property
    def peer(self) -> Address | None:
        """Whom it talks with, if that is settled by the endpoint and there now."""

    @property
    def finds_peers(self) -> bool:
        """Whether anybody may call, so that the peer must show who it is."""

    def filenos(self) -> Sequence[int]:
        """What may become readable."""

    def tick(self, now_ns: int) -> None:
        """Let time pass: connect, flush."""

    def receive(self) -> Received | None:
        """The next bytes; None if nothing waits."""

    def send(self, data: bytes, peer: Address) -> bool:
        """Send a whole message; False if it could not be sent now, and then nothing of it is."""

    def reaches(self, peer: Address) -> bool:
        """Whether a peer found earlier can still be sent to."""

    def close(self) -> None: ...


def resolve(endpoint: NetworkEndpoint, kind: socket.SocketKind) -> tuple[socket.AddressFamily, Address]:
    """Family and address of an endpoint. Raises LinkError for a host without an address."""
    try:
        found = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind)
    except OSError as error:
        raise LinkError(
            f"MAVLink endpoint {endpoint.text}: host {endpoint.host!r} cannot be resolved: {error.strerror}"
        ) from error
    return found[0][0], found[0][4]


@contextmanager
def opening(endpoint: NetworkEndpoint, unready: socket.socket) -> Iterator[None]:
    """While a socket is made ready to be called. It is closed, and LinkError raised, if something will not do."""
    try:
        yield
    except OSError as error:
        unready.close()
        raise LinkError(f"MAVLink endpoint {endpoint.text} cannot be opened: {error.strerror}") from error


def local_port(bound: socket.socket) -> int:
    """The port that a network socket is bound to."""
    return int(bound.getsockname()[1])


class Outbox:
    """Bytes of a stream that the medium has not taken yet. A message goes in whole or not at all."""

    def __init__(self) -> None:
        self._pending = bytearray()

    def put(self, data: bytes) -> bool:
        if len(self._pending) + len(data) > PENDING_MAX:
            return False
        self._pending += data
        return True

    def flush(self, write: Any) -> None:
        """Hand on what `write(bytes) -> count` takes. Raises its OSError but for "would block"."""
        while self._pending:
            try:
                count = write(bytes(self._pending[:4096]))
            except BlockingIOError:
                return
            del self._pending[:count]
            if count == 0:
                return
