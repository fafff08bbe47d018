"""An autopilot for the link's tests: pymavlink over a real socket, connection or pseudo-terminal."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from edge.config import MavlinkSettings
from edge.links.mavlink_link import MavlinkLink
from edge.links.mavlink_packing import Letter, Packer
from edge.links.signing import Signing
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import CameraInfo
from msgs.mavlink import FrameReader, MAVLink, dialect

from .reports import SIZE_WH, TRACKING, K

SYSTEM_ID = 42
CAMERA = CameraInfo("front", SIZE_WH, K, 30.0)
DEADLINE_S = 20.0


class Wire(Protocol):
    def send(self, data: bytes) -> None: ...

    def receive(self) -> bytes:
        """Waits a little; empty if nothing came."""

    def close(self) -> None: ...


class Udp:
    def __init__(self, port: int, host: str = "127.0.0.1") -> None:
        self.socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind((host, 0))
        self.socket.settimeout(0.02)
        self.address = (host, port)

    @property
    def port(self) -> int:
        return int(self.socket.getsockname()[1])

    def send(self, data: bytes) -> None:
        self.socket.sendto(data, self.address)

    def receive(self) -> bytes:
        with contextlib.suppress(TimeoutError):
            return self.socket.recvfrom(65536)[0]
        return b""

    def close(self) -> None:
        self.socket.close()


class Tcp:
    def __init__(self, connected: socket.socket) -> None:
        self.socket = connected
        connected.settimeout(0.02)

    def send(self, data: bytes) -> None:
        self.socket.sendall(data)

    def receive(self) -> bytes:
        with contextlib.suppress(TimeoutError, ConnectionError):
            return self.socket.recv(65536)
        return b""

    def close(self) -> None:
        self.socket.close()


class Pty:
    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor

    def send(self, data: bytes) -> None:
        os.write(self.descriptor, data)

    def receive(self) -> bytes:
        readable, _, _ = select.select([self.descriptor], [], [], 0.02)
        with contextlib.suppress(OSError):
            return os.read(self.descriptor, 65536) if readable else b""
        return b""

    def close(self) -> None:
        os.close(self.descriptor)


class Peer:
    """Its clock began `boot_at_ns` on the monotonic one. With `key` it signs all it sends."""

    def __init__(
        self,
        wire: Wire | int,
        system_id: int = SYSTEM_ID,
        autopilot: int = dialect.MAV_AUTOPILOT_ARDUPILOTMEGA,
        key: bytes | None = None,
    ) -> None:
        self.wire: Wire = Udp(wire) if isinstance(wire, int) else wire
        self.mav = MAVLink(None, srcSystem=system_id, srcComponent=1)
        if key is not None:
            self.mav.signing.secret_key = key
            self.mav.signing.sign_outgoing = True
            self.mav.signing.timestamp = round((time.time() - 1_420_070_400) * 1e5)
        self.autopilot = autopilot
        self.boot_at_ns = time.monotonic_ns() - 100_000_000_000
        self.received: list[Any] = []
        self.beat_at = 0.0
        self.accepts = True
        self._reader = FrameReader(datagram=isinstance(self.wire, Udp))

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self.wire.close()

    def boot_ms(self) -> int:
        return (time.monotonic_ns() - self.boot_at_ns) // 1_000_000

    def packed(self, message: Any) -> bytes:
        data = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        return data

    def send(self, message: Any) -> None:
        self.wire.send(self.packed(message))

    def heartbeat(self) -> None:
        self.send(dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, self.autopilot, 0, 0, 4, 3))

    def attitude(self, rotation: Rotation, boot_ms: int | None = None) -> None:
        q = np.roll(rotation.as_quat(), 1).tolist()
        stamp = self.boot_ms() if boot_ms is None else boot_ms
        self.send(dialect.MAVLink_attitude_quaternion_message(stamp, *q, 0.0, 0.0, 0.0))

    def command(self, command: int, *params: float, component: int = 100, system: int = SYSTEM_ID) -> None:
        filled = [*params, *[0.0] * (7 - len(params))]
        self.send(dialect.MAVLink_command_long_message(system, component, command, 0, *filled))

    def serve(self) -> list[Any]:
        """Beat once a second, answer what a real autopilot answers; returns what came."""
        if time.monotonic() - self.beat_at > 1.0:
            self.beat_at = time.monotonic()
            self.heartbeat()
        messages = self._reader.feed(self.wire.receive())
        for message in messages:
            self._answer(message)
        self.received += messages
        return messages

    def until(self, wanted: Callable[[Any], bool], what: str, each: Callable[[], None] = lambda: None) -> Any:
        """Serve until a message is `wanted`; `each` is called every turn."""
        deadline = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline:
            each()
            for message in self.serve():
                if wanted(message):
                    return message
        raise AssertionError(f"no {what} in {DEADLINE_S} s; came: {sorted({m.get_type() for m in self.received})}")

    def named(self, name: str, each: Callable[[], None] = lambda: None) -> Any:
        return self.until(lambda m: m.get_type() == name, name, each)

    def settle(self, condition: Callable[[], bool], what: str, each: Callable[[], None] = lambda: None) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"{what} did not happen in {DEADLINE_S} s"
            each()
            self.serve()

    def _answer(self, message: Any) -> None:
        if message.get_type() == "TIMESYNC" and message.tc1 == 0:
            self.send(dialect.MAVLink_timesync_message(time.monotonic_ns() - self.boot_at_ns, message.ts1))
        elif message.get_type() == "COMMAND_LONG":
            result = dialect.MAV_RESULT_ACCEPTED if self.accepts else dialect.MAV_RESULT_UNSUPPORTED
            asker = (message.get_srcSystem(), message.get_srcComponent())
            self.send(dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *asker))


@contextlib.contextmanager
def linked(
    *endpoints: str,
    own_ship: OwnShipBuffer | None = None,
    requests: RequestQueue | None = None,
    signing: Signing | None = None,
    **settings: Any,
) -> Iterator[tuple[MavlinkLink, OwnShipBuffer]]:
    """A running link on `endpoints`, by default one UDP port of the system's choice."""
    own_ship = own_ship or OwnShipBuffer()
    named = MavlinkSettings(endpoints=list(endpoints) or ["udpin:127.0.0.1:0"], **settings)
    link = MavlinkLink(named, own_ship, CAMERA, requests or RequestQueue(), signing)
    link.start()
    try:
        yield link, own_ship
    finally:
        link.stop()


def meet(link: MavlinkLink, peer: Peer) -> None:
    """Until the link knows the autopilot and has taken its time."""
    link.set_health(TRACKING)
    peer.settle(lambda: "timesync_uncertainty_us" in link.counters(), "time synchronisation")


def hear(own_ship: OwnShipBuffer, peer: Peer, rotation: Rotation) -> None:
    """Until own attitude is that which the peer tells, again and again: one alone holds for a fraction of a second."""

    def heard() -> bool:
        now = own_ship.at(time.monotonic_ns())
        return now is not None and np.allclose(now.R_ned_body, rotation.as_matrix(), atol=1e-6)

    peer.settle(heard, "attitude", lambda: peer.attitude(rotation))


def on_the_wire(letters: Iterable[Letter], packer: Packer | None = None) -> list[Any]:
    """Messages as who is at the other end of an endpoint reads them."""
    packer = packer or Packer(0, None)
    reader = FrameReader(datagram=True)
    return [message for letter in letters for message in reader.feed(packer.packed(letter))]


def alone(wire: Udp) -> bool:
    """Whether nothing was sent here."""
    wire.socket.settimeout(0.0)
    try:
        return not wire.socket.recv(1)
    except BlockingIOError:
        return True
