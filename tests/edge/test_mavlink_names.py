"""Endpoints whose hosts have names: known later than the daemon starts, moved later, never answered."""

from __future__ import annotations

import contextlib
import shlex
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from scipy.spatial.transform import Rotation

from .mavlink_peer import DEADLINE_S, Peer, Tcp, Udp, hear, linked, meet

FLYING = """
import logging, sys, threading
from edge.config import MavlinkSettings
from edge.links.mavlink_link import MavlinkLink
from edge.requests import RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from tests.edge.mavlink_peer import CAMERA
from tests.edge.reports import TRACKING

logging.basicConfig(level=logging.INFO, stream=sys.stdout, format="%(message)s")
link = MavlinkLink(MavlinkSettings(endpoints=[sys.argv[1]]), OwnShipBuffer(), CAMERA, RequestQueue())
link.start()
ended = threading.Event()
threading.Thread(target=lambda: (sys.stdin.read(), ended.set())).start()
while not ended.wait(0.05):
    link.set_health(TRACKING)
link.stop()
"""


@contextlib.contextmanager
def flying(endpoint: str, folder: Path) -> Iterator[tuple[Path, Any]]:
    """A link in a process that alone sees /etc/hosts as the file says, and no other name service."""
    inside = "mount --bind hosts /etc/hosts && mount --bind nsswitch /etc/nsswitch.conf"
    unshare = ["unshare", "--map-root-user", "--mount", "sh", "-c"]
    (folder / "hosts").write_text("")
    (folder / "nsswitch").write_text("hosts: files\n")
    if (
        shutil.which("unshare") is None
        or subprocess.run([*unshare, inside], cwd=folder, capture_output=True).returncode
    ):
        pytest.skip("this host does not let a user mount over /etc/hosts (unshare --map-root-user --mount)")
    root = Path(__file__).parents[2]
    command = f'{inside} && cd {shlex.quote(str(root))} && exec {shlex.quote(sys.executable)} -c "$1" {endpoint}'
    with subprocess.Popen(
        [*unshare, command, "sh", FLYING], cwd=folder, text=True, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        try:
            yield folder / "hosts", process.stdout
        finally:
            process.communicate(timeout=DEADLINE_S)


def says(lines: Any, text: str) -> None:
    assert any(text in line for line in iter(lines.readline, "")), f"never said: {text}"


def test_a_server_is_called_once_its_name_is_known_and_where_it_has_moved_to(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as first, socket.socket() as second:
        port = first.getsockname()[1]
        second.bind(("127.0.0.2", port))
        second.listen()
        with flying(f"tcpout:autopilot.test:{port}", tmp_path) as (hosts, said):
            says(said, "host 'autopilot.test' cannot be resolved")
            for host, server in (("127.0.0.1", first), ("127.0.0.2", second)):
                hosts.write_text(f"{host} autopilot.test\n")
                server.settimeout(DEADLINE_S)
                connected, _ = server.accept()
                with Peer(Tcp(connected)) as peer:
                    peer.named("TIMESYNC")


def test_of_several_addresses_of_a_server_the_one_that_answers_is_found(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.2", 0)) as server:
        port = server.getsockname()[1]
        with flying(f"tcpout:autopilot.test:{port}", tmp_path) as (hosts, _):
            hosts.write_text("127.0.0.1 autopilot.test\n127.0.0.2 autopilot.test\n")
            server.settimeout(DEADLINE_S)
            connected, _ = server.accept()
            with Peer(Tcp(connected)) as peer:
                peer.named("TIMESYNC")


def test_a_ground_station_is_told_once_its_name_is_known_and_where_it_has_moved_to(tmp_path: Path) -> None:
    first = Udp(0)
    with contextlib.closing(first), contextlib.closing(socket.socket(type=socket.SOCK_DGRAM)) as second:
        second.bind(("127.0.0.2", first.port))
        with flying(f"udpout:ground.test:{first.port}", tmp_path) as (hosts, said):
            says(said, "host 'ground.test' cannot be resolved")
            for host, heard in (("127.0.0.1", first.socket), ("127.0.0.2", second)):
                hosts.write_text(f"{host} ground.test\n")
                heard.settimeout(DEADLINE_S)
                assert heard.recv(300), "a heartbeat"


def test_name_service_that_never_answers_keeps_nothing_waiting(monkeypatch: pytest.MonkeyPatch) -> None:
    over, known = threading.Event(), socket.getaddrinfo

    def never(host: str, *arguments: Any, **named: Any) -> Any:
        if host == "ground.test" and not named.get("flags"):
            over.wait()
        return known(host, *arguments, **named)

    monkeypatch.setattr(socket, "getaddrinfo", never)
    try:
        with linked("tcpout:ground.test:5760", "udpout:ground.test:14550", "udpin:127.0.0.1:0") as (link, own_ship):
            with Peer(link.ports[0]) as peer:
                meet(link, peer)
                hear(own_ship, peer, Rotation.identity())
            asking = [thread.name for thread in threading.enumerate()].count("lookup")
        assert asking == 2, "each is asked once, not at every turn"
    finally:
        over.set()
