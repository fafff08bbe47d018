"""Checks of the links: is the autopilot received, does the ground answer, are our own endpoints free?"""

from __future__ import annotations

import os
import socket
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import zenoh

from edge import clock
from edge.config import Config, MavlinkSettings
from edge.config_ground import ZenohSettings
from edge.errors import InputError
from edge.findings import Finding, device_fault, good, poor, wrong
from edge.links.mavlink_endpoints import NetworkEndpoint, parse_endpoint
from edge.links.mavlink_link import MavlinkLink, signing_of, signing_state_of
from edge.links.signing import ahead_of_clock
from edge.links.transports.medium import resolve
from edge.requests import RequestQueue
from edge.status import ask, loopback_endpoints
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import CameraInfo
from msgs.session import client_config, peer_config

CAMERA_REASONS = ("camera_", "no_camera", "no_frame")  # prefixes of the kinds of edge.health.Reason about it
NO_AUTOPILOT = "no_attitude"
ADVICE_AUTOPILOT = (
    "check that the autopilot is on, its port set to MAVLink 2 at this speed, and its stream sent to this address"
)
HEARING_S = 4.0
LOOK_S = 0.1


def link_findings(config: Config, running: Mapping[str, Any] | None) -> Iterator[Finding]:
    """`running`: the running daemon's `info`, if any: its endpoints are then in use and not tried."""
    if running is not None:
        said = f"running (process {running['pid']}), state {running.get('state', 'starting')}"
        others = {kind: text for kind, text in told_reasons(running) if not kind.startswith(CAMERA_REASONS)}
        if NO_AUTOPILOT in others:
            yield wrong("daemon", f"{said}: {'; '.join(others.values())}", ADVICE_AUTOPILOT)
        elif others:
            advice = "`uavpose-edge status` shows its counters, `journalctl -u uavpose-edge` its log"
            yield poor("daemon", f"{said}: {'; '.join(others.values())}", advice)
        else:
            yield good("daemon", f"{said}; its links are not tested by this command")
        return
    if config.zenoh.enabled:
        yield from _zenoh(config.zenoh)
    if config.mavlink.enabled:
        yield from _mavlink(config.mavlink)


def told_reasons(running: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Kind and text of the reasons that a daemon reports."""
    return list(zip(running.get("reason_kinds", ()), running.get("reasons", ()), strict=True))


def running_daemon(config: Config) -> Mapping[str, Any] | None:
    """`info` of the daemon that runs with this configuration; None if there is none."""
    tls = config.zenoh.tls.files() if config.zenoh.tls is not None else None
    for endpoint in loopback_endpoints(config.zenoh) if config.zenoh.enabled else []:
        if (answer := ask(endpoint, config.vehicle.name, tls)) is not None:
            info: Mapping[str, Any] = answer["info"]
            return info
    return None


def _zenoh(settings: ZenohSettings) -> Iterator[Finding]:
    tls = settings.tls.files() if settings.tls is not None else None
    try:
        zenoh.open(peer_config(settings.listen, [], tls=tls)).close()
        yield good(
            "zenoh", f"can listen on {', '.join(settings.listen)}" if settings.listen else "no address to listen on"
        )
    except zenoh.ZError:
        advice = "stop the program that uses one of them (`ss -ltnup` shows which), or change [zenoh] listen"
        yield wrong("zenoh", f"cannot listen on {', '.join(settings.listen)}", advice)
    for endpoint in settings.connect:
        try:
            zenoh.open(client_config([endpoint], tls=tls)).close()
            yield good("ground", f"{endpoint} answers")
        except zenoh.ZError:
            advice = "start `uavpose-ground router` there; check address, firewall and certificates"
            yield poor("ground", f"{endpoint} does not answer", advice)


def _mavlink(settings: MavlinkSettings) -> Iterator[Finding]:
    """Listen as the daemon does until a heartbeat is received."""
    if settings.signing_key is not None:
        yield signing_finding(signing_state_of(settings, settings.signing_key))
    for endpoint in settings.endpoints:
        kind, _, rest = endpoint.partition(":")
        if kind == "serial" and (fault := device_fault(Path(rest.rpartition(":")[0]), "dialout")) is not None:
            yield wrong("mavlink", *fault)
            return
        if isinstance(named := parse_endpoint(endpoint), NetworkEndpoint):
            try:
                resolve(named, socket.SOCK_DGRAM)
            except InputError as error:
                if kind in ("udpin", "tcpin"):
                    yield wrong("mavlink", str(error), "use an address of this computer, or 0.0.0.0 for all of them")
                    return
                yield poor("host", str(error), f"test it with `getent hosts {named.host}`, or use a numeric address")
    own_ship = OwnShipBuffer()
    camera = CameraInfo("doctor", (640, 480), np.eye(3), None)
    try:
        link = MavlinkLink(settings, own_ship, camera, RequestQueue(), signing_of(settings))
        link.start()
    except InputError as error:
        yield wrong(
            "mavlink",
            str(error),
            "stop the program that uses it (`ss -lunp` shows which), or change [mavlink] endpoints",
        )
        return
    try:
        counters = _wait(link.counters, lambda counted: counted.get("received_HEARTBEAT", 0) > 0)
    finally:
        link.stop()
    where = ", ".join(settings.endpoints)
    if counters.get("received_HEARTBEAT", 0):
        yield good("mavlink", f"{where}: heartbeat received")
        return
    refused = ", ".join(f"{name} {count}" for name, count in counters.items() if name.startswith("refused_") and count)
    counted = f" ({refused})" if refused else ""
    yield wrong("mavlink", f"{where}: no heartbeat within {HEARING_S:.0f} s{counted}", ADVICE_AUTOPILOT)


def signing_finding(state: Path) -> Finding:
    """Whether the daemon can store the last timestamp used for signing, and the stored one is not in the future."""
    advice = "set [mavlink] signing_state to a file in a folder of its own, such as /var/lib/uavpose/mavlink.timestamp"
    if os.path.isdir(state):  # Path.is_dir raises if a parent folder may not be entered
        return wrong("signing", f"{state} is a folder: after a restart, replayed messages would be accepted", advice)
    with suppress(OSError), tempfile.TemporaryFile(dir=state.parent):  # it is replaced, so the folder's rights decide
        ahead = ahead_of_clock(state, clock.utc_ns())
        if ahead is None:
            return good("signing", f"the last timestamp is stored in {state}")
        clock_advice = "set the clock; if it is right now and was wrong when the file was written, delete the file"
        return poor("signing", f"{ahead}: an autopilot with the correct time may be rejected", clock_advice)
    return wrong("signing", f"{state} cannot be written: after a restart, replayed messages would be accepted", advice)


def _wait(look: Callable[[], dict[str, int]], done: Callable[[dict[str, int]], bool]) -> dict[str, int]:
    """Poll until `done` or for HEARING_S; returns the last result."""
    pause, counted = threading.Event(), look()
    for _ in range(round(HEARING_S / LOOK_S)):
        if done(counted):
            break
        pause.wait(LOOK_S)
        counted = look()
    return counted
