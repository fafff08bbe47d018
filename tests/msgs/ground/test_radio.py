"""A vehicle that speaks to the ground over a bad radio: QUIC through a relay that loses datagrams."""

from __future__ import annotations

import random
import select
import socket
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import zenoh

from msgs.ground.router import load_router, open_router
from msgs.session import OPEN_TIMEOUT_MS, TlsFiles, peer_config
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .conftest import write_router_config
from .test_watch import Vehicle, ground


class Relay(threading.Thread):
    """Passes datagrams between a vehicle and the ground, but those that it `loses`."""

    def __init__(self, to_port: int, loses: Callable[[], bool]) -> None:
        super().__init__(daemon=True)
        self.listening, self.asking = (socket.socket(type=socket.SOCK_DGRAM) for _ in range(2))
        self.listening.bind(("127.0.0.1", 0))
        self.asking.connect(("127.0.0.1", to_port))
        self.port = self.listening.getsockname()[1]
        self.loses = loses
        self.lost = 0
        self.callers: list[tuple[str, int]] = []  # each attempt to connect has a port of its own
        self.done = threading.Event()

    def run(self) -> None:
        while not self.done.is_set():
            for ready in select.select([self.listening, self.asking], [], [], 0.1)[0]:
                with suppress(ConnectionRefusedError):  # the other end is gone, and so is what was for it
                    self._pass_on(ready)
        self.listening.close()
        self.asking.close()

    def _pass_on(self, ready: socket.socket) -> None:
        data, sender = ready.recvfrom(65536)
        if ready is self.listening and sender not in self.callers:
            self.callers.append(sender)
        if self.loses():
            self.lost += 1
        elif ready is self.listening:
            self.asking.send(data)
        else:
            self.listening.sendto(data, self.callers[-1])


class Radio:
    """uav1 and the ground's router, and the relay between them."""

    def __init__(self, stack: ExitStack, folder: Path, keys: dict[str, TlsFiles], loses: Callable[[], bool]) -> None:
        secure, self.loopback = free_endpoint().replace("tcp/", "quic/"), free_endpoint()
        access = 'vehicles = ["uav1"]\nloopback_reads = true\n'
        path = write_router_config(folder, [secure, self.loopback], keys["ground"], access)
        self.relay = Relay(int(secure.partition("?")[0].rpartition(":")[2]), loses)
        self.relay.start()
        stack.callback(self.relay.done.set)
        stack.enter_context(open_router(load_router(path), folder))
        far = f"quic/127.0.0.1:{self.relay.port}"
        self.session = stack.enter_context(zenoh.open(peer_config([], [far], tls=keys["uav1"])))


def test_over_a_radio_that_loses_a_fifth_poses_come_in_order_and_fresh(
    tmp_path: Path, keys: dict[str, TlsFiles]
) -> None:
    chance = random.Random(7)
    with ExitStack() as stack:
        radio = Radio(stack, tmp_path, keys, lambda: chance.random() < 0.2)
        uav1 = Vehicle(radio.session, "uav1", stack)
        _, lines = stack.enter_context(ground("watch", "--json", "-e", radio.loopback))
        until(lambda: len(lines.objects("pose")) >= 60, uav1.tell)
        poses = lines.objects("pose")
    stamps = [one["stamp_ns"] for one in poses]
    assert stamps == sorted(stamps)  # type: ignore[type-var]
    assert all(one["age_s"] < 2.0 for one in poses)  # type: ignore[operator]
    assert radio.relay.lost > 10


def test_a_call_that_begins_in_a_radio_shadow_is_the_one_that_comes_through(
    tmp_path: Path, keys: dict[str, TlsFiles]
) -> None:
    """The router hears the call's first datagram, the vehicle no answer. Who gave up now and called again would find
    the router waiting for the first call, for half a minute, as the farewell would be lost too."""
    first_heard_s: list[float] = []

    def loses() -> bool:
        now_s = time.monotonic()
        if not first_heard_s:
            first_heard_s.append(now_s)
            return False
        return now_s - first_heard_s[0] < OPEN_TIMEOUT_MS / 1000 + 0.5

    with ExitStack() as stack:
        radio = Radio(stack, tmp_path, keys, loses)
        until(lambda: list(radio.session.info.routers_zid()), what="the router")
        assert radio.relay.lost > 0
        assert len(radio.relay.callers) == 1
