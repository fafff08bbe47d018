"""The ground station's zenoh router: mutual TLS or QUIC, and access rules for each identity. Its settings:

listen = ["quic/0.0.0.0:7447", "tcp/127.0.0.1:7447"]

[tls]
root_ca = "keys/ca.pem"
certificate = "keys/ground.pem"
private_key = "keys/ground.key"

[access]
vehicles = ["uav1", "uav2"]
operators = ["alice"]
readers = ["screen"]
loopback_reads = true
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import zenoh
from pydantic import Field, model_validator

from msgs.ground.access import AccessSettings, access_control
from msgs.ground.errors import InputError
from msgs.ground.feed import ALIVE, alive_uav
from msgs.session import TlsFiles, check_endpoint, reason_of, router_config
from msgs.settings import Section, WrittenPath, load_settings


class TlsSettings(Section):
    root_ca: WrittenPath = Field(description="the authority that signed every certificate, PEM")
    certificate: WrittenPath = Field(description="the router's, PEM")
    private_key: WrittenPath = Field(description="the router's, PEM, mode 0600")


class RouterSettings(Section):
    listen: list[str] = Field(min_length=1, description="endpoints: quic/HOST:PORT, tls/, tcp/")
    domain: int = Field(default=0, ge=0, le=232, description="ROS domain, first chunk of every key")
    tls: TlsSettings | None = Field(default=None, description="certificates, for tls/ and quic/ endpoints")
    access: AccessSettings | None = Field(default=None, description="who may do what; without it everyone may")

    @model_validator(mode="after")
    def _endpoints_do(self) -> RouterSettings:
        for endpoint in self.listen:
            try:
                check_endpoint(endpoint, tls=self.tls is not None)
            except ValueError as error:
                raise ValueError(f"listen: {error}") from error
        if self.access is not None and self.tls is None:
            raise ValueError("[access] identifies clients by their certificates and needs [tls]")
        return self


def load_router(path: Path) -> RouterSettings:
    """Read a router's TOML; paths are relative to its folder. Raises InputError naming file and key."""
    return load_settings(path, RouterSettings, InputError)


@contextmanager
def open_router(settings: RouterSettings, folder: Path) -> Iterator[zenoh.Session]:
    """The router, running until the context ends. Raises InputError for invalid files and endpoints."""
    tls = _tls_files(settings, folder)
    try:
        if tls is not None:
            tls.check()
    except ValueError as error:
        raise InputError(f"[tls] {error}") from error
    rules = None
    if settings.access is not None:
        rules = access_control(settings.access, settings.domain)
    try:
        session = zenoh.open(router_config(settings.listen, tls=tls, access_control=rules))
    except zenoh.ZError as error:
        raise InputError(f"the router cannot listen on {', '.join(settings.listen)}: {reason_of(error)}") from error
    with session:
        yield session


def _tls_files(settings: RouterSettings, folder: Path) -> TlsFiles | None:
    if settings.tls is None:
        return None
    return TlsFiles(*(_from_folder(folder, path) for path in settings.tls.model_dump().values()))


def _from_folder(folder: Path, path: Path) -> Path:
    try:
        return folder / path.expanduser()
    except RuntimeError as error:  # home folder unknown
        raise InputError(f"[tls] '{path}' cannot be resolved: {error}") from error


def route(path: Path, stop: threading.Event, say: Callable[[str], None]) -> int:
    """Run the router of a TOML file until `stop` is set, reporting vehicles that appear and leave; returns 0."""
    settings = load_router(path)
    folder = path.resolve().parent
    with open_router(settings, folder) as session:
        tls = _tls_files(settings, folder)
        if tls is not None and (doubt := tls.doubt()) is not None:
            say(f"links of vehicles over tls and quic may fail: {doubt}")

        def seen(sample: zenoh.Sample) -> None:
            vehicle = alive_uav(str(sample.key_expr))
            if vehicle is not None:
                say(f"{vehicle}: {'gone' if sample.kind == zenoh.SampleKind.DELETE else 'here'}")

        handler = zenoh.handlers.Callback(seen, indirect=False)
        session.liveliness().declare_subscriber(ALIVE, handler, history=True)
        if settings.access is not None:
            _tell_of_names_without_role(session, settings.access, say)
        say(f"listening on {', '.join(settings.listen)}" + ("" if settings.access else "; everyone may do everything"))
        stop.wait()
    return 0


def _tell_of_names_without_role(session: zenoh.Session, access: AccessSettings, say: Callable[[str], None]) -> None:
    """Their certificates are good, so zenoh lets them connect; it then drops all they send, and tells neither end."""
    told: set[tuple[str, str]] = set()  # a QUIC session has two links

    def linked(event: zenoh.LinkEvent) -> None:
        name, zid = event.link.auth_identifier, str(event.link.zid)
        if event.kind != zenoh.SampleKind.PUT or name is None or access.gives_role(name) or (name, zid) in told:
            return
        told.add((name, zid))
        say(f"{name}: connected, but [access] names it in no role: nothing is passed on from it or to it")

    session.info.declare_link_events_listener(zenoh.handlers.Callback(linked, indirect=False), history=True)
