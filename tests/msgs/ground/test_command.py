"""`uavpose-ground command` where the vehicle takes a command and does not answer."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest
import zenoh
from zenoh import handlers

from msgs.client import connect
from msgs.ground.command import NOBODY_S, RELOAD_ANSWER_S, ask, body
from msgs.ground.errors import InputError
from msgs.session import peer_config
from tests.waiting import until

from ..conftest import Network


@pytest.fixture
def held(network: Network) -> Iterator[list[zenoh.Query]]:
    """The commands that uav1 took, and answers none of."""
    queries: list[zenoh.Query] = []
    handler = handlers.Callback(queries.append, indirect=False)
    with network.daemon.declare_queryable("uavpose/@v1/uav1/cmd/*", handler):
        yield queries


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_who_waits_for_an_answer_can_break_off(
    network: Network, held: list[zenoh.Query], number: signal.Signals
) -> None:
    command = [sys.executable, "-m", "msgs.ground.cli", "command", "uav1", "reload", "-e", network.endpoint]
    asking = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    until(lambda: held, what="the command")
    asking.send_signal(number)
    said, _ = asking.communicate(timeout=0.8 * RELOAD_ANSWER_S)
    answer = json.loads(said)
    assert asking.returncode == 1
    assert (answer["ok"], answer["command"]) == (False, "reload")
    assert "it may have done it" in answer["error"]


def test_a_command_without_an_answer_in_time_may_have_been_done(network: Network, held: list[zenoh.Query]) -> None:
    with connect(network.endpoint) as session:
        said = dict[str, Any]()
        until(lambda: held, lambda: said.update(ask(session, "uav1", "stop", {}, timeout_s=0.5)), what="the command")
    assert said["error"].startswith("uav1 does not answer within ")
    assert "it may have done it" in said["error"]


def test_a_command_whose_vehicle_loses_its_link_may_have_been_done(network: Network, held: list[zenoh.Query]) -> None:
    """zenoh ends the query with the link, as it does where nobody is there."""
    with connect(network.endpoint) as session, ThreadPoolExecutor(1) as elsewhere:
        asking = elsewhere.submit(ask, session, "uav1", "reload", {}, timeout_s=RELOAD_ANSWER_S)
        until(lambda: held, what="the command")
        began_s = time.monotonic()
        until(lambda: time.monotonic() - began_s >= NOBODY_S, what="that it is not as if nobody were there")
        network.daemon.close()
        lost, nobody = asking.result(), ask(session, "uav1", "reload", {})
    assert "it may have done it" in lost["error"]
    assert nobody["error"].startswith("uav1 does not answer: not there, or ")


def test_of_two_vehicles_of_one_name_both_answers_are_told(network: Network) -> None:
    """Each has carried it out: whoever meant one of them must know."""

    def answers(said: dict[str, Any]) -> handlers.Callback:
        def reply(query: zenoh.Query) -> None:
            with query:
                query.reply(str(query.key_expr), json.dumps(said))

        return handlers.Callback(reply, indirect=False)

    key = "uavpose/@v1/uav1/cmd/*"
    done = {"ok": True, "command": "rate", "done": {"max_hz": 10.0}}
    refused = {"ok": False, "command": "rate", "error": "too many requests wait"}
    with (
        zenoh.open(peer_config([], [network.endpoint])) as second,
        connect(network.endpoint) as session,
        network.daemon.declare_queryable(key, answers(done)),
    ):
        said, held = list[dict[str, Any]](), list[zenoh.Query]()

        def asked() -> None:
            said.append(ask(session, "uav1", "rate", {}, timeout_s=2.0))

        until(lambda: bool(said) and said[-1]["ok"], asked, what="the only answer")
        assert said[-1] == done
        with second.declare_queryable(key, answers(refused)):
            until(lambda: not said[-1]["ok"], asked, what="both answers")
            both = said[-1]["error"]
        with second.declare_queryable(key, handlers.Callback(held.append, indirect=False)):
            until(lambda: bool(held), asked, what="one answer, and a vehicle that says nothing")
    assert both.startswith("2 of the vehicles named uav1 answered: ")
    assert '{"max_hz": 10.0}' in both
    assert "too many requests wait" in both
    assert said[-1]["ok"] is False
    assert said[-1]["error"].startswith("1 of the vehicles named uav1 answered: ")
    assert "it may have done it" in said[-1]["error"]


def test_what_was_done_is_told_also_where_it_cannot_be_written(network: Network) -> None:
    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(str(query.key_expr), '{"ok": true, "command": "stop", "done": {}}')

    words = [sys.executable, "-m", "msgs.ground.cli", "command", "-e", network.endpoint, "uav1", "stop"]
    handler = handlers.Callback(reply, indirect=False)
    with network.daemon.declare_queryable("uavpose/@v1/uav1/cmd/*", handler), open("/dev/full", "w") as full:
        told = subprocess.run(words, stdout=full, stderr=subprocess.PIPE, text=True)
    assert told.stderr == (
        "standard output: cannot be written: No space left on device; "
        'the answer is {"ok": true, "command": "stop", "done": {}}\n'
    )
    assert told.returncode == 0


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("select 3", "select: 3: a target is named t0, t1, …"),
        ("rate fast", "rate: fast: HZ must be a number from 0.1 to 240, or all"),
        ("rate 0", "rate: 0: HZ must be a number from 0.1 to 240, or all"),
        ("rate nan", "rate: nan: HZ must be a number from 0.1 to 240, or all"),
        ("track 0.6 0.4 0.4 0.6", "track: 0.6 0.4 0.4 0.6: LEFT TOP RIGHT BOTTOM must be shares of the picture"),
        ("track 0.4 0.4 0.6 60", "from 0 to 1, with left < right and top < bottom"),
        ("track left 0.4 0.6 0.6", "track: left 0.4 0.6 0.6: LEFT TOP RIGHT BOTTOM must be shares"),
    ],
)
def test_a_command_that_makes_no_sense_is_told_with_what_would(words: str, said: str) -> None:
    with pytest.raises(InputError) as told:
        body(*words.split()[:1], words.split()[1:])
    assert said in str(told.value)
