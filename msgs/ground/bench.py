"""`uavpose-ground bench`: how long a pose takes to encode and to decode with all its checks, beside rosbags."""

from __future__ import annotations

import json
import time
import timeit
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.util import find_spec

import numpy as np

from msgs import topics
from msgs.cdr import PoseWithCovarianceStamped
from msgs.receive import PoseReceiver

_STAMP_NS = 1_700_000_000_123_456_789
_ROUNDS = 7


@dataclass(frozen=True)
class Timing:
    """Microseconds of processor time a call, the best of several rounds."""

    what: str
    ours_us: float
    rosbags_us: float | None  # None where rosbags is not installed or has no such thing

    @property
    def ratio(self) -> float | None:
        return None if self.rosbags_us is None else self.rosbags_us / self.ours_us


def bench(calls: int) -> list[Timing]:
    """Time `calls` calls a round. rosbags checks nothing on decoding; ours refuses what is no pose."""
    root = np.random.default_rng(0).normal(size=(6, 6))
    t_m, q = np.array([10.0, -4.0, 260.0]), np.array([0.5, -0.5, 0.5, 0.5])
    message = PoseWithCovarianceStamped(_STAMP_NS, topics.FRAME_CAMERA, t_m, q, root @ root.T)
    payload = message.encode()
    ours = (message.encode, lambda: PoseWithCovarianceStamped.decode(payload))
    theirs = _rosbags(payload) if find_spec("rosbags") is not None else (None, None)
    return [
        _time(what, mine, other, calls)
        for what, mine, other in zip(("encode a pose", "decode a pose"), ours, theirs, strict=True)
    ] + [Timing("take a sample: key, attachment, decode, judge", _receive_us(message, calls), None)]


def _time(what: str, ours: Callable[[], object], theirs: Callable[[], object] | None, calls: int) -> Timing:
    """Round about, so that what else the machine does meets both."""
    rounds: list[tuple[float, float]] = []
    for _ in range(_ROUNDS):
        rounds.append((_us(ours, calls), _us(theirs, calls) if theirs is not None else 0.0))
    return Timing(what, min(one for one, _ in rounds), min(one for _, one in rounds) if theirs is not None else None)


def _us(call: Callable[[], object], calls: int) -> float:
    return timeit.timeit(call, timer=time.thread_time, number=calls) / calls * 1e6


def _receive_us(message: PoseWithCovarianceStamped, calls: int) -> float:
    """Each sample must be newer than the last, so they are made beforehand."""
    key = topics.publication_key(topics.POSE, "uav1", "t0")
    payload = bytearray(message.encode())
    samples = []
    for n in range(1, calls + 1):
        payload[8:12] = n.to_bytes(4, "little")  # the stamp's nanoseconds
        samples.append((bytes(payload), topics.attachment(n, _STAMP_NS, bytes(16))))

    def take_all() -> None:
        receiver = PoseReceiver("uav1")
        for sample in samples:
            receiver.receive(key, *sample, _STAMP_NS)

    return min(timeit.repeat(take_all, timer=time.thread_time, number=1, repeat=_ROUNDS)) / calls * 1e6


def _rosbags(payload: bytes) -> tuple[Callable[[], object], Callable[[], object]]:
    from rosbags.typesys import Stores, get_typestore

    store, ros_type = get_typestore(Stores.ROS2_JAZZY), topics.POSE.ros_type
    message = store.deserialize_cdr(payload, ros_type)
    return lambda: store.serialize_cdr(message, ros_type), lambda: store.deserialize_cdr(payload, ros_type)


def to_json(timings: list[Timing]) -> str:
    return json.dumps([asdict(one) for one in timings])


def table(timings: list[Timing]) -> str:
    lines = [f"{'':48}{'ours µs':>9}{'rosbags µs':>12}{'ratio':>7}"]
    for one in timings:
        theirs = "–" if one.rosbags_us is None else f"{one.rosbags_us:.1f}"
        ratio = "–" if one.ratio is None else f"{one.ratio:.1f}"
        lines.append(f"{one.what:48}{one.ours_us:9.1f}{theirs:>12}{ratio:>7}")
    return "\n".join(lines)
