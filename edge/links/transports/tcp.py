"""TCP, IPv4 and IPv6: a client that reconnects indefinitely, and a server."""

from __future__ import annotations

import errno
import logging
import socket
import struct
from collections import Counter
from collections.abc import Sequence

from edge import clock
from edge.links.errors import LinkError
from edge.links.mavlink_endpoints import NetworkEndpoint
from edge.links.transports.backoff import Backoff
from edge.links.transports.lookup import Lookup
from edge.links.transports.medium import (
    CHUNK_MAX,
    Address,
    Outbox,
    Received,
    local_port,
    opening,
    resolve,
    unsent_bytes,
)
from msgs.mavlink import FrameReader

log = logging.getLogger(__name__)

CONNECT_TIMEOUT_NS = 5_000_000_000
CALLERS_MAX = 8
UNANSWERED_MAX_NS = 1_000_000_000
UNANSWERED_MAX_BYTES = 4096  # about half a second of messages for one target


class Connection:
    """A connected socket with its reader; `open` turns False at its first error or end."""

    def __init__(self, connected: socket.socket, address: Address) -> None:
        self.address = address
        self.open = True
        self._socket = connected
        self._reader = FrameReader(datagram=False)
        self._outbox = Outbox()
        self._written = self._acknowledged = 0  # bytes
        self._answered_ns = clock.monotonic_ns()
        connected.setblocking(False)
        connected.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive(self) -> Received | None:
        try:
            data = self._socket.recv(CHUNK_MAX)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if not data:
            self.close()
            return None
        return Received(data, self.address, self._reader)

    def send(self, data: bytes, *, yields: bool) -> bool:
        if not self.open:
            return False
        fits = self._outbox.put(data, clock.monotonic_ns(), yields=yields)
        self.flush()
        return fits

    def dropped(self) -> int:
        return self._outbox.dropped()

    def flush(self) -> None:
        if not self.open:
            return
        try:
            now_ns, unanswered = clock.monotonic_ns(), unsent_bytes(self._socket.fileno())
            if unanswered == 0 or self._written - unanswered > self._acknowledged:
                self._acknowledged, self._answered_ns = self._written - unanswered, now_ns
            elif now_ns - self._answered_ns > UNANSWERED_MAX_NS:
                self._abort()
                return
            self._outbox.flush(self._write, UNANSWERED_MAX_BYTES - unanswered, now_ns)
        except OSError:
            self.close()

    def _write(self, data: bytes) -> int:
        count = self._socket.send(data)
        self._written += count
        return count

    def _abort(self) -> None:
        """Discard the connection's buffered data, which would be sent, outdated, once the link works again."""
        log.warning("mavlink: %s does not answer", self.address)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.close()

    def close(self) -> None:
        self.open = False
        self._outbox.close()
        self._socket.close()


class TcpClient:
    """Connects to a server; if that fails or the connection is lost, again after a growing wait.

    The host is resolved for each attempt; several addresses are tried in turn.
    """

    finds_peers = False
    port = None

    def __init__(self, endpoint: NetworkEndpoint) -> None:
        self.endpoint = endpoint.text
        self._lookup = Lookup(endpoint, socket.SOCK_STREAM)
        self._attempts = 0
        self._address: Address = ()
        self._backoff = Backoff()
        self._connecting: tuple[socket.socket, int] | None = None
        self._connection: Connection | None = None
        self._dropped = 0  # by earlier connections

    @property
    def peer(self) -> Address | None:
        return self._address if self._connection is not None else None

    def filenos(self) -> Sequence[int]:
        # The connection may have been closed meanwhile by a send that found the peer gone.
        connection = self._connection
        return (connection.fileno(),) if connection is not None and connection.open else ()

    def tick(self, now_ns: int) -> None:
        if self._connection is not None:
            self._connection.flush()
            self._part_if_closed(now_ns)
        elif self._connecting is not None:
            self._look_if_connected(now_ns)
        elif self._backoff.due(now_ns) and (places := self._lookup.answer()) is not None:
            if isinstance(places, LinkError):
                self._failed(str(places), now_ns)
            else:
                self._connect(*places[self._attempts % len(places)], now_ns)
                self._attempts += 1

    def receive(self) -> Received | None:
        received = self._connection.receive() if self._connection is not None else None
        self._part_if_closed(clock.monotonic_ns())
        return received

    def send(self, data: bytes, peer: Address, *, yields: bool = False) -> bool:
        return self._connection is not None and self._connection.send(data, yields=yields)

    def dropped(self) -> int:
        count, self._dropped = self._dropped, 0
        return count + (self._connection.dropped() if self._connection is not None else 0)

    def reaches(self, peer: Address) -> bool:
        return self._connection is not None

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
        if self._connecting is not None:
            self._connecting[0].close()

    def _connect(self, family: socket.AddressFamily, address: Address, now_ns: int) -> None:
        try:
            attempt = socket.socket(family, socket.SOCK_STREAM)
        except OSError as error:  # a host without IPv6
            self._failed(f"{self.endpoint}: {error}", now_ns)
            return
        attempt.setblocking(False)
        self._address = address
        self._connecting = (attempt, now_ns)
        result = attempt.connect_ex(self._address)
        if result not in (0, errno.EINPROGRESS):
            self._give_up(now_ns, result)

    def _look_if_connected(self, now_ns: int) -> None:
        assert self._connecting is not None, "called only while connecting"
        attempt, began_ns = self._connecting
        result = attempt.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if result:
            self._give_up(now_ns, result)
            return
        try:
            attempt.getpeername()
        except OSError:
            if now_ns - began_ns > CONNECT_TIMEOUT_NS:
                self._give_up(now_ns, errno.ETIMEDOUT)
            return
        self._connecting = None
        self._connection = Connection(attempt, self._address)
        self._backoff = self._backoff.opened(now_ns)
        log.info("mavlink: %s: connected", self.endpoint)

    def _give_up(self, now_ns: int, error_number: int) -> None:
        assert self._connecting is not None, "called only while connecting"
        self._connecting[0].close()
        self._connecting = None
        self._failed(f"{self.endpoint}: {errno.errorcode.get(error_number, error_number)}", now_ns)

    def _failed(self, why: str, now_ns: int) -> None:
        if self._backoff.failures == 0:
            log.warning("mavlink: %s; trying again", why)
        self._backoff = self._backoff.failed(now_ns)

    def _part_if_closed(self, now_ns: int) -> None:
        if self._connection is not None and not self._connection.open:
            log.warning("mavlink: %s: connection lost", self.endpoint)
            self._dropped += self._connection.dropped()
            self._connection = None
            self._backoff = self._backoff.failed(now_ns)


class TcpServer:
    """Accepts up to CALLERS_MAX connections, which must identify themselves. For one more, the oldest connection of the
    host that has most is closed, but never that of the accepted peer.

    Raises LinkError if the port cannot be opened.
    """

    finds_peers = True
    peer = None

    def __init__(self, endpoint: NetworkEndpoint) -> None:
        self.endpoint = endpoint.text
        self._callers: dict[Address, Connection] = {}
        self._heeded: Address | None = None
        self._accepts = True  # False until the next tick, if the process has no file descriptor left
        self._dropped = 0  # by connections that were closed
        family, address = resolve(endpoint, socket.SOCK_STREAM)[0]
        with opening(endpoint, family, socket.SOCK_STREAM) as self._socket:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind(address)
            self._socket.listen(CALLERS_MAX)

    @property
    def port(self) -> int:
        """The local port."""
        return local_port(self._socket)

    def filenos(self) -> Sequence[int]:
        # A caller that cannot be accepted stays pending: polled for, it would wake the link without end.
        listening = (self._socket.fileno(),) if self._accepts else ()
        return (*listening, *(caller.fileno() for caller in self._callers.values() if caller.open))

    def tick(self, now_ns: int) -> None:
        self._accepts = True
        for caller in self._callers.values():
            caller.flush()
        self._forget_closed()

    def receive(self) -> Received | None:
        self._forget_closed()  # first, so that one that sends without end does not prevent it
        self._accept()
        for caller in list(self._callers.values()):
            received = caller.receive()
            if received is not None:
                # Next time the others come first: one that sends without end must not block them.
                self._callers[caller.address] = self._callers.pop(caller.address)
                return received
        return None

    def send(self, data: bytes, peer: Address, *, yields: bool = False) -> bool:
        self._heeded = peer
        caller = self._callers.get(peer)
        return caller is not None and caller.send(data, yields=yields)

    def dropped(self) -> int:
        count, self._dropped = self._dropped, 0
        return count + sum(caller.dropped() for caller in self._callers.values())

    def reaches(self, peer: Address) -> bool:
        caller = self._callers.get(peer)
        return caller is not None and caller.open

    def close(self) -> None:
        for caller in self._callers.values():
            caller.close()
        self._socket.close()

    def _accept(self) -> None:
        try:
            connected, address = self._socket.accept()
        except OSError as error:  # no connection, or it is closed again
            self._accepts = error.errno not in (errno.EMFILE, errno.ENFILE)
            return
        if len(self._callers) >= CALLERS_MAX:
            self._callers.pop(self._spare()).close()
        self._callers[address] = Connection(connected, address)

    def _spare(self) -> Address:
        """The connection to close for a new one: a host that keeps connecting only displaces itself."""
        unheeded = [known for known in self._callers if known != self._heeded]
        calls = Counter(known[0] for known in unheeded)
        return max(unheeded, key=lambda known: calls[known[0]])

    def _forget_closed(self) -> None:
        self._dropped += sum(caller.dropped() for caller in self._callers.values() if not caller.open)
        self._callers = {address: caller for address, caller in self._callers.items() if caller.open}
