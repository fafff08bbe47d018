"""[zenoh] as a person writes it: endpoints and certificates that would not do are refused before flight."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    PrivateFormat,
    load_pem_private_key,
)

from edge.config import load_config
from edge.errors import InputError
from edge.links.zenoh_link import ZenohLink
from msgs.client import connect, subscribe
from msgs.ground.keys import init_authority, issue
from msgs.session import TlsFiles, router_config
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .reports import make_report, make_track
from .test_zenoh_link import MOUNT

CAMERA = '[camera]\ntype = "sequence"\npath = "scene"\n'
TLS = '[zenoh.tls]\nroot_ca = "ca.pem"\ncertificate = "uav1.pem"\nprivate_key = "uav1.key"\n'


def write(folder: Path, text: str) -> Path:
    path = folder / "config.toml"
    path.write_text(CAMERA + text)
    return path


def make_keys(folder: Path) -> TlsFiles:
    init_authority(folder)
    issue(folder, "uav1", ["127.0.0.1"])
    return issue(folder, "ground", ["127.0.0.1"])


def other_key(folder: Path) -> None:
    (folder / "uav1.key").write_bytes((folder / "ground.key").read_bytes())


def encrypted_key(folder: Path) -> None:
    path = folder / "uav1.key"
    key, encryption = load_pem_private_key(path.read_bytes(), None), BestAvailableEncryption(b"secret")
    path.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, encryption))


def open_key(folder: Path) -> None:
    (folder / "uav1.key").chmod(0o644)


def no_certificate(folder: Path) -> None:
    (folder / "uav1.pem").unlink()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('connect = ["quic/ground:7447"]', "config.toml:4: [zenoh]: connect: 'quic/ground:7447' needs tls: root_ca"),
        ('connect = ["udp/ground:7447"]', "'udp/ground:7447' is not tcp/HOST:PORT, tls/HOST:PORT or quic/HOST:PORT"),
        ('listen = ["tcp/0.0.0.0:77447"]', "'tcp/0.0.0.0:77447' is not"),
        (
            "pose_rate_max_hz = 0",
            "config.toml:5: [zenoh] pose_rate_max_hz: must be at least 0.1",
        ),
        ('tls = { root_ca = "x" }', "[zenoh.tls] certificate: is missing"),
    ],
)
def test_a_fault_is_told_with_file_line_and_key(tmp_path: Path, text: str, sentence: str) -> None:
    with pytest.raises(InputError) as error:
        load_config(write(tmp_path, f"[zenoh]\n{text}\n"))
    assert sentence in str(error.value)


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (other_key, "uav1.key is not the PEM key of"),
        (encrypted_key, "uav1.pem, or is encrypted"),
        (open_key, "uav1.key is open to other users; chmod 600 it"),
        (no_certificate, "uav1.pem cannot be read: No such file"),
    ],
)
def test_certificates_that_would_not_do_are_refused(tmp_path: Path, spoil: object, sentence: str) -> None:
    make_keys(tmp_path)
    assert callable(spoil)
    spoil(tmp_path)
    with pytest.raises(InputError) as error:
        load_config(write(tmp_path, TLS))
    assert sentence in str(error.value)
    assert "config.toml:4: [zenoh] tls: " in str(error.value)


def test_the_link_reaches_the_ground_over_quic_with_its_certificate_and_caps_poses_there(tmp_path: Path) -> None:
    files = make_keys(tmp_path)
    secure, on_board = free_endpoint().replace("tcp/", "quic/"), free_endpoint()
    text = f'[zenoh]\nlisten = ["{on_board}"]\nconnect = ["{secure}"]\npose_rate_max_hz = 5\n{TLS}'
    settings = load_config(write(tmp_path, text)).config.zenoh
    link = ZenohLink(settings, "uav1", MOUNT)
    came: list[str] = []
    with zenoh.open(router_config([secure], tls=files)) as ground, on_board_of(link, on_board) as board:
        handler = zenoh.handlers.Callback(lambda s: came.append(str(s.key_expr)), indirect=False)
        ground.declare_subscriber("0/uav1/target/*/pose/**", handler)
        with subscribe(board, "uav1", depth=500) as poses:
            until(lambda: bool(came), lambda: put(link), what="a pose on the ground")
            list(iter(poses.poll, None))
            came.clear()
            taken, began = 0, time.monotonic()

            def turn() -> None:
                nonlocal taken
                put(link)
                taken += sum(1 for _ in iter(poses.poll, None))

            until(lambda: taken >= 50, turn, what="poses on board")
            elapsed_s = time.monotonic() - began
    # One for the period that had begun, one that was on its way when counting started.
    assert 1 <= len(came) <= 5.0 * elapsed_s + 2


def put(link: ZenohLink) -> None:
    link.publish(make_report(make_track(time.monotonic_ns())))


@contextlib.contextmanager
def on_board_of(link: ZenohLink, endpoint: str) -> Iterator[zenoh.Session]:
    """The link running, and a tool's session on board."""
    link.start()
    try:
        with connect(endpoint) as session:
            yield session
    finally:
        link.stop()
