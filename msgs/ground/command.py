"""`uavpose-ground command`: commands one vehicle (track, stop, reload, record, limit the rate); prints its answer."""

from __future__ import annotations

import json
import re
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import zenoh

from msgs.command_line import OutputError, output
from msgs.ground.errors import InputError
from msgs.ground.feed import session
from msgs.session import TlsFiles

ANSWER_S = 5.0
RELOAD_ANSWER_S = 60.0  # the model is loaded and warmed up before the answer
LINK_S = 10.0
LOOK_EVERY_S = 0.02
TIME_OVER = 0.9  # share of the time to answer
NOBODY_S = 0.5  # a query that no vehicle receives ends sooner
EXIT_REFUSED = 1
RATE_MIN_HZ, RATE_MAX_HZ = 0.1, 240.0  # the vehicle refuses others


def body(name: str, words: Sequence[str]) -> dict[str, Any]:
    """A command's JSON object from its arguments: `track LEFT TOP RIGHT BOTTOM`, `select TARGET`, `stop`, `reload`,
    `record on|off`, `rate HZ|all`.

    Raises InputError.
    """
    match name, *words:
        case ["track", _, _, _, _]:
            return {"box": _box(words)}
        case ["select", target]:
            if not re.fullmatch(r"t[0-9]{1,3}", target):
                raise InputError(f"select: {target}: a target is named t0, t1, …")
            return {"target": target}
        case ["stop" | "reload"]:
            return {}
        case ["record", ("on" | "off") as state]:
            return {"on": state == "on"}
        case ["rate", "all"]:
            return {"max_hz": None}
        case ["rate", rate]:
            return {"max_hz": _rate_hz(rate)}
    raise InputError("a command is one of: track LEFT TOP RIGHT BOTTOM (shares of the picture, 0 to 1); "
                     "select TARGET; stop; reload; record on|off; rate HZ|all")  # fmt: skip


def _box(words: Sequence[str]) -> list[float]:
    """left, top, right, bottom"""
    with suppress(ValueError):
        left, top, right, bottom = (float(word) for word in words)
        if 0.0 <= left < right <= 1.0 and 0.0 <= top < bottom <= 1.0:
            return [left, top, right, bottom]
    raise InputError(
        f"track: {' '.join(words)}: LEFT TOP RIGHT BOTTOM must be shares of the picture from 0 to 1, with left < right "
        "and top < bottom"
    )


def _rate_hz(word: str) -> float:
    with suppress(ValueError):
        if RATE_MIN_HZ <= (rate_hz := float(word)) <= RATE_MAX_HZ:
            return rate_hz
    raise InputError(f"rate: {word}: HZ must be a number from {RATE_MIN_HZ:g} to {RATE_MAX_HZ:g}, or all")


def ask(
    opened: zenoh.Session,
    uav: str,
    name: str,
    asked: dict[str, Any],
    timeout_s: float = ANSWER_S,
    stop: threading.Event | None = None,
) -> dict[str, Any]:
    """Send a command and wait until every vehicle of that name has answered, or `stop` is set; `ok` is false, with an
    `error`, if the vehicle refuses or does not answer, or if more than one answers."""
    stop = stop or threading.Event()
    key, why = f"uavpose/@v1/{uav}/cmd/{name}", f"{uav} does not answer: not there, or not for you to command"
    replies = opened.get(
        key,
        payload=json.dumps(asked),
        encoding=zenoh.Encoding.APPLICATION_JSON,
        timeout=timeout_s,
        # Of answers of one key, zenoh would otherwise pass on the last one only.
        consolidation=zenoh.ConsolidationMode.NONE,
    )
    answers, silent, began_s = list[dict[str, Any]](), False, time.monotonic()
    # Polling, because a blocking wait inside zenoh cannot be interrupted by signals.
    while True:
        try:
            reply = replies.try_recv()
        except zenoh.ZError:  # no further replies
            passed_s = time.monotonic() - began_s
            # When the time is over, a router may end the query before zenoh tells of it here.
            silent = silent or passed_s >= TIME_OVER * timeout_s
            if passed_s >= NOBODY_S:
                why = f"{uav} does not answer: not there, or its link was lost, and it may have done it"
            break
        if reply is not None:
            answer = _answer(reply)
            if answer is not None:
                answers.append(answer)
            else:
                silent = True
        elif stop.wait(LOOK_EVERY_S):
            why = f"broken off before {uav} answered: it may have done it"
            break
    if len(answers) == 1 and not silent:
        return answers[0]
    late = f"within {timeout_s:.0f} s: it may have done it"
    if answers:
        said = "; ".join(json.dumps(one.get("done") if one["ok"] is True else one.get("error")) for one in answers)
        why = f"{len(answers)} of the vehicles named {uav} answered: {said}" + f"; another did not {late}" * silent
    elif silent:
        why = f"{uav} does not answer {late}, or it is not for you to command"
    return {"ok": False, "command": name, "error": why}


def _answer(reply: zenoh.Reply) -> dict[str, Any] | None:
    """The vehicle's answer; None for replies by zenoh itself, such as a timeout."""
    said = reply.ok if reply.ok is not None else reply.err
    try:
        answer = json.loads(said.payload.to_bytes()) if said is not None else None
    except ValueError:
        return None
    return answer if isinstance(answer, dict) and "ok" in answer else None


def command(
    endpoint: str,
    tls: TlsFiles | None,
    uav: str,
    name: str,
    words: Sequence[str],
    stop: threading.Event,
    say: Callable[[str], None],
) -> int:
    """Send one command and print the answer as JSON, with `say` if standard output cannot be written; returns 0, or 1
    if it was refused, not answered, or `stop` was set first. Raises InputError for an invalid command."""
    asked = body(name, words)
    giving_up = threading.Timer(LINK_S, stop.set)
    giving_up.daemon = True
    giving_up.start()
    with session(endpoint, tls, stop, say) as opened:
        giving_up.cancel()
        answer = {"ok": False, "command": name, "error": f"no link to {endpoint}"}
        if opened is not None:
            answer = ask(opened, uav, name, asked, RELOAD_ANSWER_S if name == "reload" else ANSWER_S, stop)
    try:
        with output():
            print(json.dumps(answer), flush=True)
    except OutputError as error:  # whoever repeats the command should know whether it was carried out
        say(f"{error}; the answer is {json.dumps(answer)}")
    return 0 if answer["ok"] is True else EXIT_REFUSED
