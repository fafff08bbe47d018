"""Typed client for receiving poses in your own program. Needs zenoh, numpy and xxhash, nothing else.

from msgs.client import connect, subscribe

with connect("tcp/127.0.0.1:7447") as session, subscribe(session, "uav1") as poses:
    for target in poses:
        x, y, z = target.pose.t_cam_target_m
        print(f"{target.target}: {z:.1f} m ahead, {target.age_s * 1e3:.0f} ms old")
"""

from __future__ import annotations

import atexit
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from typing import Generic, TypeVar

import zenoh
from zenoh import ext, handlers

from msgs import topics
from msgs.receive import PoseReceiver, TargetDirection, TargetPose
from msgs.session import SECURE, TlsFiles, check_endpoint, client_config, reason_of
from msgs.topics import Topic
from msgs.wire import Refusal

Received = TypeVar("Received")
Receive = Callable[[str, bytes, bytes, int, str], Received | None]  # as PoseReceiver.receive
Subscriber = zenoh.Subscriber | ext.AdvancedSubscriber

FAILURES_MAX = 64  # distinct exception messages that are counted separately
_opened: list[zenoh.Session] = []  # by `connect`, and not known to be closed
_opened_lock = threading.Lock()


def connect(endpoint: str, *, tls: TlsFiles | None = None) -> zenoh.Session:
    """Open a session with a router or daemon, e.g. `tcp/127.0.0.1:7447`; close it, or use it as a context. One that is
    still open when the program ends is closed then.

    Raises ConnectionError if the endpoint is malformed, the certificates are unusable or nothing answers there:
    immediately if the host is reachable, after about four seconds if it is not, after ten over `quic/`.
    """
    try:
        check_endpoint(endpoint, tls=tls is not None)
        if tls is not None:
            tls.check()
    except ValueError as error:
        raise ConnectionError(str(error)) from error
    try:
        session = zenoh.open(client_config([endpoint], tls=tls))
    except zenoh.ZError as error:
        told = f"no zenoh session with {endpoint}: {reason_of(error)}. Is a router or daemon there?"
        if tls is not None and endpoint.startswith(SECURE):
            told += f" Or one end refuses the other's certificate: {tls.doubt() or 'do names, dates, authority fit?'}"
        raise ConnectionError(told) from None
    with _opened_lock:
        _opened[:] = [*(one for one in _opened if not one.is_closed()), session]
    return session


@atexit.register
def _close_sessions() -> None:
    # A callback on zenoh's thread that outlives the interpreter aborts the process; closing waits for it.
    for session in _opened:
        with suppress(zenoh.ZError):
            session.close()


class Subscription(Generic[Received]):
    """Iterates over validated poses or directions; a slow reader loses the oldest. Ends when it or the session is
    closed."""

    def __init__(self, subscriber: zenoh.Subscriber, receiver: PoseReceiver, receive: Receive[Received]) -> None:
        self._subscriber = subscriber
        self._receiver = receiver
        self._receive = receive
        self._closed = False

    @property
    def accepted(self) -> int:
        """Number of samples accepted."""
        return self._receiver.accepted

    @property
    def refused(self) -> Counter[Refusal]:
        """Samples refused, by reason."""
        return self._receiver.refused

    def __iter__(self) -> Iterator[Received]:
        if self._closed:
            return
        for sample in self._subscriber:
            one = _received(self._receive, sample)
            if one is not None:
                yield one

    def poll(self) -> Received | None:
        """The oldest buffered one, without blocking; None if there is none, or this or the session is closed."""
        while not self._closed:
            try:
                sample = self._subscriber.try_recv()
            except zenoh.ZError:
                self._closed = True
                break
            if sample is None:
                break
            if (one := _received(self._receive, sample)) is not None:
                return one
        return None

    def close(self) -> None:
        """May be called more than once, and after the session was closed."""
        self._closed = True
        with suppress(zenoh.ZError):
            self._subscriber.undeclare()

    def __enter__(self) -> Subscription[Received]:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def subscribe(
    session: zenoh.Session,
    uav: str,
    *,
    target: str | None = None,
    domain: int = 0,
    max_age_s: float = 1.0,
    depth: int = 8,
) -> Subscription[TargetPose]:
    """Subscribe to the poses of all targets of a UAV, or of one (`t0`, …); at most `depth` poses are buffered, the
    oldest are dropped.

    Raises ValueError for an invalid name.
    """
    key = topics.subscription_key(topics.POSE, uav, target, domain=domain)
    receiver = PoseReceiver(uav, domain=domain, max_age_s=max_age_s)
    return Subscription(session.declare_subscriber(key, handlers.RingChannel(depth)), receiver, receiver.receive)


def subscribe_directions(
    session: zenoh.Session,
    uav: str,
    *,
    target: str | None = None,
    domain: int = 0,
    max_age_s: float = 1.0,
    depth: int = 8,
) -> Subscription[TargetDirection]:
    """Subscribe to the directions of targets whose range is not known, of which no pose is sent; as `subscribe`."""
    key = topics.subscription_key(topics.DIRECTION, uav, target, domain=domain)
    receiver = PoseReceiver(uav, domain=domain, max_age_s=max_age_s)
    subscriber = session.declare_subscriber(key, handlers.RingChannel(depth))
    return Subscription(subscriber, receiver, receiver.receive_direction)


class TopicCounts:
    """Counts the samples of every topic of one UAV, validates its poses and directions; made by `subscribe_all`."""

    def __init__(
        self,
        uav: str,
        domain: int,
        max_age_s: float,
        on_pose: Callable[[TargetPose], None],
        on_direction: Callable[[TargetDirection], None],
    ) -> None:
        self._uav = uav
        self._domain = domain
        self._on_pose = on_pose
        self._on_direction = on_direction
        self._receiver = PoseReceiver(uav, domain=domain, max_age_s=max_age_s)
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._failures: Counter[str] = Counter()
        self._subscribers: list[Subscriber] = []

    def counts(self) -> dict[str, int]:
        """Samples received by topic, e.g. `uav1/target/t0/pose`; refused ones are counted too."""
        with self._lock:
            return dict(self._counts)

    def refused(self) -> dict[Refusal, int]:
        """Poses and directions refused, by reason."""
        with self._lock:
            return dict(self._receiver.refused)

    def failures(self) -> dict[str, int]:
        """Number of exceptions raised by the callbacks, which interrupt nothing: by message, or by type alone once
        there are FAILURES_MAX different messages."""
        with self._lock:
            return dict(self._failures)

    def close(self) -> None:
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers.clear()

    def __enter__(self) -> TopicCounts:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        row = topics.parse_key(str(sample.key_expr), self._uav, domain=self._domain)
        with self._lock:
            if row is None:
                return
            topic, target = row
            self._counts[topics.topic_name(topic, self._uav, target)] += 1
            tell = self._accepted(topic, sample)
        if tell is None:
            return
        # zenoh would only print an exception.
        try:
            tell()
        except Exception as error:
            with self._lock:
                text = f"{type(error).__name__}: {error}"
                crowded = len(self._failures) >= FAILURES_MAX and text not in self._failures
                self._failures[type(error).__name__ if crowded else text] += 1

    def _accepted(self, topic: Topic, sample: zenoh.Sample) -> Callable[[], None] | None:
        """What passes an accepted pose or direction on; None for a refused one and for other topics."""
        if topic is topics.POSE and (pose := _received(self._receiver.receive, sample)) is not None:
            return partial(self._on_pose, pose)
        if topic is topics.DIRECTION and (seen := _received(self._receiver.receive_direction, sample)) is not None:
            return partial(self._on_direction, seen)
        return None

    def _declare(self, session: zenoh.Session) -> None:
        # An indirect callback would run in a Python thread that keeps the process alive while the session is open.
        handler = handlers.Callback(self._on_sample, indirect=False)
        for topic in topics.TOPICS:
            if topic is not topics.IMAGE:
                key = topics.subscription_key(topic, self._uav, domain=self._domain)
                self._subscribers.append(declare(session, topic, key, handler))


def subscribe_all(
    session: zenoh.Session,
    uav: str,
    on_pose: Callable[[TargetPose], None] = lambda _: None,
    on_direction: Callable[[TargetDirection], None] = lambda _: None,
    *,
    domain: int = 0,
    max_age_s: float = 1.0,
) -> TopicCounts:
    """Subscribe to every topic of one UAV except images, which the daemon encodes only while somebody subscribes;
    cached topics deliver their history first.

    `on_pose` is called with each validated pose, `on_direction` with each validated direction, on zenoh's receiving
    thread; both must return quickly. Close the result, or use it as a context.
    """
    counts = TopicCounts(uav, domain, max_age_s, on_pose, on_direction)
    counts._declare(session)
    return counts


def declare(session: zenoh.Session, topic: Topic, key: str, handler: handlers.Callback) -> Subscriber:
    """A zenoh subscriber to `key`; if the topic is cached, it gets the history first, and what was lost again."""
    if not topic.cache:
        return session.declare_subscriber(key, handler)
    history = ext.HistoryConfig(detect_late_publishers=True, max_samples=topic.cache)
    recovery = ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
    return ext.declare_advanced_subscriber(session, key, handler, history=history, recovery=recovery)


def _received(receive: Receive[Received], sample: zenoh.Sample) -> Received | None:
    attachment = b"" if sample.attachment is None else sample.attachment.to_bytes()
    return receive(str(sample.key_expr), sample.payload.to_bytes(), attachment, time.time_ns(), sender_of(sample))


def sender_of(sample: zenoh.Sample) -> str:
    """Id of the zenoh session that sent a sample, taken from its timestamp; empty if it has none. A router whose clock
    is more than half a second behind the sender's sets a timestamp, and hence an id, of its own."""
    return "" if sample.timestamp is None else str(sample.timestamp.get_id())
