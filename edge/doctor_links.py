"""Checks of the links: is the autopilot received, does the ground answer, are our own endpoints free?"""

from __future__ import annotations

import errno
import os
import re
import shlex
import socket
import tempfile
import termios
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import serial
import zenoh

from edge import clock
from edge.addresses import no_passwords
from edge.config import Config, MavlinkSettings
from edge.config_ground import ZenohSettings
from edge.errors import InputError
from edge.findings import Finding, device_fault, good, poor, wrong
from edge.health import Activity, Condition, HealthState
from edge.links.mavlink_endpoints import SerialEndpoint, parse_endpoint
from edge.links.mavlink_link import MavlinkLink, signing_of, signing_state_of
from edge.links.signing import ahead_of_clock
from edge.links.transports.medium import resolve
from edge.reload import changes_in_flight
from edge.requests import RequestQueue
from edge.status import ANY, ask, loopback_endpoints
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import CameraInfo
from msgs.session import client_config, peer_config, reason_of

CAMERA_REASONS = ("camera_", "no_camera", "no_frame")  # prefixes of the kinds of edge.health.Reason about it
NO_AUTOPILOT = "no_attitude"
ADVICE_AUTOPILOT = (
    "check that the autopilot is on, its port set to MAVLink 2 at this speed, its stream sent to this address, "
    "and its id that of [mavlink] system_id, if given"
)
ADVICE_SIGNING = "give the autopilot the same key as [mavlink] signing_key, and the time (GPS), or leave the key out"
ADVICE_NAME = "use the vehicle's own certificate, `uavpose-ground keys issue NAME`, or set [vehicle] name"
ADVICE_RECORDER = (
    "`journalctl -u uavpose-edge` says why; outside /var/lib/uavpose the service needs ReadWritePaths=, and a restart "
    "if the disk was read-only when it started, docs/install.md"
)
ADVICE_RELOAD = "reload it (`sudo systemctl reload uavpose-edge`), which keeps the targets"
ADVICE_RESTART = "restart it (`sudo systemctl restart uavpose-edge`)"
UNPROVEN = ("refused_unsigned", "refused_signature", "refused_replay")  # counters: heard, but not believed
STARTING = ("the daemon is still starting", "run doctor again in a few seconds")
ADVICE_ADDRESS = "use an address of this computer, or 0.0.0.0 for all of them"
HEARING_S = 4.0
LOOK_S = 0.1


def link_findings(config: Config, running: Mapping[str, Any] | None) -> Iterator[Finding]:
    """`running`: the running daemon's `info`, if any: its endpoints are then in use and not tried."""
    if config.mavlink.enabled and config.mavlink.signing_key is not None:
        yield signing_finding(signing_state_of(config.mavlink, config.mavlink.signing_key))
    if (unheard := config.zenoh.unheard(config.vehicle.name)) is not None:
        yield poor("certificate", unheard, ADVICE_NAME)
    if running is not None and is_starting(running):
        yield poor("daemon", *STARTING)
        return
    if running is not None:
        counters = running["counters"]
        if counters.get("recorder_stopped"):
            yield wrong("recorder", "the running daemon cannot record", ADVICE_RECORDER)
        said = f"running (process {running['pid']}), state {running['state']}"
        others = {kind: text for kind, text in told_reasons(running) if not kind.startswith(CAMERA_REASONS)}
        if config.mavlink.enabled and not counters.get("mavlink_received_HEARTBEAT"):
            silent = f"no heartbeat of an autopilot received in {running['uptime_s']:.0f} s"
            others.setdefault(NO_AUTOPILOT, silent)  # without frames the daemon does not miss its attitude
        if NO_AUTOPILOT in others:
            unproven = any(counters.get(f"mavlink_{name}") for name in UNPROVEN)
            deaf = unproven and not counters.get("mavlink_received_HEARTBEAT")
            advice = ADVICE_SIGNING if deaf else ADVICE_AUTOPILOT
            yield wrong("daemon", f"{said}: {'; '.join(others.values())}", advice)
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
    if config.health.prometheus_port is not None:
        yield metrics_finding(config.health.prometheus_port)


def is_starting(running: Mapping[str, Any]) -> bool:
    """Whether a daemon has not judged itself yet: it knows nothing of its camera and links then."""
    return "state" not in running


def told_reasons(running: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Kind and text of the reasons that a daemon reports."""
    return list(zip(running.get("reason_kinds", ()), running.get("reasons", ()), strict=True))


def running_daemon(config: Config) -> Mapping[str, Any] | None:
    """`info`, `config` and `model` of the daemon that listens where this configuration says, whatever its name; None if
    there is none."""
    tls = config.zenoh.tls.files() if config.zenoh.tls is not None else None
    for endpoint in loopback_endpoints(config.zenoh) if config.zenoh.enabled else []:
        try:
            answer = ask(endpoint, ANY, tls)
        except InputError:  # several answer, as at a router
            answer = ask(endpoint, config.vehicle.name, tls)
        if answer is not None:
            return answer
    return None


def config_findings(config: Config, running: Mapping[str, Any]) -> Iterator[Finding]:
    """Whether the running daemon uses other values than the file has now. `running`: its `config`."""
    now, used = no_passwords(config.model_dump(mode="json")), running["config"]
    changed = [
        (section, key)
        for section, values in now.items()
        for key, value in values.items()
        if used.get(section, {}).get(key) != value
    ]
    if changed:
        keys = ", ".join(f"[{section}] {key}" for section, key in changed)
        says = f"the daemon runs as {used['vehicle']['name']}, with other values than the file of {keys}"
        yield poor("config", says, ADVICE_RELOAD if all(changes_in_flight(*key) for key in changed) else ADVICE_RESTART)


def _zenoh(settings: ZenohSettings) -> Iterator[Finding]:
    tls = settings.tls.files() if settings.tls is not None else None
    try:
        zenoh.open(peer_config(settings.listen, [], tls=tls)).close()
        yield good(
            "zenoh", f"can listen on {', '.join(settings.listen)}" if settings.listen else "no address to listen on"
        )
    except zenoh.ZError as error:
        reason = reason_of(error)
        code = re.search(r"\(os error (\d+)\)", reason)
        advice = _advice_to_listen(int(code[1]) if code else None, "[zenoh] listen")
        yield wrong("zenoh", f"cannot listen on {', '.join(settings.listen)}: {reason}", advice)
    for endpoint in settings.connect:
        try:
            zenoh.open(client_config([endpoint], tls=tls)).close()
            yield good("ground", f"{endpoint} answers")
        except zenoh.ZError:
            advice = "start `uavpose-ground router` there; check address, firewall and certificates"
            yield poor("ground", f"{endpoint} does not answer", advice)


def metrics_finding(port: int) -> Finding:
    """Whether the daemon can serve its metrics: without the port it does not start."""
    try:
        socket.create_server(("127.0.0.1", port)).close()
    except OSError as error:
        advice = _advice_to_listen(error.errno, "[health] prometheus_port")
        return wrong("prometheus", f"port {port} of 127.0.0.1 cannot be served: {error.strerror}", advice)
    return good("prometheus", f"port {port} of 127.0.0.1 is free")


def _mavlink(settings: MavlinkSettings) -> Iterator[Finding]:
    """Speak and listen as the daemon does before its first frame, until a heartbeat is received: a router, or an
    autopilot, may send to nobody who has not spoken first."""
    tried, unopenable = list(settings.endpoints), False
    for endpoint in settings.endpoints:
        named = parse_endpoint(endpoint)
        if isinstance(named, SerialEndpoint):
            if (fault := device_fault(Path(named.device), "dialout") or _port_fault(named)) is not None:
                yield wrong("mavlink", *fault)
                tried.remove(endpoint)  # the daemon retries it, and meanwhile flies with the others
            continue
        try:
            resolve(named, socket.SOCK_DGRAM)
        except InputError as error:
            if named.kind in ("udpin", "tcpin"):
                yield wrong("mavlink", str(error), ADVICE_ADDRESS)
                unopenable = True
                continue
            yield poor("host", str(error), f"test it with `getent hosts {named.host}`, or use a numeric address")
    if unopenable or not tried:
        return
    settings = settings.model_copy(update={"endpoints": tried})
    own_ship = OwnShipBuffer()
    camera = CameraInfo("doctor", (640, 480), np.eye(3), None)
    try:
        link = MavlinkLink(settings, own_ship, camera, RequestQueue(), signing_of(settings))
        link.start()
    except InputError as error:
        code = error.__cause__.errno if isinstance(error.__cause__, OSError) else None
        yield wrong("mavlink", str(error), _advice_to_listen(code, "[mavlink] endpoints"))
        return

    def spoken_and_heard() -> dict[str, int]:
        link.set_health(Condition(HealthState.INIT, Activity.WAITING))
        return link.counters()

    try:
        counters = _wait(spoken_and_heard, lambda counted: counted.get("received_HEARTBEAT", 0) > 0)
    finally:
        link.stop()
    where = ", ".join(settings.endpoints)
    if counters.get("received_HEARTBEAT", 0):
        yield good("mavlink", f"{where}: heartbeat received")
        return
    refused = ", ".join(f"{name} {count}" for name, count in counters.items() if name.startswith("refused_") and count)
    counted = f" ({refused})" if refused else ""
    advice = ADVICE_SIGNING if any(counters.get(name) for name in UNPROVEN) else ADVICE_AUTOPILOT
    yield wrong("mavlink", f"{where}: no heartbeat within {HEARING_S:.0f} s{counted}", advice)


def _port_fault(endpoint: SerialEndpoint) -> tuple[str, str] | None:
    """Why a serial port does not open, and what to do; None if it does."""
    try:
        serial.Serial(endpoint.device, endpoint.baud, exclusive=True).close()
    except (OSError, ValueError, termios.error) as error:
        if isinstance(error, OSError) and error.errno in (errno.EAGAIN, errno.EBUSY):
            advice = f"stop the program that uses it (`sudo fuser -v {shlex.quote(endpoint.device)}` shows which)"
            return f"{endpoint.device} is used by another program", advice
        return f"{endpoint.text} does not open: {error}", "choose a serial port, and a speed that it supports"
    return None


def _advice_to_listen(code: int | None, key: str) -> str:
    """What to do where an endpoint of our own does not open; `code`: the system's error, if it is known."""
    match code:
        case errno.EADDRINUSE:
            return f"stop the program that uses it (`sudo ss -ltunp` shows which), or change {key}"
        case errno.EADDRNOTAVAIL:
            return ADVICE_ADDRESS
        case errno.EACCES:
            return f"choose a port above 1023 in {key}"
    return f"change {key}"


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
