"""Each example as a process, on a bare installation: zenoh, numpy and xxhash alone can be imported."""

from __future__ import annotations

import dataclasses
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import msgs.examples
from msgs import topics
from msgs.cdr import PoseWithCovarianceStamped
from msgs.publish import Node
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .conftest import Network, pose_now

EXAMPLES = sorted(path.stem for path in Path(msgs.examples.__file__).parent.glob("*.py"))
RUN = """
import runpy, sys
class OnlyWhatIsDeclared:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] not in sys.stdlib_module_names | {"msgs", "zenoh", "numpy", "xxhash"}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, OnlyWhatIsDeclared())
runpy.run_module("msgs.examples." + sys.argv.pop(1), run_name="__main__")
"""


def ahead() -> PoseWithCovarianceStamped:
    return pose_now(250.0)


def aside() -> PoseWithCovarianceStamped:
    """Far to the right, and unsure along the line of sight alone."""
    t_m, along = np.array([200.0, 0.0, 150.0]), np.array([0.8, 0.0, 0.6])
    covariance = 0.01 * np.eye(6)
    covariance[:3, :3] += 20.0**2 * np.outer(along, along)
    return dataclasses.replace(pose_now(), t_cam_target_m=t_m, covariance=covariance)


def run(network: Network, folder: Path, example: str, pose: Callable[[], PoseWithCovarianceStamped] = ahead) -> str:
    """What it prints on five poses of target t3."""
    command = [sys.executable, "-c", RUN, example, "-e", network.endpoint, "-u", "uav1", "-n", "5"]
    with Node(network.daemon, "uav1") as node:
        publisher = node.publisher(topics.POSE, "t3")
        process = subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            until(lambda: process.poll() is not None, lambda: publisher.put(pose().encode()))
            out, err = process.communicate()
        finally:
            process.kill()
    assert process.returncode == 0, err
    return out


def test_poses_are_printed(network: Network, tmp_path: Path) -> None:
    lines = run(network, tmp_path, "print_poses").splitlines()
    assert len(lines) == 5
    assert all(line.startswith("t3 ") and "ahead   250.0 m" in line and "± 1.0 m" in line for line in lines)


def test_how_sure_a_printed_range_is_is_along_the_line_of_sight(network: Network, tmp_path: Path) -> None:
    lines = run(network, tmp_path, "print_poses", aside).splitlines()
    assert all(line.endswith("range  250.0 ± 20.0 m") for line in lines)


def test_ranges_are_plotted(network: Network, tmp_path: Path) -> None:
    lines = run(network, tmp_path, "plot_range").splitlines()
    assert len(lines) == 5
    assert {line.index("o") - line.index("|") - 1 for line in lines} == {int(250 / 600 * 59)}


def test_poses_are_gathered_as_arrays(network: Network, tmp_path: Path) -> None:
    assert run(network, tmp_path, "to_numpy") == "5 poses in poses.npz\n"
    with np.load(tmp_path / "poses.npz") as arrays:
        np.testing.assert_array_equal(arrays["t_cam_target_m"], [[1.0, 2.0, 250.0]] * 5)
        np.testing.assert_allclose(arrays["R_cam_target"], [np.eye(3)] * 5, atol=1e-12)
        assert (np.diff(arrays["stamp_ns"]) > 0).all()
        assert arrays["covariance"].shape == (5, 6, 6)


@pytest.mark.parametrize("example", ["print_poses", "plot_range", "to_numpy"])
def test_on_ctrl_c_an_example_ends_quietly_and_keeps_what_came(network: Network, tmp_path: Path, example: str) -> None:
    command = [sys.executable, "-c", RUN, example, "-e", network.endpoint, "-n", "100000"]
    with Node(network.daemon, "uav1") as node:
        publisher = node.publisher(topics.POSE, "t3")
        process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            until(publisher.matching)
            until(lambda: publisher.sequence >= 100, lambda: publisher.put(ahead().encode()))
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=60.0)
        finally:
            process.kill()
    assert (process.returncode, err) == (0, "")
    if example == "to_numpy":
        with np.load(tmp_path / "poses.npz") as arrays:
            assert out == f"{len(arrays['stamp_ns'])} poses in poses.npz\n"
            assert len(arrays["stamp_ns"]) > 0


@pytest.mark.parametrize("example", ["print_poses", "plot_range", "to_numpy"])
def test_where_nobody_answers_an_example_says_so_in_a_sentence(tmp_path: Path, example: str) -> None:
    endpoint = free_endpoint()
    command = [sys.executable, "-c", RUN, example, "-e", endpoint]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"no zenoh session with {endpoint}: ")
    assert done.stderr.count("\n") == 1
    assert ".rs" not in done.stderr


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("127.0.0.1:7447", "'127.0.0.1:7447' is not tcp/HOST:PORT, tls/HOST:PORT or quic/HOST:PORT\n"),
        ("quic/127.0.0.1:7447", "'quic/127.0.0.1:7447' needs tls: root_ca, certificate and private_key\n"),
    ],
)
def test_what_is_no_endpoint_is_told_in_our_own_words(endpoint: str, said: str) -> None:
    command = [sys.executable, "-c", RUN, "print_poses", "-e", endpoint, "-n", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (2, "", said)


def test_behind_a_reader_that_has_enough_an_example_ends_quietly(network: Network, tmp_path: Path) -> None:
    command = [sys.executable, "-c", RUN, "print_poses", "-e", network.endpoint]
    with Node(network.daemon, "uav1") as node:
        publisher = node.publisher(topics.POSE, "t3")
        process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert process.stdout is not None
        assert process.stderr is not None
        try:
            process.stdout.close()
            until(lambda: process.poll() is not None, lambda: publisher.put(ahead().encode()))
            assert (process.returncode, process.stderr.read()) == (141, "")
        finally:
            process.kill()
            process.stderr.close()


@pytest.mark.parametrize("words", [["-u", "uav*"], ["-n", "-3"], ["-n", "0"]])
def test_words_that_make_no_sense_are_told_before_anybody_is_called(words: list[str], tmp_path: Path) -> None:
    command = [sys.executable, "-c", RUN, "print_poses", *words]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert f"error: argument {words[0]}/" in done.stderr


def test_every_example_is_run_here() -> None:
    assert set(EXAMPLES) - {"__init__", "arguments"} == {"print_poses", "plot_range", "to_numpy"}
