"""A radio on loopback: UDP (for QUIC) and TCP (for TLS) go through a `Channel` on their way to a router."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import threading
from collections.abc import Callable, Coroutine
from typing import Any

from sim_replay.faults.relay import Address
from sim_replay.ports import LOOPBACK
from sim_replay.radio.channel import SEGMENT_BYTES, Channel, Lane

_START_S = 10.0
_PIECES_WAITING = 8  # of a stream, so that the sender notices a slow line
_SOCKET_BYTES = 16384


class RadioRelay:
    """Connects one vehicle, which uses `port`, with a router at `upstream`; runs in its own thread.

    While it is cut, datagrams are lost and streams stall.
    """

    def __init__(self, upstream: Address, channel: Channel, kind: socket.SocketKind, seed: int = 0) -> None:
        self.port = 0
        self.bytes_up = 0  # payload that the vehicle sent by radio
        self._upstream = upstream
        self._channel = channel
        self._lanes = (Lane(channel, 2 * seed), Lane(channel, 2 * seed + 1))  # up, down
        self._loop = asyncio.new_event_loop()
        self._whole = asyncio.Event()
        self._whole.set()
        self._tasks: set[asyncio.Task[None]] = set()
        started = threading.Event()
        serve = self._serve_datagrams if kind == socket.SOCK_DGRAM else self._serve_streams
        self._thread = threading.Thread(target=self._run, args=(serve, started), name="radio", daemon=True)
        self._thread.start()
        started.wait(_START_S)

    def cut(self, cut: bool) -> None:
        """Begin or end an outage; from any thread."""
        self._loop.call_soon_threadsafe(self._whole.clear if cut else self._whole.set)

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()

    def __enter__(self) -> RadioRelay:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _run(self, serve: Callable[[], Any], started: threading.Event) -> None:
        asyncio.set_event_loop(self._loop)
        server = self._loop.run_until_complete(serve())
        started.set()
        self._loop.run_forever()
        server.close()
        for task in self._tasks:
            task.cancel()
        self._loop.run_until_complete(asyncio.gather(*self._tasks, return_exceptions=True))
        self._loop.run_until_complete(self._loop.shutdown_asyncgens())
        self._loop.close()

    async def _serve_datagrams(self) -> asyncio.DatagramTransport:
        vehicle: Address | None = None

        def up(data: bytes, sender: Address) -> None:
            nonlocal vehicle
            vehicle = sender
            self.bytes_up += len(data)
            self._carry(data, self._lanes[0], lambda: _send(back, data, self._upstream))

        def down(data: bytes, _: Address) -> None:
            self._carry(data, self._lanes[1], lambda: _send(front, data, vehicle))

        back, _ = await self._loop.create_datagram_endpoint(lambda: _End(down), local_addr=(LOOPBACK, 0))
        front, _ = await self._loop.create_datagram_endpoint(lambda: _End(up), local_addr=(LOOPBACK, 0))
        self.port = int(front.get_extra_info("sockname")[1])
        return front

    def _carry(self, data: bytes, lane: Lane, send: Callable[[], None]) -> None:
        if not self._whole.is_set():
            return
        due_s = lane.datagram(len(data), self._loop.time())
        if due_s is not None:
            self._loop.call_at(due_s, send)

    async def _serve_streams(self) -> asyncio.Server:
        server = await asyncio.start_server(self._accept, LOOPBACK, 0, limit=_SOCKET_BYTES)
        self.port = int(server.sockets[0].getsockname()[1])
        return server

    async def _accept(self, near_reader: asyncio.StreamReader, near: asyncio.StreamWriter) -> None:
        try:
            far_reader, far = await asyncio.open_connection(*self._upstream, limit=_SOCKET_BYTES)
        except OSError:
            near.close()
            return
        for end in (near, far):
            end.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _SOCKET_BYTES)
        self._begin(self._stream(near_reader, far, self._lanes[0]))
        self._begin(self._stream(far_reader, near, self._lanes[1]))

    def _begin(self, work: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _stream(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, lane: Lane) -> None:
        """One direction of a connection, until either end closes."""
        pieces: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(_PIECES_WAITING)
        reading = self._begin(self._read(reader, lane, pieces))
        with contextlib.suppress(OSError):
            while True:
                due_s, data = await pieces.get()
                await asyncio.sleep(due_s - self._loop.time())
                await self._whole.wait()
                if not data:
                    break
                writer.write(data)
                await writer.drain()
        reading.cancel()
        writer.close()

    async def _read(self, reader: asyncio.StreamReader, lane: Lane, pieces: asyncio.Queue[tuple[float, bytes]]) -> None:
        with contextlib.suppress(OSError):
            while data := await reader.read(SEGMENT_BYTES):
                if lane is self._lanes[0]:
                    self.bytes_up += len(data)
                await pieces.put((lane.segment(len(data), self._loop.time()), data))
        await pieces.put((self._loop.time(), b""))


def _send(end: asyncio.DatagramTransport, data: bytes, address: Address | None) -> None:
    """Data in flight when the relay closes is discarded."""
    if not end.is_closing():
        end.sendto(data, address)


class _End(asyncio.DatagramProtocol):
    """One socket of the relay."""

    def __init__(self, heard: Callable[[bytes, Address], None]) -> None:
        self._heard = heard

    def datagram_received(self, data: bytes, addr: Address) -> None:
        self._heard(data, addr)
