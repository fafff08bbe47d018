"""Common parts of all transports."""

from __future__ import annotations

import fcntl
import socket
import sys
import termios
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple, Protocol

from edge.links.errors import LinkError
from edge.links.mavlink_endpoints import NetworkEndpoint
from msgs.mavlink import FrameReader

Address = tuple[Any, ...]  # in the socket family's form; for a serial port, its device

DATAGRAM_MAX = 65_536  # bytes
CHUNK_MAX = 4096  # bytes of a stream at once
PENDING_MAX = 32_768  # bytes that may be pending on a byte stream before whole messages are dropped
WAITING_MAX_NS = 200_000_000  # how long a message may wait before it is dropped
BEHIND_NS = 20_000_000  # the messages of one frame are put within less


class Received(NamedTuple):
    data: bytes
    sender: Address
    reader: FrameReader  # of the connection that the data came from


class Transport(Protocol):
    """One endpoint, never blocking, driven by one thread."""

    endpoint: str

    @property
    def port(self) -> int | None:
        """The local port, if others can connect to it."""

    @property
    def peer(self) -> Address | None:
        """The peer, if it is determined by the endpoint and available now."""

    @property
    def finds_peers(self) -> bool:
        """Whether anybody can connect, so that a peer must identify itself first."""

    def filenos(self) -> Sequence[int]:
        """File descriptors to poll for reading."""

    def tick(self, now_ns: int) -> None:
        """Periodic work: connect, flush."""

    def receive(self) -> Received | None:
        """The next bytes; None if there are none."""

    def send(self, data: bytes, peer: Address, *, yields: bool = False) -> bool:
        """Send a whole message; False if it cannot be sent now, and then no part of it is. `yields`: it is one of many
        and not sent while others wait."""

    def dropped(self) -> int:
        """Number of messages since the last call that `send` took, but that the medium then did not."""

    def reaches(self, peer: Address) -> bool:
        """Whether a peer found earlier can still be sent to."""

    def close(self) -> None: ...


def resolve(
    endpoint: NetworkEndpoint, kind: socket.SocketKind, flags: int = 0
) -> list[tuple[socket.AddressFamily, Address]]:
    """Families and addresses of an endpoint: all that its host has. Raises LinkError for a host without any."""
    try:
        found = socket.getaddrinfo(endpoint.host, endpoint.port, type=kind, flags=flags)
    except (OSError, UnicodeError) as error:
        # Python rejects 192.168..10, or a label of more than 63 characters, without a query.
        reason = error.strerror if isinstance(error, OSError) else "no host can have this name"
        raise LinkError(
            f"MAVLink endpoint {endpoint.text}: host {endpoint.host!r} cannot be resolved: {reason}"
        ) from error
    return [(family, address) for family, _, _, _, address in found]


@contextmanager
def opening(
    endpoint: NetworkEndpoint, family: socket.AddressFamily, kind: socket.SocketKind
) -> Iterator[socket.socket]:
    """A socket while it is prepared for listening. On any error it is closed and LinkError raised."""
    with ExitStack() as unready:
        try:
            yield unready.enter_context(socket.socket(family, kind))
        except OSError as error:
            raise LinkError(f"MAVLink endpoint {endpoint.text} cannot be opened: {error.strerror}") from error
        unready.pop_all()


def local_port(bound: socket.socket) -> int:
    """The port that a network socket is bound to."""
    return int(bound.getsockname()[1])


class Outbox:
    """Messages for a stream that the medium has not accepted yet.

    A message is accepted whole or not at all, and sent soon or never: on a line that is too slow or was interrupted,
    poses would accumulate and arrive outdated.
    """

    def __init__(self) -> None:
        self.expired = 0  # messages dropped because they had waited too long, or the medium was gone
        self._told = 0
        self._waiting: deque[tuple[int, bytes]] = deque()  # time of put (ns), message
        self._pending_bytes = 0
        self._begun = b""  # the rest of a partly written message, which must be completed

    def put(self, data: bytes, now_ns: int, *, yields: bool = False) -> bool:
        """Whether the message was accepted. One that `yields` is not while others have waited for BEHIND_NS: on a line
        that is too slow for all poses, answers and heartbeats behind them would otherwise expire."""
        self._forget(now_ns)
        if yields and self._waiting and now_ns - self._waiting[0][0] > BEHIND_NS:
            return False
        if self._pending_bytes + len(data) > PENDING_MAX:
            return False
        self._waiting.append((now_ns, data))
        self._pending_bytes += len(data)
        return True

    def flush(self, write: Callable[[bytes], int], room_bytes: int, now_ns: int) -> None:
        """Write what `write(bytes) -> count` accepts, until `room_bytes` are exceeded. Raises its OSError except "would
        block"."""
        self._forget(now_ns)
        while room_bytes > 0 and (self._begun or self._waiting):
            if not self._begun:
                self._begun = self._waiting.popleft()[1]
                self._pending_bytes -= len(self._begun)
            try:
                count = write(self._begun)
            except BlockingIOError:
                return
            self._begun = self._begun[count:]
            room_bytes -= count
            if count == 0:
                return

    def close(self) -> None:
        """The medium is gone: drop everything."""
        self.expired += len(self._waiting) + bool(self._begun)
        self._waiting.clear()
        self._pending_bytes, self._begun = 0, b""

    def dropped(self) -> int:
        """Number of messages dropped since the last call."""
        count, self._told = self.expired - self._told, self.expired
        return count

    def _forget(self, now_ns: int) -> None:
        while self._waiting and now_ns - self._waiting[0][0] > WAITING_MAX_NS:
            self._pending_bytes -= len(self._waiting.popleft()[1])
            self.expired += 1


def unsent_bytes(fileno: int) -> int:
    """Written bytes that are still in the kernel (tty) or not acknowledged (TCP)."""
    return int.from_bytes(fcntl.ioctl(fileno, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
