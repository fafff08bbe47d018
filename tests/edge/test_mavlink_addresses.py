"""Hosts that have no address, several, or one of a kind that this computer does not have."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import re
import socket
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from typing import Any

import pytest
from scipy.spatial.transform import Rotation

from edge.config import MavlinkSettings
from edge.doctor_links import _mavlink
from edge.links.errors import LinkError
from edge.links.mavlink_endpoints import NetworkEndpoint
from edge.links.transports import open_transport
from edge.links.transports.tcp import TcpClient
from edge.links.transports.udp import SILENT_NS, UdpCaller
from msgs.mavlink import MAVLink, dialect
from tests.waiting import until

from .mavlink_peer import DEADLINE_S, Peer, Udp, hear, linked, meet

NO_HOSTS = ["192.168..10", f"{'a' * 64}.local"]  # of which Python asks no name service
NO_IPV6 = os.strerror(errno.EAFNOSUPPORT)


@pytest.fixture
def without_ipv6(monkeypatch: pytest.MonkeyPatch) -> None:
    class Socket(socket.socket):
        def __init__(self, family: int = socket.AF_INET, *arguments: Any, **named: Any) -> None:
            if family == socket.AF_INET6:
                raise OSError(errno.EAFNOSUPPORT, NO_IPV6)
            super().__init__(family, *arguments, **named)

    monkeypatch.setattr(socket, "socket", Socket)


@pytest.fixture
def name_service(monkeypatch: pytest.MonkeyPatch) -> dict[str, Callable[[], list[str]]]:
    """Names to be filled in, each with what tells its addresses."""
    names: dict[str, Callable[[], list[str]]] = {}
    known = socket.getaddrinfo

    def told(host: str, *arguments: Any, **named: Any) -> Any:
        if host not in names:
            return known(host, *arguments, **named)
        if named.get("flags"):
            raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")
        return [place for address in names[host]() for place in known(address, *arguments, **named)]

    monkeypatch.setattr(socket, "getaddrinfo", told)
    return names


@contextlib.contextmanager
def calling(host: str, port: int) -> Iterator[UdpCaller]:
    with contextlib.closing(UdpCaller(NetworkEndpoint("udpout", host, port, f"udpout:{host}:{port}"))) as caller:
        yield caller


@pytest.mark.parametrize("medium", ["udpin", "tcpin"])
@pytest.mark.parametrize("host", NO_HOSTS)
def test_a_host_of_ours_that_can_have_no_address_is_a_sentence(medium: str, host: str) -> None:
    endpoint = f"{medium}:{host}:5760"
    with pytest.raises(LinkError, match=re.escape(f"MAVLink endpoint {endpoint}: host '{host}' cannot be resolved: ")):
        open_transport(endpoint)


@pytest.mark.parametrize("host", NO_HOSTS)
def test_a_host_to_be_called_that_can_have_no_address_is_told_and_harms_no_other(
    host: str, caplog: pytest.LogCaptureFixture
) -> None:
    with linked(f"tcpout:{host}:5760", f"udpout:{host}:14550", "udpin:127.0.0.1:0") as (link, own_ship):
        with Peer(link.ports[0]) as peer:
            meet(link, peer)
            hear(own_ship, peer, Rotation.identity())
            for endpoint in (f"tcpout:{host}:5760", f"udpout:{host}:14550"):
                sentence = f"MAVLink endpoint {endpoint}: host '{host}' cannot be resolved: "
                peer.settle(lambda said=sentence: said in caplog.text, sentence)
        assert "failed" not in link.counters()


def test_a_server_is_called_once_its_name_can_be_one(
    name_service: dict[str, Callable[[], list[str]]], caplog: pytest.LogCaptureFixture
) -> None:
    answers: list[str] = []
    name_service["autopilot.test"] = lambda: answers or ["192.168..10"]
    with contextlib.closing(socket.create_server(("127.0.0.1", 0))) as server:
        server.settimeout(DEADLINE_S)
        port = server.getsockname()[1]
        client = TcpClient(NetworkEndpoint("tcpout", "autopilot.test", port, f"tcpout:autopilot.test:{port}"))
        with contextlib.closing(client):
            until(lambda: "cannot be resolved" in caplog.text, lambda: client.tick(time.monotonic_ns()), what="a word")
            answers.append("127.0.0.1")
            until(client.filenos, lambda: client.tick(time.monotonic_ns()), what="the connection")
            server.accept()[0].close()


@pytest.mark.parametrize("medium", ["udpin", "tcpin"])
@pytest.mark.usefixtures("without_ipv6")
def test_an_address_of_ours_is_a_sentence_where_there_is_no_ipv6(medium: str) -> None:
    endpoint = f"{medium}:[::]:0"
    with pytest.raises(LinkError, match=re.escape(f"MAVLink endpoint {endpoint} cannot be opened: {NO_IPV6}")):
        open_transport(endpoint)


@pytest.mark.usefixtures("without_ipv6")
def test_a_ground_station_is_called_by_ipv4_where_there_is_no_ipv6(
    name_service: dict[str, Callable[[], list[str]]], caplog: pytest.LogCaptureFixture
) -> None:
    name_service["ground.test"] = lambda: ["::1", "127.0.0.1"]
    with contextlib.closing(Udp(0)) as ground, calling("ground.test", ground.port) as caller:
        until(lambda: caller.peer, lambda: caller.tick(time.monotonic_ns()), what="an address")
        assert caller.peer == ("127.0.0.1", ground.port)
    assert not [record for record in caplog.records if record.levelno > logging.INFO], "nothing is amiss"
    with calling("::1", 14550) as caller:
        assert caller.peer is None
    assert f"MAVLink endpoint udpout:::1:14550 cannot be opened: {NO_IPV6}; trying again" in caplog.text


def test_an_address_that_nothing_can_be_sent_to_has_no_turn(
    name_service: dict[str, Callable[[], list[str]]], caplog: pytest.LogCaptureFixture
) -> None:
    """A broadcast, which needs a permission of its own, stands for one to which no way leads."""
    asked = list[int]()
    called = set[Any]()
    name_service["ground.test"] = lambda: asked.append(1) or ["255.255.255.255", "127.0.0.1"]
    with calling("ground.test", 14550) as caller:
        now_ns = count(time.monotonic_ns() + SILENT_NS, SILENT_NS)
        until(lambda: len(asked) > 4, lambda: (caller.tick(next(now_ns)), called.add(caller.peer)), what="four turns")
        assert called - {None} == {("127.0.0.1", 14550)}
    with calling("255.255.255.255", 14550) as alone:
        assert alone.peer is None
    assert "udpout:255.255.255.255:14550 cannot be opened: Permission denied; trying again" in caplog.text


def test_each_address_of_a_silent_ground_station_has_its_turn_until_one_is_heard(
    name_service: dict[str, Callable[[], list[str]]],
) -> None:
    addresses = ["127.0.0.1", "127.0.0.2", "127.0.0.3"]

    def in_another_order() -> list[str]:
        addresses.append(addresses.pop(0))
        return addresses

    name_service["ground.test"] = in_another_order
    with contextlib.closing(socket.socket(type=socket.SOCK_DGRAM)) as ground:
        ground.bind(("127.0.0.2", 0))
        ground.settimeout(DEADLINE_S)
        with calling("ground.test", ground.getsockname()[1]) as caller:
            now_ns = time.monotonic_ns()
            # Its first look may have been answered at once, or is answered a little later.
            until(lambda: caller.peer, lambda: caller.tick(now_ns), what="the first address")

            def next_called() -> str:
                """Whom it calls after a silence."""
                nonlocal now_ns
                before = caller.peer
                caller.tick(now_ns)
                assert caller.peer == before, "it waits for an answer until the silence is long enough"
                now_ns += SILENT_NS
                until(lambda: caller.peer != before, lambda: caller.tick(now_ns), what="the next address")
                assert caller.peer is not None
                return str(caller.peer[0])

            called = [next_called() for _ in range(7)]
            assert sorted(called[:3]) == sorted(addresses), "each has its turn"
            assert called[3:] == called[:4], "and then again"
            while called[-1] != "127.0.0.2":
                called.append(next_called())
            heard = caller.peer
            assert heard is not None
            for _ in range(20):
                assert caller.send(b"beat", heard)
                _, vehicle = ground.recvfrom(300)
                ground.sendto(b"answer", ("127.0.0.1", vehicle[1]))
                until(caller.receive, what="the answer")
                caller.tick(now_ns)
                now_ns += SILENT_NS - 1
                caller.tick(now_ns)
                assert caller.peer == heard, "who is heard stays"
            assert next_called() != "127.0.0.2"


def test_a_name_that_is_lost_again_is_told_again_and_once(
    name_service: dict[str, Callable[[], list[str]]], caplog: pytest.LogCaptureFixture
) -> None:
    asked, answers = list[int](), ["192.168..10"]
    name_service["ground.test"] = lambda: asked.append(1) or answers
    now_ns = count(time.monotonic_ns() + SILENT_NS, SILENT_NS)
    with calling("ground.test", 14550) as caller:
        for _ in range(2):
            answers[:], many = ["192.168..10"], len(asked) + 5
            until(lambda many=many: len(asked) > many, lambda: caller.tick(next(now_ns)), what="five turns")
            assert caplog.text.count("cannot be resolved") == 1
            answers[:], caller.peer = ["127.0.0.1"], None
            until(lambda: caller.peer, lambda: caller.tick(next(now_ns)), what="an address")
            caplog.clear()


def test_the_doctor_hears_an_autopilot_behind_a_router_that_sends_only_to_who_has_spoken() -> None:
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, 3, 0, 0, 4, 3).pack(MAVLink(None, 1, 1))
    with socket.socket(type=socket.SOCK_DGRAM) as router, ThreadPoolExecutor() as pool:
        router.bind(("127.0.0.1", 0))
        router.settimeout(DEADLINE_S)
        pool.submit(lambda: router.sendto(beat, router.recvfrom(300)[1]))
        (finding,) = _mavlink(MavlinkSettings(endpoints=[f"udpout:127.0.0.1:{router.getsockname()[1]}"]))
    assert finding.verdict == "good", finding.says
