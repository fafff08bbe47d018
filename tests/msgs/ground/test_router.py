"""Who gets in and who may do what, with real certificates and sessions."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from msgs import client, topics
from msgs.ground.keys import init_authority, issue
from msgs.ground.router import load_router, open_router
from msgs.publish import Node
from msgs.session import TlsFiles, client_config, peer_config
from sim_replay.ports import free_endpoint
from tests.waiting import until

from ..conftest import pose_now
from .conftest import Ground, write_router_config


def vehicle(stack: ExitStack, ground: Ground, name: str) -> zenoh.Session:
    """A vehicle's session as the daemon opens it, with the certificate of `name`."""
    return stack.enter_context(zenoh.open(peer_config([free_endpoint()], [ground.secure], tls=ground.keys[name])))


def watch(session: zenoh.Session, key: str) -> Counter[str]:
    seen: Counter[str] = Counter()
    session.declare_subscriber(key, zenoh.handlers.Callback(lambda s: seen.update([str(s.key_expr)]), indirect=False))
    return seen


def test_a_vehicle_is_heard_under_its_own_name_and_under_no_other(ground: Ground) -> None:
    with ExitStack() as stack:
        uav1, uav2 = vehicle(stack, ground, "uav1"), vehicle(stack, ground, "uav2")
        reader = stack.enter_context(client.connect(ground.secure, tls=ground.keys["screen"]))
        seen = watch(reader, "0/*/target/**")
        own, other, forged = (
            stack.enter_context(Node(session, name)).publisher(topics.POSE, target)
            for session, name, target in ((uav1, "uav1", "t0"), (uav2, "uav2", "t0"), (uav1, "uav2", "t3"))
        )

        def put() -> None:
            for publisher in (forged, own, other):
                publisher.put(pose_now().encode())

        until(lambda: min(seen[own.key], seen[other.key]) >= 5, put)
        assert set(seen) == {own.key, other.key}
        # The forged tokens would show uav1's session as a node of uav2.
        zid = str(uav1.zid())
        tokens = [str(reply.ok.key_expr) for reply in reader.liveliness().get("@ros2_lv/0/**") if reply.ok]
        assert any(zid in token and "%uav1" in token for token in tokens)
        assert not any(zid in token and "%uav2" in token for token in tokens)


def test_a_late_reader_gets_the_history_of_events(ground: Ground) -> None:
    with ExitStack() as stack:
        uav1 = vehicle(stack, ground, "uav1")
        events = stack.enter_context(Node(uav1, "uav1")).publisher(topics.EVENTS)
        alive = stack.enter_context(uav1.liveliness().declare_token(topics.alive_token("uav1")))
        assert alive is not None
        for _ in range(3):
            events.put(b"an event")
        reader = stack.enter_context(client.connect(ground.secure, tls=ground.keys["screen"]))
        counts = stack.enter_context(client.subscribe_all(reader, "uav1"))
        until(lambda: counts.counts().get("uav1/events", 0) >= 3)
        until(lambda: [r for r in reader.liveliness().get("uavpose/@v1/*/alive") if r.ok] != [])


@pytest.mark.parametrize("name", ["info", "config", "model"])
def test_whoever_may_read_is_told_what_a_daemon_tells_of_itself(ground: Ground, name: str) -> None:
    key = f"uavpose/@v1/uav1/{name}"
    handler = zenoh.handlers.Callback(lambda query: query.reply(query.key_expr, b"{}"), indirect=False)
    with ExitStack() as stack:
        uav1 = vehicle(stack, ground, "uav1")
        stack.enter_context(uav1.declare_queryable(key, handler))
        for reader in (
            stack.enter_context(client.connect(ground.secure, tls=ground.keys["screen"])),
            stack.enter_context(client.connect(ground.loopback)),
        ):
            until(lambda reader=reader: any(reply.ok for reply in reader.get(key, timeout=1.0)))


def test_readers_cannot_publish_nor_command_and_operators_can_command(ground: Ground) -> None:
    commands: list[str] = []

    def answer(query: zenoh.Query) -> None:
        commands.append(str(query.selector))
        query.reply(query.key_expr, b"done")

    with ExitStack() as stack:
        uav1 = vehicle(stack, ground, "uav1")
        handler = zenoh.handlers.Callback(answer, indirect=False)
        key = "uavpose/@v1/uav1/cmd/stop"
        stack.enter_context(uav1.declare_queryable("uavpose/@v1/uav1/cmd/**", handler))
        screen = stack.enter_context(client.connect(ground.secure, tls=ground.keys["screen"]))
        local = stack.enter_context(client.connect(ground.loopback))
        alice = stack.enter_context(client.connect(ground.secure, tls=ground.keys["alice"]))
        until(lambda: any(reply.ok for reply in alice.get(key, timeout=1.0)))
        assert commands
        commands.clear()
        for reader in (screen, local):
            assert not any(reply.ok for reply in reader.get(key, timeout=0.5))
        assert commands == []

        seen = watch(ground.router, "0/uav1/**")
        own = stack.enter_context(Node(uav1, "uav1")).publisher(topics.POSE, "t0")
        forged = own.key.replace("t0", "t9")

        def put() -> None:
            for session in (screen, local, alice):
                session.put(forged, b"forged")
            own.put(pose_now().encode())

        until(lambda: seen[own.key] >= 5, put)
        assert set(seen) == {own.key}


def test_without_a_certificate_of_ours_nobody_gets_in_and_loopback_reads(ground: Ground) -> None:
    with pytest.raises(ConnectionError):
        client.connect(ground.secure, tls=ground.keys["stranger"])
    with ExitStack() as stack:
        uav1 = vehicle(stack, ground, "uav1")
        local = stack.enter_context(client.connect(ground.loopback))
        poses = stack.enter_context(client.subscribe(local, "uav1"))
        publisher = stack.enter_context(Node(uav1, "uav1")).publisher(topics.POSE, "t0")
        until(lambda: poses.poll() is not None, lambda: publisher.put(pose_now().encode()))


def test_a_vehicle_hears_no_other_and_who_is_in_no_list_neither_hears_nor_is_heard(ground: Ground) -> None:
    with ExitStack() as stack:
        uav1, uav2 = vehicle(stack, ground, "uav1"), vehicle(stack, ground, "uav2")
        unlisted = stack.enter_context(client.connect(ground.secure, tls=ground.keys["unlisted"]))
        on_ground, *others = (watch(session, "0/uav1/target/**") for session in (ground.router, uav2, unlisted))
        own = stack.enter_context(Node(uav1, "uav1")).publisher(topics.POSE, "t0")

        def put() -> None:
            unlisted.put(own.key.replace("t0", "t9"), b"forged")
            own.put(pose_now().encode())

        until(lambda: on_ground[own.key] >= 20, put)
        assert set(on_ground) == {own.key}
        # A session delivers to itself what it puts.
        assert [own.key in other for other in others] == [False, False]


@pytest.mark.parametrize("protocol", ["tls", "quic"])
def test_the_router_command_says_who_comes_goes_and_has_no_role_and_ends_on_sigterm(
    tmp_path: Path, keys: dict[str, TlsFiles], protocol: str
) -> None:
    endpoint = free_endpoint().replace("tcp/", f"{protocol}/")
    path = write_router_config(tmp_path, [endpoint], keys["ground"], 'vehicles = ["uav1"]\n')
    command = [sys.executable, "-m", "msgs.ground.cli", "router", "--config", str(path)]
    router = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert router.stderr is not None
        assert router.stderr.readline() == f"listening on {endpoint}\n"
        with (
            zenoh.open(client_config([endpoint], tls=keys["unlisted"])),
            zenoh.open(peer_config([], [endpoint], tls=keys["uav1"])) as uav1,
        ):
            told = router.stderr.readline()
            assert told.startswith("unlisted: connected, but [access] names it in no role: ")
            token = uav1.liveliness().declare_token(topics.alive_token("uav1"))
            assert router.stderr.readline() == "uav1: here\n"
            token.undeclare()
            assert router.stderr.readline() == "uav1: gone\n"
        router.terminate()
        assert router.wait(60.0) == 0
    finally:
        router.kill()


def test_every_name_that_a_vehicle_may_have_can_be_issued_and_gets_in(tmp_path: Path) -> None:
    """ROS lets a name end with an underscore; names of hosts do not."""
    init_authority(tmp_path)
    router, uav = issue(tmp_path, "ground", ["127.0.0.1"]), issue(tmp_path, "uav1_")
    secure, loopback = free_endpoint().replace("tcp/", "tls/"), free_endpoint()
    path = write_router_config(tmp_path, [secure, loopback], router, 'vehicles = ["uav1_"]\nloopback_reads = true\n')
    with ExitStack() as stack:
        stack.enter_context(open_router(load_router(path), tmp_path))
        session = stack.enter_context(zenoh.open(peer_config([], [secure], tls=uav)))
        publisher = stack.enter_context(Node(session, "uav1_")).publisher(topics.POSE, "t0")
        reader = stack.enter_context(client.connect(loopback))
        seen = watch(reader, "0/*/target/**")
        until(lambda: seen[publisher.key] >= 3, lambda: publisher.put(pose_now().encode()))


def test_a_vehicle_that_is_listed_twice_gets_in_as_one(tmp_path: Path, keys: dict[str, TlsFiles]) -> None:
    secure, loopback = free_endpoint().replace("tcp/", "tls/"), free_endpoint()
    access = 'vehicles = ["uav1", "uav2", "uav1"]\nloopback_reads = true\n'
    path = write_router_config(tmp_path, [secure, loopback], keys["ground"], access)
    with ExitStack() as stack:
        stack.enter_context(open_router(load_router(path), tmp_path))
        session = stack.enter_context(zenoh.open(peer_config([], [secure], tls=keys["uav1"])))
        publisher = stack.enter_context(Node(session, "uav1")).publisher(topics.POSE, "t0")
        seen = watch(stack.enter_context(client.connect(loopback)), "0/*/target/**")
        until(lambda: seen[publisher.key] >= 3, lambda: publisher.put(pose_now().encode()))


def test_the_router_command_says_nothing_of_who_bears_no_vehicle_s_name(tmp_path: Path) -> None:
    endpoint, path = free_endpoint(), tmp_path / "router.toml"
    path.write_text(f'listen = ["{endpoint}"]\n')
    command = [sys.executable, "-m", "msgs.ground.cli", "router", "--config", str(path)]
    router = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert router.stderr is not None
        assert router.stderr.readline() == f"listening on {endpoint}; everyone may do everything\n"
        with client.connect(endpoint) as session, ExitStack() as stack:
            for name in ("my-uav", "\x1b[2J", "uav1"):
                stack.enter_context(session.liveliness().declare_token(f"uavpose/@v1/{name}/alive"))
            assert router.stderr.readline() == "uav1: here\n"
    finally:
        router.kill()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('listen = ["tcp/0.0.0.0:7447"]\nlisten_on = 3', "listen_on: unknown key"),
        ("[access]\n", "listen: is missing"),
        ('listen = ["udp/0.0.0.0:7447"]', "'udp/0.0.0.0:7447' is not tcp/HOST:PORT, tls/HOST:PORT or quic/HOST:PORT"),
        ('listen = ["quic/0.0.0.0:7447"]', "router.toml: listen: 'quic/0.0.0.0:7447' needs tls"),
        ('listen = ["tcp/0.0.0.0:7447"]\n[access]\nvehicles = ["uav1"]', "[access] identifies clients by their"),
        ('listen = ["tcp/0.0.0.0:7447"]\n[access]\nvehicles = ["uav/1"]', "access.vehicles.0: "),
        (
            'listen = ["tls/0.0.0.0:7447"]\n[tls]\nroot_ca = "none.pem"\ncertificate = "a"\nprivate_key = "b"',
            "none.pem cannot be read: No such file",
        ),
        (
            'listen = ["tls/0.0.0.0:7447"]\n[tls]\nroot_ca = "~nosuchuser/a"\ncertificate = "a"\nprivate_key = "b"',
            "[tls] '~nosuchuser/a' cannot be resolved: ",
        ),
        ("listen = [", "not valid TOML"),
    ],
)
def test_a_fault_in_the_router_file_is_a_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "router.toml"
    path.write_text(text)
    command = [sys.executable, "-m", "msgs.ground.cli", "router", "--config", str(path)]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout) == (2, "")
    assert sentence in ended.stderr
    assert "Traceback" not in ended.stderr
