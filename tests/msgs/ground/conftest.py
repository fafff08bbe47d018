"""A ground that lets in uav1, uav2, an operator and a reader by their certificates."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh

from msgs.ground.keys import init_authority, issue
from msgs.ground.router import load_router, open_router
from msgs.session import TlsFiles
from sim_replay.ports import free_endpoint


@dataclass(frozen=True)
class Ground:
    secure: str  # the endpoint that asks for certificates
    loopback: str  # plain TCP
    keys: dict[str, TlsFiles]
    folder: Path
    router: zenoh.Session


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> dict[str, TlsFiles]:
    """One identity each of ours, and a `stranger` whom another authority calls uav1."""
    folder, other = tmp_path_factory.mktemp("keys"), tmp_path_factory.mktemp("other")
    made = {}
    init_authority(folder)
    for name in ("ground", "uav1", "uav2", "alice", "screen", "unlisted"):
        made[name] = issue(folder, name, ["127.0.0.1", "localhost"])
    init_authority(other)
    forged = issue(other, "uav1", ["127.0.0.1"])
    made["stranger"] = TlsFiles(made["uav1"].root_ca, forged.certificate, forged.private_key)
    return made


def write_router_config(folder: Path, listen: list[str], files: TlsFiles, access: str) -> Path:
    path = folder / "router.toml"
    path.write_text(
        f"listen = {listen}\n"
        f'[tls]\nroot_ca = "{files.root_ca}"\ncertificate = "{files.certificate}"\n'
        f'private_key = "{files.private_key}"\n[access]\n{access}'
    )
    return path


@pytest.fixture(params=["tls", "quic"])
def ground(request: pytest.FixtureRequest, tmp_path: Path, keys: dict[str, TlsFiles]) -> Iterator[Ground]:
    secure = free_endpoint().replace("tcp/", f"{request.param}/")
    loopback = free_endpoint()
    access = 'vehicles = ["uav1", "uav2"]\noperators = ["alice"]\nreaders = ["screen"]\nloopback_reads = true\n'
    path = write_router_config(tmp_path, [secure, loopback], keys["ground"], access)
    with open_router(load_router(path), tmp_path) as router:
        yield Ground(secure, loopback, keys, tmp_path, router)
