"""The ground's tools while there is no link."""

from __future__ import annotations

import socket
import threading

import pytest

from msgs.ground.feed import session

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
