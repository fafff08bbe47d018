"""Links that can be cut, delayed and corrupted: a UDP relay for MAVLink and a TCP relay for zenoh, each on loopback."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import random
import socket
import struct
import threading
import time
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from sim_replay.ports import LOOPBACK

Address = tuple[str, int]
_LOOK_S = 0.2
_CHUNK_BYTES = 65536
_TAPE_DATAGRAMS = 4096
_MAVLINK_2 = 0xFD


@dataclass(frozen=True)
class LinkState:
    """Current state of a link."""

    cut: bool = False
    delay_s: float = 0.0
    corrupt: float = 0.0  # share of packets with one flipped bit
    drop_ids: frozenset[int] = frozenset()  # MAVLink messages that are dropped


class UdpRelay:
    """Connects an autopilot, which sends to `port`, with a daemon that listens at `daemon`.

    The daemon sees one address whichever process sends as the autopilot, as on a serial line. `tape` keeps what the
    autopilot sent.
    """

    def __init__(self, daemon: Address) -> None:
        self.state = LinkState()
        self.tape: deque[bytes] = deque(maxlen=_TAPE_DATAGRAMS)
        self._daemon = daemon
        self._autopilot: Address | None = None
        self._chance = random.Random(0)
        self._front = _bound(socket.SOCK_DGRAM)
        self._back = _bound(socket.SOCK_DGRAM)
        self._late: list[tuple[float, int, bool, bytes]] = []  # due, tie-break, to the daemon, data
        self._order = itertools.count()
        self._lock = threading.Lock()
        self._stopping = threading.Event()
        self._threads = [
            threading.Thread(target=self._pump, args=(to_daemon,), name=f"relay {to_daemon}", daemon=True)
            for to_daemon in (True, False)
        ]
        self._threads.append(threading.Thread(target=self._deliver_late, name="relay late", daemon=True))
        for thread in self._threads:
            thread.start()

    @property
    def port(self) -> int:
        return int(self._front.getsockname()[1])

    def inject(self, datagram: bytes) -> None:
        """Send to the daemon from the autopilot's address."""
        self._back.sendto(datagram, self._daemon)

    def close(self) -> None:
        self._stopping.set()
        for thread in self._threads:
            thread.join()
        self._front.close()
        self._back.close()

    def _pump(self, to_daemon: bool) -> None:
        source = self._front if to_daemon else self._back
        source.settimeout(_LOOK_S)
        while not self._stopping.is_set():
            try:
                data, sender = source.recvfrom(_CHUNK_BYTES)
            except TimeoutError:
                continue
            if to_daemon:
                self._autopilot = sender
            elif sender != self._daemon:
                continue
            self._pass_on(data, to_daemon)

    def _pass_on(self, data: bytes, to_daemon: bool) -> None:
        state = self.state
        if state.cut or message_id(data) in state.drop_ids:
            return
        if to_daemon:
            self.tape.append(data)
        if self._chance.random() < state.corrupt:
            data = flip_a_bit(data, self._chance)
        if state.delay_s > 0.0:
            with self._lock:
                heapq.heappush(self._late, (time.monotonic() + state.delay_s, next(self._order), to_daemon, data))
        else:
            self._send(data, to_daemon)

    def _send(self, data: bytes, to_daemon: bool) -> None:
        if to_daemon:
            self._back.sendto(data, self._daemon)
        elif self._autopilot is not None:
            self._front.sendto(data, self._autopilot)

    def _deliver_late(self) -> None:
        while not self._stopping.wait(0.002 if self._late else _LOOK_S / 4):
            with self._lock:
                due = []
                while self._late and self._late[0][0] <= time.monotonic():
                    due.append(heapq.heappop(self._late))
            for _, _, to_daemon, data in due:
                self._send(data, to_daemon)


class TcpRelay:
    """Connects clients of `port` with a server at `upstream`.

    A cut holds the bytes back, as a radio does: both ends see silence, not a closed connection.
    """

    def __init__(self, upstream: Address) -> None:
        self.state = LinkState()
        self._upstream = upstream
        self._chance = random.Random(0)
        self._stopping = threading.Event()
        self._server = _bound(socket.SOCK_STREAM)
        self._server.listen()
        self._server.settimeout(_LOOK_S)
        self._pumps: list[threading.Thread] = []
        self._acceptor = threading.Thread(target=self._accept, name="tcp relay", daemon=True)
        self._acceptor.start()

    @property
    def port(self) -> int:
        return int(self._server.getsockname()[1])

    def close(self) -> None:
        self._stopping.set()
        self._acceptor.join()
        for pump in self._pumps:
            pump.join()
        self._server.close()

    def _accept(self) -> None:
        while not self._stopping.is_set():
            try:
                near, _ = self._server.accept()
            except TimeoutError:
                continue
            try:
                far = socket.create_connection(self._upstream, timeout=_LOOK_S)
            except OSError:
                near.close()
                continue
            self._pumps = [pump for pump in self._pumps if pump.is_alive()]
            for source, sink in ((near, far), (far, near)):
                pump = threading.Thread(target=self._pump, args=(source, sink), name="tcp relay", daemon=True)
                self._pumps.append(pump)
                pump.start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        source.settimeout(_LOOK_S)
        with contextlib.suppress(OSError):
            while not self._stopping.is_set():
                try:
                    data = source.recv(_CHUNK_BYTES)
                except TimeoutError:
                    continue
                if not data:
                    break
                while self.state.cut and not self._stopping.wait(_LOOK_S / 10):
                    pass
                if self.state.delay_s:
                    self._stopping.wait(self.state.delay_s)
                if self._chance.random() < self.state.corrupt:
                    data = flip_a_bit(data, self._chance)
                self._send_all(sink, data)
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        source.close()

    def _send_all(self, sink: socket.socket, data: bytes) -> None:
        """Like sendall, but stops when the relay closes. Raises OSError."""
        while data and not self._stopping.is_set():
            with contextlib.suppress(TimeoutError):
                data = data[sink.send(data) :]


def message_id(datagram: bytes) -> int | None:
    """Of the first frame in a datagram, if that is MAVLink 2."""
    if len(datagram) < 10 or datagram[0] != _MAVLINK_2:
        return None
    return int(struct.unpack("<I", datagram[7:10] + b"\0")[0])


def flip_a_bit(data: bytes, chance: random.Random) -> bytes:
    spoiled = bytearray(data)
    spoiled[chance.randrange(len(spoiled))] ^= 1 << chance.randrange(8)
    return bytes(spoiled)


def udp_queue(port: int) -> tuple[int, int]:
    """Unread bytes at a local UDP port, as the kernel counts them, and datagrams dropped there so far."""
    for line in Path("/proc/net/udp").read_text(encoding="ascii").splitlines()[1:]:
        columns = line.split()
        if int(columns[1].rpartition(":")[2], 16) == port:
            return int(columns[4].rpartition(":")[2], 16), int(columns[-1])
    return 0, 0


def _bound(kind: socket.SocketKind) -> socket.socket:
    bound = socket.socket(socket.AF_INET, kind)
    bound.bind((LOOPBACK, 0))
    return bound
