"""`uavpose-ground command` where the vehicle takes a command and does not answer."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import zenoh
from zenoh import handlers

from msgs.client import connect
from msgs.ground.command import RELOAD_ANSWER_S, ask, body
from msgs.ground.errors import InputError
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
