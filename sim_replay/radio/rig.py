"""The ground side of a trial: a router that requires certificates, and vehicles as processes that connect to it."""

from __future__ import annotations

import json
import socket
import sys
import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from msgs.ground.router import AccessSettings, RouterSettings, TlsSettings, open_router
from msgs.session import TlsFiles
from sim_replay.faults.processes import Process
from sim_replay.play import PlayError
from sim_replay.ports import LOOPBACK, free_port

START_S = 60.0
_NO_CAP_HZ = 240.0  # of poses: every pose is offered to the link, which thins the rest as on any radio

Transport = Literal["quic", "tls"]
SOCKET_KINDS = {"quic": socket.SOCK_DGRAM, "tls": socket.SOCK_STREAM}


@dataclass(frozen=True)
class Ground:
    """A running router."""

    transport: Transport
    port: int  # of the vehicles' endpoint
    loopback: str  # endpoint for local tools
    keys: Mapping[str, TlsFiles]

    def endpoint(self, port: int) -> str:
        """What a vehicle connects to, through a relay's port or directly."""
        return f"{self.transport}/{LOOPBACK}:{port}"


@contextmanager
def ground(folder: Path, transport: Transport, uavs: Sequence[str]) -> Iterator[Ground]:
    """A router with its own certificate and one for each vehicle; tools on this machine need none."""
    from msgs.ground.keys import init_authority, issue  # of the extra `ground`, which the other commands do without

    init_authority(folder)
    router, *vehicles = (issue(folder, name, [LOOPBACK]) for name in ("ground", *uavs))
    port = free_port(SOCKET_KINDS[transport])
    made = Ground(
        transport, port, f"tcp/{LOOPBACK}:{free_port(socket.SOCK_STREAM)}", dict(zip(uavs, vehicles, strict=True))
    )
    settings = RouterSettings(
        listen=[made.endpoint(port), made.loopback],
        tls=TlsSettings(
            root_ca=router.root_ca.absolute(),
            certificate=router.certificate.absolute(),
            private_key=router.private_key.absolute(),
        ),
        access=AccessSettings(vehicles=list(uavs), loopback_reads=True),
    )
    with open_router(settings, folder):
        yield made


class Vehicle:
    """The process of one vehicle (`sim_replay.radio.vehicle`). Raises PlayError if it does not start or answer."""

    def __init__(self, uav: str, endpoint: str, tls: TlsFiles, fps: float) -> None:
        self.uav = uav
        self._came = threading.Condition()
        self._told: list[dict[str, Any]] = []
        self._said = ""
        command = [sys.executable, "-m", "sim_replay.radio.vehicle", "--uav", uav, "--connect", endpoint]
        files = ["--ca", str(tls.root_ca), "--cert", str(tls.certificate), "--key", str(tls.private_key)]
        self._process = Process([*command, *files, "--fps", str(fps), "--pose-rate-max", str(_NO_CAP_HZ)], self._hear)

    def wait_ready(self) -> None:
        self._wait("ready")

    def begin(self) -> None:
        self._process.tell("begin")

    def end(self) -> dict[str, int]:
        """Stop sending; returns its link's counters. The session stays open."""
        self._process.tell("end")
        counters: dict[str, int] = self._wait("counters")
        return counters

    def close(self) -> None:
        self._process.end()

    def _wait(self, key: str) -> Any:
        def found() -> list[Any]:
            return [told[key] for told in self._told if key in told]

        with self._came:
            if not self._came.wait_for(lambda: found() or self._process.exit_code is not None, START_S) or not found():
                raise PlayError(f"the vehicle {self.uav} did not report `{key}`: {self._said or 'no output'}")
            return found()[0]

    def _hear(self, line: str, _: int) -> None:
        with self._came:
            try:
                self._told.append(json.loads(line))
            except ValueError:
                self._said = line
            self._came.notify_all()
