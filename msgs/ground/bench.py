"""`uavpose-ground bench`: time to encode a pose, and to decode it with validation, compared with other codecs."""

from __future__ import annotations

import json
import time
import timeit
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from msgs import topics
from msgs.cdr import PoseWithCovarianceStamped
from msgs.ground.bench_peers import Codec, installed
from msgs.receive import PoseReceiver

_STAMP_NS = 1_700_000_000_123_456_789
_ROUNDS = 7


@dataclass(frozen=True)
class Timing:
    """CPU microseconds per call, best of several rounds; None: not applicable."""

    codec: str
    size_bytes: int
    encode_us: float
    decode_us: float
    take_us: float | None = None  # receiving a whole sample: key, attachment, decoding, validation


def bench(calls: int) -> list[Timing]:
    """Time `calls` calls per round, our codec first. Unlike ours, the others do not validate on decoding."""
    message = pose()
    payload = message.encode()
    ours = Codec("ours", message.encode, lambda: PoseWithCovarianceStamped.decode(payload))
    codecs = [ours, *installed(message)]
    encode_us, decode_us = ({codec.name: float("inf") for codec in codecs} for _ in range(2))
    for _ in range(_ROUNDS):
        # Interleaved, so that other load on the machine affects all codecs.
        for codec in codecs:
            encode_us[codec.name] = min(encode_us[codec.name], _us(codec.encode, calls))
            decode_us[codec.name] = min(decode_us[codec.name], _us(codec.decode, calls))
    taken_us = {ours.name: _receive_us(message, calls)}
    return [
        Timing(name, len(codec.encode()), encode_us[name], decode_us[name], taken_us.get(name))
        for codec in codecs
        for name in [codec.name]
    ]


def pose() -> PoseWithCovarianceStamped:
    """The pose that is encoded; its covariance has no round numbers."""
    root = np.random.default_rng(0).normal(size=(6, 6))
    t_m, q = np.array([10.0, -4.0, 260.0]), np.array([0.5, -0.5, 0.5, 0.5])
    return PoseWithCovarianceStamped(_STAMP_NS, topics.FRAME_CAMERA, t_m, q, root @ root.T)


def _us(call: Callable[[], object], calls: int) -> float:
    return timeit.timeit(call, timer=time.thread_time, number=calls) / calls * 1e6


def _receive_us(message: PoseWithCovarianceStamped, calls: int) -> float:
    """Time to receive a sample. Each must be newer than the last, so they are prepared in advance."""
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


def to_json(timings: list[Timing]) -> str:
    return json.dumps([asdict(one) for one in timings])


def table(timings: list[Timing]) -> str:
    lines = [f"{'one pose':10}{'bytes':>7}{'encode µs':>11}{'decode µs':>11}{'take a sample µs':>18}"]
    for one in timings:
        taken = "–" if one.take_us is None else f"{one.take_us:.1f}"
        lines.append(f"{one.codec:10}{one.size_bytes:7d}{one.encode_us:11.1f}{one.decode_us:11.1f}{taken:>18}")
    return "\n".join(lines)
