"""What the session settings let in: nothing unasked for, and over TLS only who holds a certificate."""

from __future__ import annotations

import os
import socket
import subprocess
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
import zenoh

from msgs import client, session, topics
from msgs.publish import Node
from sim_replay.ports import free_endpoint, free_port
from tests.waiting import until

from .conftest import pose_now


def sockets() -> set[str]:
    """TCP sockets that listen, and UDP sockets, of this process: `tcp <port>`, `udp <port>`."""
    inodes = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        try:
            inodes.add(os.readlink(descriptor))
        except FileNotFoundError:
            continue
    found = set()
    for protocol in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path("/proc/self/net", protocol).read_text().splitlines()[1:]:
            columns = line.split()
            if f"socket:[{columns[9]}]" in inodes and (protocol.startswith("udp") or columns[3] == "0A"):
                found.add(f"{protocol[:3]} {int(columns[1].split(':')[1], 16)}")
    return found


def test_nothing_listens_that_was_not_asked_for() -> None:
    before = sockets()
    endpoint = free_endpoint()
    with zenoh.open(session.peer_config([], [])):
        assert sockets() == before
    with zenoh.open(session.router_config([endpoint])), client.connect(endpoint):
        assert sockets() - before == {f"tcp {endpoint.rpartition(':')[2]}"}


@pytest.mark.parametrize("endpoint", ["nonsense", "tcp/", "carrier-pigeon/127.0.0.1:1"])
def test_an_endpoint_that_is_none_is_a_connection_error(endpoint: str) -> None:
    with pytest.raises(ConnectionError, match=endpoint):
        client.connect(endpoint)


def test_certificates_that_cannot_be_read_are_told_and_not_that_nobody_answers(tmp_path: Path) -> None:
    tls = session.TlsFiles(*(tmp_path / name for name in ("ca.pem", "alice.pem", "alice.key")))
    with pytest.raises(ConnectionError, match=r"ca\.pem cannot be read: No such file or directory$"):
        client.connect(free_endpoint().replace("tcp/", "quic/"), tls=tls)


def _openssl(*arguments: str) -> None:
    subprocess.run(["openssl", *arguments], check=True, capture_output=True)


def _authority(folder: Path) -> tuple[Path, Path]:
    certificate, key = folder / "ca.pem", folder / "ca.key"
    new_key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-noenc", "-keyout", str(key)]
    _openssl("req", "-x509", *new_key, "-subj", "/CN=test ca", "-days", "2", "-out", str(certificate))
    return certificate, key


def _identity(folder: Path, name: str, authority: tuple[Path, Path]) -> session.TlsFiles:
    certificate, key, request = (folder / f"{name}.{suffix}" for suffix in ("pem", "key", "csr"))
    new_key = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-noenc", "-keyout", str(key)]
    _openssl("req", *new_key, "-subj", f"/CN={name}", "-out", str(request))
    extensions = folder / f"{name}.ext"
    extensions.write_text("subjectAltName=DNS:localhost,IP:127.0.0.1,IP:::1\nextendedKeyUsage=serverAuth,clientAuth\n")
    signing = ["-CA", str(authority[0]), "-CAkey", str(authority[1]), "-days", "2", "-extfile", str(extensions)]
    _openssl("x509", "-req", "-in", str(request), *signing, "-out", str(certificate))
    return session.TlsFiles(authority[0], certificate, key)


@pytest.fixture
def identities(tmp_path: Path) -> Sequence[session.TlsFiles]:
    """Ground and UAV of one authority, and a stranger of another."""
    folders = [tmp_path / name for name in ("ours", "theirs")]
    for folder in folders:
        folder.mkdir()
    ours, theirs = map(_authority, folders)
    stranger = _identity(folders[1], "stranger", theirs)
    trusting = session.TlsFiles(ours[0], stranger.certificate, stranger.private_key)
    return _identity(folders[0], "ground", ours), _identity(folders[0], "uav1", ours), trusting


@pytest.mark.parametrize(
    ("protocol", "topic", "rate_max_hz"),
    [
        ("tls", topics.POSE, 5.0 * session.CAP_SLACK),
        ("quic", topics.POSE, 5.0 * session.CAP_SLACK),
        ("tls", topics.ODOM, 5.0 * session.CAP_SLACK),
        ("quic", topics.DIRECTION, 5.0 * session.CAP_SLACK),
        ("tls", topics.TF, 5.0),
        ("tls", topics.DETECTIONS, 2.0),
        ("quic", topics.IMAGE, 0.0),
        ("tls", topics.IMAGE, 0.0),
    ],
    ids=lambda value: value.name.replace("/", "-") if isinstance(value, topics.Topic) else str(value),
)
def test_only_who_holds_our_certificate_gets_in_and_what_is_sent_there_is_thinned(
    identities: Sequence[session.TlsFiles], protocol: str, topic: topics.Topic, rate_max_hz: float
) -> None:
    """With poses capped at 5 Hz. Pictures stay on board."""
    ground, uav, stranger = identities
    secure = free_endpoint().replace("tcp/", f"{protocol}/")
    plain = free_endpoint()
    linked, received = Counter[str](), Counter[str]()
    with ExitStack() as stack:
        router = stack.enter_context(zenoh.open(session.router_config([secure], tls=ground)))
        with pytest.raises(ConnectionError, match=r"certificate: .*stranger\.pem is refused by whoever trusts"):
            client.connect(secure, tls=stranger)
        config = session.peer_config([plain], [secure], tls=uav, pose_rate_max_hz=5.0)
        daemon = stack.enter_context(zenoh.open(config))
        on_board = stack.enter_context(client.connect(plain))
        for name, place in (("ground", router), ("on board", on_board)):
            for asked, counter in ((topic, received), (topics.EVENTS, linked)):
                handler = zenoh.handlers.Callback(lambda _, n=name, c=counter: c.update([n]), indirect=False)
                place.declare_subscriber(topics.subscription_key(asked, "uav1"), handler)
        node = stack.enter_context(Node(daemon, "uav1"))
        publisher, events = node.publisher(topic, "t0" if topic.per_target else None), node.publisher(topics.EVENTS)
        until(lambda: len(linked) == 2, lambda: events.put(b"an event"))
        until(lambda: received["on board"] > received["ground"], lambda: publisher.put(pose_now().encode()))
        received.clear()
        started = time.monotonic()
        until(lambda: received["on board"] >= 60, lambda: publisher.put(pose_now().encode()))
        elapsed_s = time.monotonic() - started
        # One for the period that had begun, one that was on its way when counting started.
        assert received["ground"] <= (rate_max_hz * elapsed_s + 2 if rate_max_hz else 0)


@contextmanager
def capped(identities: Sequence[session.TlsFiles], rate_max_hz: float) -> Iterator[tuple[Node, Counter[str]]]:
    """uav1 linked by tls with its poses capped, and how many of each target came to the ground."""
    ground, uav, _ = identities
    secure, came = free_endpoint().replace("tcp/", "tls/"), Counter[str]()
    config = session.peer_config([], [secure], tls=uav, pose_rate_max_hz=rate_max_hz)
    with (
        zenoh.open(session.router_config([secure], tls=ground)) as router,
        zenoh.open(config) as daemon,
        Node(daemon, "uav1") as node,
    ):
        handler = zenoh.handlers.Callback(lambda one: came.update([str(one.key_expr).split("/")[3]]), indirect=False)
        router.declare_subscriber(topics.subscription_key(topics.POSE, "uav1"), handler)
        yield node, came


def test_each_target_of_a_frame_has_the_whole_rate_to_itself(identities: Sequence[session.TlsFiles]) -> None:
    names = [f"t{number}" for number in range(topics.TARGETS_MAX)]
    with capped(identities, 20.0) as (node, came):
        publishers = [node.publisher(topics.POSE, name) for name in names]

        def tell() -> None:
            for publisher in publishers:
                publisher.put(pose_now().encode())

        until(lambda: all(came[name] >= 5 for name in names), tell, what="every target")


def test_a_vehicle_has_no_more_targets_than_are_capped() -> None:
    from edge.config import EstimatorSettings

    (most,) = (one.le for one in EstimatorSettings.model_fields["max_targets"].metadata if hasattr(one, "le"))
    assert most == topics.TARGETS_MAX


def test_a_camera_of_just_the_capped_rate_loses_no_frames_for_coming_a_little_early(
    identities: Sequence[session.TlsFiles],
) -> None:
    rate_hz, frames = 10.0, 20
    with capped(identities, rate_hz) as (node, came):
        publisher = node.publisher(topics.POSE, "t0")
        until(lambda: came["t0"], lambda: publisher.put(pose_now().encode()))
        came.clear()
        began_s = time.monotonic() + 2.0 / rate_hz
        for number in range(frames):
            due_s = began_s + number / rate_hz + (0.004 if number % 2 else 0.0)
            time.sleep(max(due_s - time.monotonic(), 0.0))
            publisher.put(pose_now().encode())
        # Half of them would be without slack. A few may be on a machine that wakes this thread late.
        until(lambda: came["t0"] >= 0.75 * frames, within_s=2.0, what="the frames")


@pytest.mark.parametrize(
    ("listens", "calls"),
    [("", ""), ("?mixed_rel=1", ""), ("", "?mixed_rel=1"), ("", "?rel=1"), ("?mixed_rel=0", "?mixed_rel=0")],
)
def test_two_ends_meet_over_quic_whether_or_not_they_say_that_poses_are_datagrams(
    identities: Sequence[session.TlsFiles], listens: str, calls: str
) -> None:
    ground, uav, _ = identities
    endpoint = free_endpoint().replace("tcp/", "quic/")
    with (
        zenoh.open(session.router_config([endpoint + listens], tls=ground)) as router,
        client.connect(endpoint + calls, tls=uav) as caller,
    ):
        assert list(caller.info.routers_zid()) == [router.zid()]


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_two_ends_with_certificates_meet_at_an_ipv6_address(
    identities: Sequence[session.TlsFiles], protocol: str
) -> None:
    ground, uav, _ = identities
    endpoint = f"{protocol}/[::1]:{free_port(socket.SOCK_STREAM if protocol == 'tls' else socket.SOCK_DGRAM)}"
    with (
        zenoh.open(session.router_config([endpoint], tls=ground)) as router,
        client.connect(endpoint, tls=uav) as caller,
    ):
        assert list(caller.info.routers_zid()) == [router.zid()]


def test_a_router_that_accepts_and_says_nothing_is_soon_parted_with_and_called_again() -> None:
    """Until then neither a vehicle that is told to stop nor a camera that looks for its topic could go on."""
    with socket.create_server(("127.0.0.1", 0)) as mute:
        mute.settimeout(session.OPEN_TIMEOUT_MS / 1000 + 4.0)  # zenoh's own patience is 10 s
        endpoint = f"tcp/127.0.0.1:{mute.getsockname()[1]}"
        with zenoh.open(session.peer_config([], [endpoint])):
            calls = [mute.accept()[0] for _ in range(2)]
        for call in calls:
            call.close()
