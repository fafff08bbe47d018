"""Publisher and client over real sessions, and client programs as processes of their own."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections import Counter
from itertools import pairwise

import pytest
import zenoh

from msgs import cdr, client, session, topics
from msgs.publish import Node, TopicPublisher
from msgs.receive import TargetPose
from msgs.topics import POSE
from msgs.wire import Refusal
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .conftest import Network, pose_now


def test_a_sample_is_what_a_ros_2_publisher_sends(network: Network) -> None:
    samples: list[zenoh.Sample] = []
    with client.connect(network.endpoint) as tool, Node(network.daemon, "uav1") as node:
        tool.declare_subscriber("0/uav1/**", zenoh.handlers.Callback(samples.append, indirect=False))
        publisher = node.publisher(POSE, "t2")
        until(lambda: len(samples) >= 2, lambda: publisher.put(pose_now().encode()))
        tokens = [str(reply.ok.key_expr) for reply in tool.liveliness().get("@ros2_lv/0/**")]
    zid = str(network.daemon.zid())
    token = topics.publisher_token(zid, 0, 1, POSE, "uav1", "t2")
    assert sorted(tokens) == sorted([token, topics.node_token(zid, 0, "uav1")])
    first, second = samples[:2]
    assert str(first.key_expr) == topics.publication_key(POSE, "uav1", "t2")
    assert str(first.encoding) == "application/cdr;geometry_msgs/msg/PoseWithCovarianceStamped"
    assert first.priority == zenoh.Priority.REAL_TIME
    assert first.congestion_control == zenoh.CongestionControl.DROP
    attachments = [topics.parse_attachment(sample.attachment.to_bytes()) for sample in (first, second)]
    assert [a[2] for a in attachments if a] == [topics.gid(token)] * 2
    assert attachments[1][0] == attachments[0][0] + 1


@pytest.mark.parametrize("distribution", ["jazzy", "humble", "off"])
def test_poses_arrive_typed_with_their_age(network: Network, distribution: topics.Distribution) -> None:
    taken: list[TargetPose] = []
    with (
        client.connect(network.endpoint) as tool,
        client.subscribe(tool, "uav1") as poses,
        Node(network.daemon, "uav1", distribution=distribution) as node,
    ):
        publisher = node.publisher(POSE, "t0")

        def step() -> None:
            publisher.put(pose_now(321.0, age_s=0.1).encode())
            taken.extend(filter(None, [poses.poll()]))

        until(lambda: bool(taken), step)
    assert (taken[0].uav, taken[0].target, taken[0].pose.t_cam_target_m[2]) == ("uav1", "t0", 321.0)
    assert 0.1 <= taken[0].age_s < 1.0


def test_a_domain_is_heard_by_who_asks_for_it_alone(network: Network) -> None:
    every: list[TargetPose] = []
    with (
        client.connect(network.endpoint) as tool,
        client.subscribe(tool, "uav1", domain=7) as poses,
        client.subscribe_all(tool, "uav1", every.append, domain=7) as counts,
        client.subscribe(tool, "uav1") as elsewhere,
        Node(network.daemon, "uav1", domain=7) as node,
    ):
        publisher = node.publisher(POSE, "t0")
        taken: list[TargetPose] = []

        def step() -> None:
            publisher.put(pose_now(321.0).encode())
            taken.extend(filter(None, [poses.poll()]))

        until(lambda: taken and every, step, what="a pose for both")
        assert elsewhere.poll() is None
        assert {one.pose.t_cam_target_m[2] for one in [*taken, *every]} == {321.0}
        assert counts.refused() == dict(poses.refused) == dict(elsewhere.refused) == {}


def test_of_a_frame_with_many_targets_none_is_lost(network: Network) -> None:
    with client.connect(network.endpoint) as tool, client.subscribe(tool, "uav1", depth=2000, max_age_s=60.0) as poses:
        publishers = [Node(network.daemon, "uav1").publisher(POSE, f"t{i}") for i in range(16)]
        until(lambda: poses.poll() is not None, lambda: publishers[-1].put(pose_now().encode()))
        last = {f"t{i}": publisher.sequence + 50 for i, publisher in enumerate(publishers)}
        for _ in range(50):
            for publisher in publishers:
                publisher.put(pose_now().encode())
            time.sleep(0.01)  # the frame's period
        taken: list[TargetPose] = []
        until(
            lambda: {one.target: one.sequence for one in taken} == last,
            lambda: taken.extend(iter(poses.poll, None)),
            what="the last pose of each target",
        )
    assert Counter(one.target for one in taken if one.sequence > last[one.target] - 50) == dict.fromkeys(last, 50)


def test_bad_samples_are_counted_by_reason_and_good_ones_still_come(network: Network) -> None:
    with client.connect(network.endpoint) as tool, client.subscribe(tool, "uav1", depth=64) as poses:
        publisher = Node(network.daemon, "uav1").publisher(POSE, "t0")
        until(lambda: poses.poll() is not None, lambda: publisher.put(pose_now().encode()))
        publisher.put(b"junk")
        publisher.put(pose_now().encode()[:-8])
        publisher.put(pose_now(age_s=30.0).encode())
        network.daemon.put(publisher.key, pose_now().encode())
        expected = {Refusal.ENCAPSULATION: 1, Refusal.TRUNCATED: 1, Refusal.STALE: 1, Refusal.ATTACHMENT: 1}
        until(lambda: dict(poses.refused) == expected, lambda: poses.poll())
        accepted = poses.accepted
        until(lambda: poses.poll() is not None, lambda: publisher.put(pose_now().encode()))
        assert poses.accepted > accepted


def test_of_two_daemons_of_one_name_one_is_believed_and_the_other_once_it_has_ended(network: Network) -> None:
    taken: list[tuple[float, int]] = []
    with (
        zenoh.open(session.peer_config([], [network.endpoint])) as other_daemon,
        client.connect(network.endpoint) as tool,
        client.subscribe(tool, "uav1", depth=64) as poses,
        Node(other_daemon, "uav1") as other,
    ):
        far = other.publisher(POSE, "t0")

        def step(*putting: tuple[TopicPublisher, float]) -> None:
            for publisher, range_m in putting:
                publisher.put(pose_now(range_m).encode())
            taken.extend((one.pose.t_cam_target_m[2], one.arrival_ns) for one in iter(poses.poll, None))

        with Node(network.daemon, "uav1") as node:
            near = node.publisher(POSE, "t0")
            until(lambda: taken, lambda: step((near, 100.0)), what="the first daemon's pose")
            refused = lambda: poses.refused[Refusal.PUBLISHER] >= 20  # noqa: E731
            until(refused, lambda: step((near, 100.0), (far, 300.0)), what="the other's poses, refused")
        until(lambda: taken[-1][0] == 300.0, lambda: step((far, 300.0)), what="the other's pose, taken")
    # On a busy machine one may fall silent for a second while both are there.
    assert all(b[1] - a[1] > 1_000_000_000 for a, b in pairwise(taken) if a[0] != b[0])


def test_of_two_daemons_of_one_name_no_target_of_the_second_is_believed_beside_those_of_the_first(
    network: Network,
) -> None:
    with (
        zenoh.open(session.peer_config([], [network.endpoint])) as other,
        client.connect(network.endpoint) as tool,
        client.subscribe(tool, "uav1", depth=500) as poses,
        Node(network.daemon, "uav1") as ours,
        Node(other, "uav1") as theirs,
    ):
        first, second = ours.publisher(POSE, "t0"), theirs.publisher(POSE, "t1")
        until(lambda: poses.poll() is not None, lambda: first.put(pose_now().encode()))
        taken: list[str] = []

        def turn() -> None:
            for publisher in (first, second):
                publisher.put(pose_now().encode())
            taken.extend(pose.target for pose in iter(poses.poll, None))

        until(lambda: poses.refused[Refusal.PUBLISHER] > 20 and len(taken) > 20, turn)
    assert set(taken) == {"t0"}


def test_a_slow_reader_gets_the_newest_poses(network: Network) -> None:
    arrived = threading.Event()
    with client.connect(network.endpoint) as tool, client.subscribe(tool, "uav1", depth=2) as poses:
        publisher = Node(network.daemon, "uav1").publisher(POSE, "t0")
        until(lambda: poses.poll() is not None, lambda: publisher.put(pose_now().encode()))
        tool.declare_subscriber("0/last", zenoh.handlers.Callback(lambda _: arrived.set(), indirect=False))
        # Best effort: on a busy machine not all that is put arrives.
        came: list[int] = []
        every = zenoh.handlers.Callback(lambda s: came.append(sequence_of(s)), indirect=False)
        tool.declare_subscriber(publisher.key, every)
        until(lambda: len(came) >= 10, lambda: publisher.put(pose_now().encode()))
        # The marker takes the same way at the same priority, so it comes after the poses.
        until(arrived.is_set, lambda: network.daemon.put("0/last", b"", priority=zenoh.Priority.REAL_TIME))
        numbers = [pose.sequence for pose in iter(poses.poll, None)]
    assert numbers == came[-2:]


def sequence_of(sample: zenoh.Sample) -> int:
    assert sample.attachment is not None
    parsed = topics.parse_attachment(sample.attachment.to_bytes())
    assert parsed is not None
    return parsed[0]


def test_closing_ends_the_iteration(network: Network) -> None:
    with client.connect(network.endpoint) as tool:
        poses = client.subscribe(tool, "uav1")
        reader = threading.Thread(target=lambda: list(poses), daemon=True)
        reader.start()
        poses.close()
        reader.join(timeout=10.0)
        assert not reader.is_alive()


def test_what_is_closed_has_no_more_poses_and_may_be_closed_again(network: Network) -> None:
    with client.connect(network.endpoint) as tool, client.subscribe(tool, "uav1") as poses:
        poses.close()
        assert poses.poll() is None
        assert list(poses) == []
    with client.connect(network.endpoint) as tool:
        left = client.subscribe(tool, "uav1")
    assert left.poll() is None
    left.close()


def test_a_callback_that_fails_in_ever_other_words_is_counted_in_bounded_memory(network: Network) -> None:
    def fail(pose: TargetPose) -> None:
        raise ValueError(f"at {pose.sequence}")

    with (
        client.connect(network.endpoint) as tool,
        client.subscribe_all(tool, "uav1", fail) as counts,
        Node(network.daemon, "uav1") as node,
    ):
        publisher = node.publisher(POSE, "t0")
        until(
            lambda: sum(counts.failures().values()) > 2 * client.FAILURES_MAX,
            lambda: publisher.put(pose_now().encode()),
        )
        failures = counts.failures()
    assert len(failures) == client.FAILURES_MAX + 1
    assert failures["ValueError"] == sum(failures.values()) - client.FAILURES_MAX


def test_every_topic_is_counted_and_history_reaches_who_comes_late(network: Network) -> None:
    taken: list[TargetPose] = []

    def on_pose(pose: TargetPose) -> None:
        taken.append(pose)
        raise RuntimeError("a reader's mistake")

    with Node(network.daemon, "uav1") as node:
        events, diagnostics = node.publisher(topics.EVENTS), node.publisher(topics.DIAGNOSTICS)
        poses = [node.publisher(POSE, target) for target in ("t0", "t1")]
        for n in range(3):
            events.put(cdr.Log(time.time_ns(), 20, "edge", f"event {n}").encode())
        with client.connect(network.endpoint) as tool, client.subscribe_all(tool, "uav1", on_pose) as counts:
            status = cdr.DiagnosticArray(time.time_ns(), "", ()).encode()

            def step() -> None:
                diagnostics.put(status)
                for publisher in poses:
                    publisher.put(pose_now().encode())

            live = {"uav1/target/t0/pose", "uav1/target/t1/pose", "uav1/diagnostics", "uav1/events"}
            until(lambda: set(counts.counts()) == live and counts.counts()["uav1/events"] >= 3, step)
            assert counts.counts()["uav1/events"] == 3
            assert counts.refused() == {}
            until(lambda: counts.failures() == {"RuntimeError: a reader's mistake": len(taken)})
    assert {pose.target for pose in taken} == {"t0", "t1"}
    assert all(0 <= pose.arrival_ns - pose.stamp_ns < 10**9 for pose in taken)


def test_the_daemon_opens_without_a_ground_and_delivers_once_there_is_one() -> None:
    endpoint = free_endpoint()
    with zenoh.open(session.peer_config([free_endpoint()], [endpoint])) as daemon, Node(daemon, "uav1") as node:
        publisher = node.publisher(POSE, "t0")
        publisher.put(pose_now().encode())
        with pytest.raises(ConnectionError, match=endpoint):
            client.connect(endpoint)
        with (
            zenoh.open(session.router_config([endpoint])),
            client.connect(endpoint) as tool,
            client.subscribe(tool, "uav1") as poses,
        ):
            until(lambda: poses.poll() is not None, lambda: publisher.put(pose_now().encode()))


READER = """
import sys
class OnlyWhatIsDeclared:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in sys.stdlib_module_names | {"msgs", "zenoh", "numpy", "xxhash"}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, OnlyWhatIsDeclared())
from msgs.client import connect, subscribe

with connect(sys.argv[1]) as session, subscribe(session, "uav1") as poses:
    print("ready", flush=True)
    for target in poses:
        print(target.target, target.pose.t_cam_target_m[2], flush=True)
        break
"""

FORGETFUL_READER = """
import sys, threading, time
from msgs.client import connect, subscribe_all
taken = threading.Event()
def on_pose(pose):
    taken.set()
    time.sleep(0.3)
class SlowToEnd:
    def __del__(self, sleep=time.sleep):
        sleep(0.6)
sys.slow_to_end = SlowToEnd()
session = connect(sys.argv[1])
counts = subscribe_all(session, "uav1", on_pose)
print("ready", flush=True)
taken.wait()
print("t0 250.0", flush=True)
"""


@pytest.mark.parametrize(
    "program", [READER, FORGETFUL_READER], ids=["bare installation", "session left open, callback under way"]
)
def test_a_reader_program_runs_and_ends(network: Network, program: str) -> None:
    with Node(network.daemon, "uav1") as node:
        publisher = node.publisher(POSE, "t0")
        reader = subprocess.Popen(
            [sys.executable, "-c", program, network.endpoint], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        try:
            until(lambda: reader.poll() is not None, lambda: publisher.put(pose_now(250.0).encode()))
            out, err = reader.communicate()
        finally:
            reader.kill()
    assert (reader.returncode, out.splitlines()) == (0, ["ready", "t0 250.0"]), err
