"""The link over each medium, against real sockets, connections and pseudo-terminals."""

from __future__ import annotations

import contextlib
import os
import pty
import resource
import select
import socket
import struct
import time
import tty
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edge import clock
from edge.config import MavlinkSettings
from edge.links.errors import LinkError
from edge.links.mavlink_endpoints import NetworkEndpoint, SerialEndpoint, parse_endpoint
from edge.links.mavlink_link import MavlinkLink
from edge.links.transports.backoff import FIRST_WAIT_NS, LONGEST_WAIT_NS, STEADY_NS, Backoff
from edge.links.transports.medium import PENDING_MAX
from edge.links.transports.tcp import CALLERS_MAX, TcpClient, TcpServer
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from msgs.mavlink import FrameReader, MAVLink, dialect
from tests.waiting import until

from .mavlink_peer import CAMERA, DEADLINE_S, Peer, Pty, Tcp, Udp, alone, hear, linked, meet
from .reports import SEARCHING, TRACKING
from .reports import make_report as report
from .reports import make_track as track


def exchanges(link: MavlinkLink, own_ship: OwnShipBuffer, peer: Peer) -> None:
    """Attitude comes in and a pose goes out."""
    meet(link, peer)
    hear(own_ship, peer, Rotation.identity())
    peer.named("TARGET_RELATIVE", lambda: link.publish(report(track(time.monotonic_ns()))))


def listening(host: str = "127.0.0.1", port: int = 0) -> socket.socket:
    server = socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)
    server.settimeout(DEADLINE_S)
    return server


def test_udpin_over_ipv6() -> None:
    with linked("udpin:[::1]:0") as (link, own_ship), Peer(Udp(link.ports[0], "::1")) as peer:
        exchanges(link, own_ship, peer)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_udpout_makes_itself_known_first(host: str) -> None:
    wire = Udp(0, host)
    named = f"[{host}]" if ":" in host else host
    with linked(f"udpout:{named}:{wire.port}") as (link, own_ship), Peer(wire) as peer:
        wire.address = (host, link.ports[0])
        link.set_health(SEARCHING)
        wire.socket.settimeout(DEADLINE_S)
        assert wire.socket.recv(300), "nobody has spoken to the link yet"
        wire.socket.settimeout(0.02)
        exchanges(link, own_ship, peer)


@pytest.mark.parametrize("host", ["127.0.0.1", "[::1]"])
def test_a_tcp_server_heeds_the_caller_that_is_an_autopilot(host: str) -> None:
    with linked(f"tcpin:{host}:0") as (link, own_ship):
        address = (host.strip("[]"), link.ports[0])
        callers = [Tcp(socket.create_connection(address)) for _ in range(2)]
        with Peer(callers[0]) as caller, Peer(callers[1]) as peer:
            caller.attitude(Rotation.identity())
            exchanges(link, own_ship, peer)
            assert caller.wire.receive() == b""
            # Which of the two depends on who was read first.
            refused = ("refused_stranger", "refused_address")
            until(lambda: any(link.counters().get(name) for name in refused), what="the caller refused")


def test_idle_callers_do_not_keep_an_autopilot_out() -> None:
    with linked("tcpin:127.0.0.1:0") as (link, own_ship):
        address = ("127.0.0.1", link.ports[0])
        idle = [socket.create_connection(address) for _ in range(CALLERS_MAX + 2)]
        with Peer(Tcp(socket.create_connection(address))) as peer:
            exchanges(link, own_ship, peer)
        for caller in idle:
            caller.close()


def test_a_host_that_calls_and_calls_does_not_displace_an_autopilot_that_has_not_spoken_yet() -> None:
    with linked("tcpin:127.0.0.1:0") as (link, own_ship), contextlib.ExitStack() as calling:
        address = ("127.0.0.1", link.ports[0])
        with Peer(Tcp(socket.create_connection(address, source_address=("127.0.0.2", 0)))) as peer:
            for _ in range(3 * CALLERS_MAX):
                caller = calling.enter_context(socket.create_connection(address))
                caller.sendall(b"hello")
            # More than there is room for were taken.
            until(lambda: link.counters().get("refused_stranger", 0) > CALLERS_MAX, what="callers")
            exchanges(link, own_ship, peer)


def test_a_tcp_client_starts_before_its_server_and_comes_back_after_it() -> None:
    with listening() as reserved:
        port = reserved.getsockname()[1]
    with linked(f"tcpout:127.0.0.1:{port}") as (link, own_ship):
        link.set_health(TRACKING)
        for _ in range(2):
            with listening(port=port) as server:
                connected, _ = server.accept()
                with Peer(Tcp(connected)) as peer:
                    exchanges(link, own_ship, peer)


def test_frames_cut_anywhere_by_a_stream_are_put_together() -> None:
    with linked("tcpin:127.0.0.1:0") as (link, own_ship):
        wire = Tcp(socket.create_connection(("127.0.0.1", link.ports[0])))
        wire.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with Peer(wire) as peer:
            meet(link, peer)
            measured_ns = time.monotonic_ns()
            attitude = dialect.MAVLink_attitude_quaternion_message(peer.boot_ms(), 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            # A header that promises 255 bytes and brings none stands before it.
            for byte in b"\xfd\xff\x00\x00" + peer.packed(attitude) + peer.packed(attitude) * 12:
                wire.send(bytes([byte]))
            peer.settle(lambda: own_ship.at(measured_ns + 2_000_000) is not None, "attitude")


def pseudo_terminal(link_at: Path) -> Pty:
    """One end of a serial line; the other is at `link_at`."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    link_at.unlink(missing_ok=True)
    link_at.symlink_to(os.ttyname(theirs))
    os.close(theirs)
    return Pty(ours)


def test_a_serial_port_may_be_absent_at_first_and_pulled_out_later(tmp_path: Path) -> None:
    device = tmp_path / "tty of the autopilot: USB"
    with linked(f"serial:{device}:57600") as (link, own_ship):
        link.set_health(TRACKING)
        for _ in range(2):
            with Peer(pseudo_terminal(device)) as peer:
                exchanges(link, own_ship, peer)


def test_a_serial_line_that_nobody_reads_loses_whole_messages_and_blocks_nothing(tmp_path: Path) -> None:
    device = tmp_path / "ttyAutopilot"
    with (
        linked(f"serial:{device}:57600", "udpin:127.0.0.1:0") as (link, _),
        Peer(pseudo_terminal(device)) as reader,
        Peer(link.ports[0]) as peer,
    ):
        meet(link, peer)
        text = "x" * 5000

        def tell() -> None:
            link.event(4, text)

        peer.settle(lambda: link.counters().get("send_failed", 0) > 0, "loss on the line", tell)
        frames = FrameReader(datagram=False)
        got, read = [], 0
        while read < PENDING_MAX // 2:
            data = reader.wire.receive()
            read += len(data)
            got += frames.feed(data)
        assert got, "what came was whole"
        assert frames.bad_runs == 0


def test_all_endpoints_are_told_and_the_autopilot_is_asked_on_one_alone() -> None:
    with linked("udpin:127.0.0.1:0", "tcpin:127.0.0.1:0") as (link, own_ship):
        udp, tcp = link.ports
        with Peer(udp) as peer, Peer(Tcp(socket.create_connection(("127.0.0.1", tcp)))) as second:
            meet(link, peer)
            turned = Rotation.from_euler("x", 1.0)

            def both() -> None:
                second.attitude(turned)
                second.serve()
                link.publish(report(track(time.monotonic_ns())))

            peer.named("TARGET_RELATIVE", both)
            second.named("TARGET_RELATIVE", both)
            peer.settle(lambda: link.counters().get("refused_other_link", 0) > 0, "refusal of the second", both)
            assert not {"TIMESYNC", "COMMAND_LONG"} & {m.get_type() for m in second.received}
            assert own_ship.at(time.monotonic_ns()) is None
            # The first falls silent: the second is asked, and believed, from then on.
            second.named("COMMAND_LONG")
            hear(own_ship, second, turned)


def test_a_stranger_on_one_endpoint_is_not_told_what_goes_to_the_other() -> None:
    with linked("udpin:127.0.0.1:0", "udpin:127.0.0.1:0") as (link, _):
        first, second = link.ports
        with Peer(first) as peer, Peer(second) as stranger:
            stranger.send(dialect.MAVLink_timesync_message(0, 1))
            meet(link, peer)
            link.publish(report(track(time.monotonic_ns())))
            peer.named("TARGET_RELATIVE")
            assert isinstance(stranger.wire, Udp)
            assert alone(stranger.wire)


@pytest.mark.parametrize("medium", ["udpin", "tcpin"])
def test_a_port_that_is_taken_is_a_sentence(medium: str) -> None:
    kind = socket.SOCK_DGRAM if medium == "udpin" else socket.SOCK_STREAM
    with socket.socket(socket.AF_INET, kind) as taken:
        taken.bind(("127.0.0.1", 0))
        if medium == "tcpin":
            taken.listen()
        endpoint = f"{medium}:127.0.0.1:{taken.getsockname()[1]}"
        link = MavlinkLink(MavlinkSettings(endpoints=[endpoint]), OwnShipBuffer(), CAMERA, RequestQueue())
        with pytest.raises(LinkError, match=f"MAVLink endpoint {endpoint} cannot be opened: {os.strerror(98)}"):
            link.start()
        link.stop()


def test_a_host_of_ours_without_an_address_is_a_sentence() -> None:
    with pytest.raises(LinkError, match=r"host 'autopilot\.invalid' cannot be resolved"):
        TcpServer(NetworkEndpoint("tcpin", "autopilot.invalid", 5760, "tcpin:autopilot.invalid:5760"))


def test_endpoints_are_read_or_refused_whole() -> None:
    assert parse_endpoint("serial:/dev/ttyAMA0:921600") == SerialEndpoint(
        "/dev/ttyAMA0", 921_600, "serial:/dev/ttyAMA0:921600"
    )
    assert parse_endpoint("tcpout:[fe80::1%eth0]:5760") == NetworkEndpoint(
        "tcpout", "fe80::1%eth0", 5760, "tcpout:[fe80::1%eth0]:5760"
    )
    serial = ("serial:ttyS0:9600", "serial: /dev/ttyS0:9600", "serial:/dev/ttyS0:0", "serial:/dev/tty\nS0:9600")
    for wrong in ("udp:1.2.3.4:5", "udpin:1.2.3.4:70000", "tcpin:::1:5", "", *serial):
        with pytest.raises(ValueError, match="is not udpin:HOST:PORT"):
            parse_endpoint(wrong)


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 20_000_000_000)), max_size=40))
def test_waits_grow_to_a_bound_and_begin_anew_after_a_connection_that_lasted(events: list[tuple[bool, int]]) -> None:
    backoff, now_ns, wait_ns = Backoff(), 0, 0
    for opens, lasted_ns in events:
        now_ns = max(now_ns, backoff.retry_at_ns)
        assert backoff.due(now_ns)
        assert not opens or not backoff.opened(now_ns).due(now_ns + 10**12), "nothing is opened twice"
        if opens:
            backoff, now_ns = backoff.opened(now_ns), now_ns + lasted_ns
        backoff = backoff.failed(now_ns)
        afresh = wait_ns == 0 or (opens and lasted_ns >= STEADY_NS)
        wait_ns = FIRST_WAIT_NS if afresh else min(2 * wait_ns, LONGEST_WAIT_NS)
        assert backoff.retry_at_ns - now_ns == wait_ns


def test_an_idle_link_sleeps(tmp_path: Path) -> None:
    """A hung-up line or a closed peer must not make the thread spin."""
    device = tmp_path / "ttyAutopilot"
    with linked(f"serial:{device}:57600", "tcpin:127.0.0.1:0") as (link, _):
        link.set_health(TRACKING)
        with Peer(pseudo_terminal(device)) as peer:
            meet(link, peer)
        socket.create_connection(("127.0.0.1", link.ports[0])).close()
        used_s, began = time.process_time(), time.monotonic()
        select.select([], [], [], 1.0)
        assert time.process_time() - used_s < 0.5 * (time.monotonic() - began)


def test_a_caller_that_floods_does_not_keep_poses_from_the_autopilot() -> None:
    with linked("tcpin:127.0.0.1:0") as (link, own_ship):
        address = ("127.0.0.1", link.ports[0])
        flooder = socket.create_connection(address)
        flooder.setblocking(False)
        beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_GCS, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
        flood = beat.pack(MAVLink(None, 255, 190)) * 3000
        with Peer(Tcp(socket.create_connection(address))) as peer:

            def flood_on() -> None:
                with contextlib.suppress(BlockingIOError):
                    flooder.send(flood)

            flood_on()
            exchanges(link, own_ship, peer)
            for _ in range(5):
                flood_on()
                peer.named("TARGET_RELATIVE", lambda: link.publish(report(track(time.monotonic_ns()))))
        flooder.close()


def test_callers_that_leave_beside_one_that_floods_do_not_end_the_link() -> None:
    server = TcpServer(NetworkEndpoint("tcpin", "127.0.0.1", 0, "tcpin:127.0.0.1:0"))
    with contextlib.closing(server), contextlib.ExitStack() as calling:
        leaving, flooder = (
            calling.enter_context(socket.create_connection(("127.0.0.1", server.port))) for _ in range(2)
        )
        flooder.setblocking(False)
        until(lambda: len(server.filenos()) == 3, server.receive, what="both callers")
        leaving.close()

        def flood() -> None:
            with contextlib.suppress(BlockingIOError):
                flooder.send(bytes(100_000))
            server.receive()
            assert -1 not in server.filenos(), "poll takes no closed socket"

        until(lambda: len(server.filenos()) == 2, flood, what="the end of one")


def test_a_caller_for_whom_no_descriptor_is_left_wakes_nobody_until_the_next_tick() -> None:
    server = TcpServer(NetworkEndpoint("tcpin", "127.0.0.1", 0, "tcpin:127.0.0.1:0"))

    def readable() -> bool:
        poll = select.poll()
        for fileno in server.filenos():
            poll.register(fileno, select.POLLIN)
        return bool(poll.poll(0))

    with contextlib.closing(server), socket.create_connection(("127.0.0.1", server.port)):
        until(readable, what="the caller")
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (0, hard))
        try:
            assert server.receive() is None
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        assert not readable()
        server.tick(0)
        assert readable(), "it is tried again"
        server.receive()
        assert len(server.filenos()) == 2, "it is accepted"


def test_a_connection_that_ends_while_it_is_written_to_does_not_end_the_link() -> None:
    with contextlib.closing(listening()) as server:
        port = server.getsockname()[1]
        client = TcpClient(NetworkEndpoint("tcpout", "127.0.0.1", port, f"tcpout:127.0.0.1:{port}"))
        with contextlib.closing(client):
            until(client.filenos, lambda: client.tick(time.monotonic_ns()), what="the connection")
            accepted, _ = server.accept()
            accepted.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            accepted.close()  # a reset, not an end
            until(lambda: not client.filenos(), lambda: client.send(b"pose", ()), what="the reset")
            assert client.filenos() == ()


def test_in_lock_step_a_lost_server_is_called_again_by_the_stepped_time() -> None:
    with contextlib.closing(listening()) as server, contextlib.ExitStack() as stepping:
        stepping.callback(clock.run_freely)
        clock.step_to(1)  # long before the time of the host
        port = server.getsockname()[1]
        client = stepping.enter_context(
            contextlib.closing(TcpClient(NetworkEndpoint("tcpout", "127.0.0.1", port, f"tcpout:127.0.0.1:{port}")))
        )
        until(client.filenos, lambda: client.tick(clock.monotonic_ns()), what="the connection")
        server.accept()[0].close()
        until(lambda: not client.filenos(), client.receive, what="its end")
        clock.step_to(1 + FIRST_WAIT_NS)
        until(client.filenos, lambda: client.tick(clock.monotonic_ns()), what="the connection again")


def test_an_endpoint_that_fails_silences_neither_the_others_nor_the_heartbeat(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with linked("tcpin:127.0.0.1:0", "udpin:127.0.0.1:0") as (link, own_ship):
        monkeypatch.setattr(TcpServer, "receive", lambda _: 1 // 0)
        monkeypatch.setattr(TcpServer, "tick", lambda *_: 1 // 0)
        with Peer(Udp(link.ports[1])) as peer:
            exchanges(link, own_ship, peer)
        until(lambda: link.counters().get("failed", 0) > 0, what="the failure to be counted")
        monkeypatch.undo()
        with Peer(Tcp(socket.create_connection(("127.0.0.1", link.ports[0])))) as peer:
            peer.named("HEARTBEAT", lambda: link.set_health(SEARCHING))
