"""Receives everything the vehicles send over one session: samples of all topics, and liveliness."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue

import zenoh
from zenoh import handlers

from msgs import topics
from msgs.client import connect, declare, sender_of
from msgs.ground.errors import InputError
from msgs.session import CALLING, SECURE, TlsFiles, check_endpoint
from msgs.topics import Topic

RETRY_S = 0.5
LOOK_EVERY_S = 0.1
ALIVE = "uavpose/@v1/*/alive"


@dataclass(frozen=True)
class Incoming:
    """One received sample, not validated."""

    uav: str
    topic: Topic
    target: str | None
    key: str
    payload: bytes
    attachment: bytes
    sender: str = ""  # id of the sending zenoh session; empty: unknown


OnSample = Callable[[Incoming], None]
OnAlive = Callable[[str, bool], None]


@contextmanager
def session(
    endpoint: str, tls: TlsFiles | None, stop: threading.Event, say: Callable[[str], None]
) -> Iterator[zenoh.Session | None]:
    """A session with a router or daemon; retries until `stop` is set (then None). Raises InputError for an invalid
    endpoint or unusable certificates."""
    try:
        check_endpoint(endpoint, tls=tls is not None)
        if tls is not None:
            tls.check()
    except ValueError as error:
        raise InputError(str(error)) from error
    if tls is not None and (doubt := tls.doubt()) is not None:
        say(f"the link may fail: {doubt}")
    waiting = False
    while not stop.is_set():
        opened = _connected(endpoint, tls, stop)
        if opened is not None:
            with opened:
                yield opened
            return
        if not waiting and not stop.is_set():
            # zenoh does not report why there is no link.
            why = ": not running, or one end refuses the other's certificate" if endpoint.startswith(SECURE) else ""
            say(f"waiting for {endpoint}{why}")
            waiting = True
        stop.wait(RETRY_S)
    yield None


def _connected(endpoint: str, tls: TlsFiles | None, stop: threading.Event) -> zenoh.Session | None:
    """A session; None if nothing answers or `stop` is set. In a thread: opening blocks, over QUIC for ten seconds."""
    answer: SimpleQueue[zenoh.Session | None] = SimpleQueue()

    def call() -> None:
        opened: zenoh.Session | None = None
        with suppress(ConnectionError):
            opened = connect(endpoint, tls=tls)
        if opened is not None and stop.is_set():
            opened.close()
        else:
            answer.put(opened)

    threading.Thread(target=call, name=CALLING, daemon=True).start()
    while not stop.is_set():
        with suppress(Empty):
            return answer.get(timeout=LOOK_EVERY_S)
    return None


def linked(opened: zenoh.Session) -> bool:
    """Whether the session is currently connected; zenoh keeps reconnecting while it is not."""
    return bool(opened.info.routers_zid() or opened.info.peers_zid())


def alive_uav(key: str) -> str | None:
    """Vehicle of a liveliness token that matches `ALIVE`; None if its name is invalid."""
    try:
        return topics.check_uav_name(key.split("/")[2])
    except ValueError:
        return None


@contextmanager
def listening(
    opened: zenoh.Session,
    uavs: Sequence[str],
    domain: int,
    on_sample: OnSample,
    on_alive: OnAlive,
    wanted: Sequence[Topic] = topics.TOPICS,
) -> Iterator[None]:
    """Call `on_sample` and `on_alive` for these vehicles, all if none is named, on zenoh's receiving threads.

    Cached topics (intrinsics, events) deliver their history. Topics not in `wanted` are not sent by the vehicle.
    """

    def sample(one: zenoh.Sample) -> None:
        key = str(one.key_expr)
        row = topics.parse_any_key(key, domain=domain)
        if row is not None:
            attachment = b"" if one.attachment is None else one.attachment.to_bytes()
            on_sample(Incoming(*row, key, one.payload.to_bytes(), attachment, sender_of(one)))

    def alive(one: zenoh.Sample) -> None:
        uav = alive_uav(str(one.key_expr))
        if uav is not None and (not uavs or uav in uavs):
            on_alive(uav, one.kind == zenoh.SampleKind.PUT)

    # An indirect callback would run in a Python thread that keeps the process alive while the session is open.
    handler = handlers.Callback(sample, indirect=False)
    declared = [
        declare(opened, topic, topics.subscription_key(topic, uav, domain=domain), handler)
        for uav in dict.fromkeys(uavs or ("*",))
        for topic in wanted
    ]
    tokens = opened.liveliness().declare_subscriber(ALIVE, handlers.Callback(alive, indirect=False), history=True)
    try:
        yield
    finally:
        tokens.undeclare()
        for subscriber in declared:
            subscriber.undeclare()
