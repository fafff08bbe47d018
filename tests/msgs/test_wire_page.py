"""docs/wire.md alone is enough to read a vehicle: its program, as it stands there, against ours."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from msgs import cdr, topics
from msgs.publish import Node
from tests.waiting import until

from .conftest import Network

PAGE = (Path(__file__).parents[2] / "docs" / "wire.md").read_text()
NS = 1_000_000_000
STAMP_NS = 1_795_465_775 * NS + 152_525_082
RNG = np.random.default_rng(7)
T, Q = RNG.normal(size=3), np.array([0.5, -0.5, 0.5, 0.5])
P = np.diag(RNG.uniform(0.1, 1.0, 6))
K = np.array([[2000.0, 0.0, 959.5], [0.0, 2001.0, 539.5], [0.0, 0.0, 1.0]])
FOUND = cdr.Detection3D(
    STAMP_NS, "camera_optical_frame", (cdr.Hypothesis("fixed_wing", 0.75, T, Q, P),), T, Q, np.zeros(3), "t0"
)
PLACE = cdr.TransformStamped(STAMP_NS, "ned", "base_link_ned", T, Q)
HEALTH = cdr.DiagnosticStatus(1, "uavpose_edge", "degraded, tracking", "uav1", (("state", "degraded"), ("", "–")))
INTRINSICS = cdr.CameraInfo(
    STAMP_NS, "camera_optical_frame", 1080, 1920, "plumb_bob", RNG.normal(size=5), K, np.eye(3), np.eye(3, 4)
)
MESSAGES: list[tuple[topics.Topic, cdr.Payload]] = [
    (topics.POSE, cdr.PoseWithCovarianceStamped(STAMP_NS, "camera_optical_frame", T, Q, P)),
    (topics.ODOM, cdr.Odometry(STAMP_NS, "ned", "target_frd", T, Q, P, T + 1.0, np.zeros(3), 2.0 * P)),
    (topics.DIRECTION, cdr.Vector3Stamped(STAMP_NS, "camera_optical_frame", T / np.linalg.norm(T))),
    (topics.DETECTIONS, cdr.Detection3DArray(STAMP_NS, "camera_optical_frame", (FOUND, FOUND))),
    (topics.TF, cdr.TFMessage((PLACE, PLACE))),
    (topics.CAMERA_INFO, INTRINSICS),
    (topics.IMAGE, cdr.CompressedImage(STAMP_NS, "camera_optical_frame", "jpeg", b"\xff\xd8\xff")),
    (topics.DIAGNOSTICS, cdr.DiagnosticArray(STAMP_NS, "", (HEALTH, HEALTH))),
    (topics.EVENTS, cdr.Log(STAMP_NS, 30, "uavpose_edge", "target 0 lost")),
]


@contextmanager
def reader(endpoint: str, folder: Path) -> Iterator[Path]:
    """The page's program, and the file that it prints to."""
    found = re.search(r"```python\n(.*?)```", PAGE, re.DOTALL)
    assert found is not None
    program, told = folder / "decode.py", folder / "told.jsonl"
    program.write_text(found[1])
    assert not re.search(r"\b(?:msgs|edge|sim_replay)\b", found[1])
    with told.open("w") as out:
        process = subprocess.Popen([sys.executable, program, endpoint, "uav1"], cwd=folder, stdout=out)
        try:
            yield told
        finally:
            process.kill()
            process.wait()


def lines(told: Path) -> list[dict[str, Any]]:
    whole, _, _ = told.read_text().rpartition("\n")
    return [json.loads(line) for line in whole.splitlines()]


def values(told: object) -> list[object]:
    """All numbers and words, in their order."""
    if isinstance(told, dict):
        return [value for one in told.values() for value in values(one)]
    if isinstance(told, list):
        return [value for one in told for value in values(one)]
    return [told]


def expected(message: object) -> list[object]:
    """The same of one of our own; a stamp is two numbers there, and bytes are told by their length."""
    if isinstance(message, np.ndarray):
        return message.ravel().tolist()
    if isinstance(message, tuple):
        return [value for one in message for value in expected(one)]
    if isinstance(message, bytes):
        return [len(message)]
    if not hasattr(message, "__dataclass_fields__"):
        return [message]
    return [
        value
        for name, one in vars(message).items()
        for value in (divmod(one, NS) if name == "stamp_ns" else expected(one))
    ]


@pytest.mark.parametrize("distribution", ["jazzy", "humble", "off"])
def test_the_program_of_the_page_reads_every_topic(
    network: Network, tmp_path: Path, distribution: topics.Distribution
) -> None:
    with Node(network.daemon, "uav1", distribution=distribution) as node:
        sent = [(node.publisher(topic, "t0" if topic.per_target else None), one) for topic, one in MESSAGES]
        for publisher, message in sent:  # those that are kept: once, before anybody is there
            if publisher.topic.cache:
                publisher.put(message.encode())

        def tell() -> None:
            for publisher, message in reversed(sent):  # what is put last overtakes the others: poses are urgent
                if not publisher.topic.cache:
                    publisher.put(message.encode())

        def newest() -> dict[str, int]:
            return {one["key"]: one["sequence"] for one in lines(told)}

        with reader(network.endpoint, tmp_path) as told:
            until(lambda: len(newest()) == len(MESSAGES), tell, what="every topic")
            heard_first = newest()
            rounds = iter(range(50))
            until(lambda: next(rounds, None) is None, tell)
            until(lambda: newest() == {one.key: one.sequence for one, _ in sent}, what="the last", within_s=10.0)
            heard = lines(told)
    for publisher, message in sent:
        of_it = [one for one in heard if one["key"] == publisher.key]
        assert all(one["type"] == publisher.topic.ros_type for one in of_it)
        assert all(values(one["message"]) == expected(message) for one in of_it), publisher.key
        numbers = [one["sequence"] for one in of_it]
        assert numbers == sorted(set(numbers))
        since = range(heard_first[publisher.key], publisher.sequence + 1)
        assert numbers[-len(since) :] == [*since], publisher.key


def test_the_page_s_key_is_one() -> None:
    told = re.search(r"^    (0/uav1/\S+)…$", PAGE, re.MULTILINE)
    assert told is not None
    assert topics.publication_key(topics.POSE, "uav1", "t0").startswith(told[1])


def test_every_question_and_command_is_on_the_page() -> None:
    from edge.links.zenoh_commands import COMMANDS

    table = PAGE[PAGE.index("## Questions and commands") :]
    assert set(re.findall(r"(?:cmd|…)/(\w+)`", table)) == set(COMMANDS)


@pytest.mark.parametrize(("name", "body"), re.findall(r"cmd/(\w+)` \| body `(\{.*?\})`", PAGE))
def test_a_body_that_the_page_shows_is_taken(name: str, body: str) -> None:
    from edge.links.zenoh_commands import parse

    parse(name, body.replace("left, top, right, bottom", "0.4, 0.4, 0.6, 0.6").encode())
