"""`uavpose-edge status`: query the running daemon over zenoh on loopback and print its answer."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import zenoh

from edge.config import load_config
from edge.config_ground import ZenohSettings
from edge.errors import InputError
from edge.health import HealthState
from edge.status_board import key_of
from msgs.command_line import say_out
from msgs.session import TlsFiles, check_endpoint, client_config

ANSWER_S = 5.0
STALE_S = 3.0
EXIT_NOT_WELL = 1
ANY = "*"
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")


def status(config: Path | None, connect: str | None, vehicle: str | None, as_json: bool) -> int:
    """Print the daemon's status; returns 0 if it works, 1 if it does not answer, waits for its first frame, is stuck or
    in FAULT.

    Raises InputError for an invalid address or name, or a configuration with zenoh disabled.
    """
    endpoint, uav, tls = _address(config, connect, vehicle)
    answer = ask(endpoint, uav, tls)
    if answer is None:
        sentence = _unanswered(endpoint, uav, tls)
        say_out(json.dumps({"error": sentence}) if as_json else sentence)
        return EXIT_NOT_WELL
    say_out(json.dumps(answer) if as_json else for_a_person(answer))
    return 0 if works(answer["info"]) else EXIT_NOT_WELL


def ask(endpoint: str, uav: str, tls: TlsFiles | None = None) -> dict[str, Any] | None:
    """`info`, `config` and `model` of the daemon that listens at `endpoint`; None if none answers.

    Raises InputError if several answer, as at a router on the ground, and `uav` is `*`.
    """
    try:
        with zenoh.open(client_config([endpoint], tls=tls)) as session:
            vehicles = _vehicles(session, uav)
            if len(vehicles) > 1:
                raise InputError(f"{' and '.join(sorted(vehicles))} answer at {endpoint}: select one with --vehicle")
            # Of this vehicle only: the first answer to `*` may be another's.
            answers = {
                what: next(_answers(session, name, what), None) for name in vehicles for what in ("config", "model")
            }
    except (zenoh.ZError, ValueError):
        return None
    if not answers or None in answers.values():
        return None
    return {"info": next(iter(vehicles.values())), **answers}


def works(info: dict[str, Any]) -> bool:
    """Whether the daemon's loop is running and produces output."""
    return (
        info.get("state") not in (None, HealthState.INIT.value, HealthState.FAULT.value)
        and info.get("age_s", 0.0) < STALE_S
    )


def for_a_person(answer: dict[str, Any]) -> str:
    info, model = answer["info"], answer["model"]
    reasons = f": {'; '.join(info['reasons'])}" if info.get("reasons") else ""
    contract, fallback = model["contract"], model["fallback_reason"]
    lines = [
        f"{info['vehicle']}  {_headline(info)}{reasons}",
        f"  up        {info['uptime_s']:.0f} s, process {info['pid']}, version {info['version']}",
        f"  camera    {info['camera']}",
        f"  model     {contract['name']} {contract['precision']} {model['sha256'][:12]} on {model['provider']}"
        + (f" ({fallback})" if fallback else ""),
        f"  config    {answer['config']['file']}",
    ]
    if "state" not in info:
        return "\n".join(lines)
    stale = f"; {info['age_s']:.0f} s OLD: the main loop has stalled" if info["age_s"] >= STALE_S else ""
    lines += [f"  targets   {info['tracks']}", f"  frames    {info['frame_rate_hz']:.1f} a second{stale}", ""]
    lines.append(f"  {'stage':12} {'p50 ms':>8} {'p95 ms':>8} {'p99 ms':>8}")
    lines += [
        f"  {stage:12} {p['p50']:8.2f} {p['p95']:8.2f} {p['p99']:8.2f}" for stage, p in info["latency_ms"].items()
    ]
    lines += ["", *(f"  {name:40} {count:>12}" for name, count in info["counters"].items() if count)]
    return "\n".join(lines)


def _headline(info: dict[str, Any]) -> str:
    """The state, with the activity if the state does not imply it."""
    state = info.get("state", "starting")
    return f"{state}, {info['activity']}" if state == HealthState.DEGRADED.value else state


def _unanswered(endpoint: str, uav: str, tls: TlsFiles | None) -> str:
    """Why nothing was answered, as a sentence."""
    if uav != ANY:
        with suppress(zenoh.ZError), zenoh.open(client_config([endpoint], tls=tls)) as session:
            if others := sorted(_vehicles(session, ANY)):
                return (
                    f"{' and '.join(others)} and not {uav} answers at {endpoint}: "
                    "a daemon takes a new [vehicle] name when it is restarted"
                )
    return f"no daemon answers at {endpoint}: it is not running, or its [zenoh] listen is elsewhere"


def _vehicles(session: zenoh.Session, uav: str) -> dict[str, dict[str, Any]]:
    """`info` of each vehicle that answers, by name."""
    return {str(info.get("vehicle")): info for info in _answers(session, uav, "info")}


def _answers(session: zenoh.Session, uav: str, what: str) -> Iterator[dict[str, Any]]:
    for reply in session.get(key_of(uav, what), timeout=ANSWER_S):
        if reply.ok is None:
            continue
        try:
            tree = json.loads(reply.ok.payload.to_bytes())
        except ValueError:
            continue
        if isinstance(tree, dict):
            yield tree


def _address(config: Path | None, connect: str | None, vehicle: str | None) -> tuple[str, str, TlsFiles | None]:
    """Endpoint, vehicle (`*`: any) and certificates for the query."""
    settings, uav, tls = ZenohSettings(), vehicle or ANY, None
    if config is not None:
        loaded = load_config(config).config
        settings, uav = loaded.zenoh, vehicle or loaded.vehicle.name
        tls = settings.tls.files() if settings.tls is not None else None
        if not settings.enabled:
            raise InputError(f"{config}: [zenoh] enabled is false: the daemon cannot be queried; see its log")
    try:
        key_of(uav, "info")
        if connect is not None:
            return check_endpoint(connect, tls=tls is not None), uav, tls
    except ValueError as error:
        raise InputError(str(error)) from error
    here = loopback_endpoints(settings)
    if not here:
        raise InputError(f"{config}: [zenoh] listen has no loopback address to query; use --connect")
    return here[0], uav, tls


def loopback_endpoints(settings: ZenohSettings) -> list[str]:
    """Loopback endpoints of a daemon with these settings; one that listens on all addresses is reached there too."""
    own = [point.replace("/0.0.0.0:", "/127.0.0.1:").replace("/[::]:", "/[::1]:") for point in settings.listen]
    return [endpoint for endpoint in own if any(f"/{host}:" in endpoint for host in LOOPBACK)]
