"""The ground's tools while there is no link."""

from __future__ import annotations

import socket
import subprocess
import sys
import threading

import pytest

from msgs import topics
from msgs.client import connect
from msgs.ground.feed import Incoming, listening, session
from msgs.publish import Node
from tests.waiting import until

from ..conftest import Network, pose_now
from .conftest import Ground


def test_who_calls_a_router_that_says_nothing_can_break_off() -> None:
    stop, none = threading.Event(), list[bool]()

    def call(endpoint: str) -> None:
        with session(endpoint, None, stop, lambda _: None) as opened:
            none.append(opened is None)

    with socket.create_server(("127.0.0.1", 0)) as mute:
        calling = threading.Thread(target=call, args=(f"tcp/127.0.0.1:{mute.getsockname()[1]}",))
        calling.start()
        heard, _ = mute.accept()
        with heard:
            assert heard.recv(4096), "it speaks first"
            stop.set()
            calling.join(60.0)
            heard.setblocking(False)
            with pytest.raises(BlockingIOError):  # the call still waits for its answer
                heard.recv(4096)
    assert none == [True]


HANGS_UP_AT_THE_VERY_END = """
import os, signal, socket, sys, threading, time
from msgs.ground.cli import main

class Mute:
    def __init__(self):
        self.listening, self.sleep = socket.create_server(("127.0.0.1", 0)), time.sleep
        self.endpoint = f"tcp/127.0.0.1:{self.listening.getsockname()[1]}"

    def interrupt(self):
        self.heard, _ = self.listening.accept()
        self.heard.recv(4096)
        os.kill(os.getpid(), signal.SIGINT)

    def __del__(self):  # while the interpreter is taken down
        self.heard.close()
        self.sleep(1.0)

mute = Mute()
threading.Thread(target=mute.interrupt, daemon=True).start()
sys.exit(main([*sys.argv[1:], "-e", mute.endpoint]))
"""


@pytest.mark.parametrize(("words", "code"), [(["watch"], 0), (["command", "uav1", "stop"], 1)])
def test_a_call_that_was_broken_off_and_ends_with_the_process_does_not_abort_it(words: list[str], code: int) -> None:
    asked = [sys.executable, "-c", HANGS_UP_AT_THE_VERY_END, *words]
    done = subprocess.run(asked, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (code, "")


def test_where_certificates_may_be_at_fault_who_waits_is_told_so(ground: Ground) -> None:
    for endpoint, tls, certificates in (
        (ground.secure, ground.keys["stranger"], True),
        ("tcp/127.0.0.1:1", None, False),
    ):
        stop, said = threading.Event(), list[str]()

        def say(line: str, stop: threading.Event = stop, said: list[str] = said) -> None:
            said.append(line)
            if line.startswith("waiting"):
                stop.set()

        with session(endpoint, tls, stop, say) as opened:
            assert opened is None
        assert said[-1].startswith(f"waiting for {endpoint}")
        assert ("refuses the other's certificate" in said[-1]) == certificates


def test_a_vehicle_that_is_named_twice_is_heard_once(network: Network) -> None:
    came = list[int]()

    def take(one: Incoming) -> None:
        attachment = topics.parse_attachment(one.attachment)
        assert attachment is not None
        came.append(attachment[0])

    with (
        connect(network.endpoint) as opened,
        listening(opened, ["uav1", "uav1"], 0, take, lambda *_: None, [topics.POSE]),
        Node(network.daemon, "uav1") as node,
    ):
        publisher = node.publisher(topics.POSE, "t0")
        until(lambda: len(came) >= 5, lambda: publisher.put(pose_now().encode()))
    assert came == list(range(came[0], came[0] + len(came)))
