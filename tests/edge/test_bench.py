"""`uavpose-edge bench` as a process, and its count of work against onnx's own reading of the files."""

from __future__ import annotations

import hashlib
import json
import math
import os
import platform
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from threading import Thread

import numpy as np
import onnx
import onnx.parser
import pytest
from onnxruntime.quantization import CalibrationDataReader, QuantType, quantize_static

from edge.bench.macs import Macs, count_macs
from edge.bench.measure import ORT, Case, Machine, Measured, Row, measure
from edge.bench.peak import Peak
from edge.bench.report import table, to_tree
from edge.bench.timing import UNTIMED_ROUNDS, Milliseconds, time_in_turns
from tests.waiting import until

from .conftest import Cli
from .toy_model import write_toy_model

# 3 -> 8 channels with stride 2, 8 in 4 groups, then a product over the mean of each channel.
NETWORK = """
<ir_version: 8, opset_import: ["" : 17]>
work (uint8[N, H, W, 3] image, float[N, 3, 3] K) => (float[N, 5] y, float[N, 3, 3] kept)
<float[8, 3, 3, 3] w1 = {W1}, float[8, 2, 3, 3] w2 = {W2}, float[8, 5] w3 = {W3}>
{
    kept = Identity(K)
    pixels = Cast<to = 1>(image)
    planes = Transpose<perm = [0, 3, 1, 2]>(pixels)
    a = Conv<pads = [1, 1, 1, 1], strides = [2, 2]>(planes, w1)
    b = Conv<pads = [1, 1, 1, 1], group = 4>(a, w2)
    mean = ReduceMean<axes = [2, 3], keepdims = 0>(b)
    y = MatMul(mean, w3)
}
"""


@pytest.fixture
def network(tmp_path: Path) -> Path:
    text = NETWORK
    rng = np.random.default_rng(0)
    for name, count in (("W1", 216), ("W2", 144), ("W3", 40)):
        values = ", ".join(f"{value:.4f}" for value in rng.standard_normal(count))
        text = text.replace("{" + name + "}", "{" + values + "}")
    path = tmp_path / "work.onnx"
    onnx.save(onnx.parser.parse_model(text), str(path))
    return path


def by_hand(width: int, height: int) -> tuple[int, int]:
    """Multiply-accumulates of the convolutions and of the product."""
    cells = (width // 2) * (height // 2)
    return cells * 8 * 3 * 9 + cells * 8 * 2 * 9, 8 * 5


@pytest.mark.parametrize("size_wh", [(64, 64), (96, 32)])
def test_work_is_counted_at_the_input_size(network: Path, size_wh: tuple[int, int]) -> None:
    assert count_macs(network.read_bytes(), size_wh) == Macs(0, sum(by_hand(*size_wh)))


def test_quantised_work_is_counted_apart(network: Path, tmp_path: Path) -> None:
    class Noise(CalibrationDataReader):
        def __init__(self) -> None:
            image = np.random.default_rng(1).integers(0, 256, (1, 64, 64, 3), dtype=np.uint8)
            self.left = [{"image": image, "K": np.eye(3, dtype=np.float32)[None]}]

        def get_next(self) -> dict[str, np.ndarray] | None:
            return self.left.pop() if self.left else None

    quantised = tmp_path / "int8.onnx"
    quantize_static(
        str(network),
        str(quantised),
        Noise(),
        op_types_to_quantize=["Conv"],
        per_channel=True,
        activation_type=QuantType.QUInt8,
        weight_type=QuantType.QInt8,
    )
    convolutions, product = by_hand(64, 96)
    assert count_macs(quantised.read_bytes(), (64, 96)) == Macs(convolutions, product)


def test_cases_take_turns() -> None:
    order: list[str] = []
    ms = time_in_turns({"a": lambda: order.append("a"), "b": lambda: order.append("b")}, 3, lambda _: None)
    assert order == ["a", "b"] * (3 + UNTIMED_ROUNDS)
    assert all(0 <= one.p10 <= one.p50 <= one.p99 for one in ms.values())


class Clocks:
    """Clocks that stand still except where a call takes its time."""

    def __init__(self) -> None:
        self.wall_ns, self.cpu_ns, self.calls = 5_000_000_000, 700_000_000, 0

    def perf_counter_ns(self) -> int:
        return self.wall_ns

    def process_time_ns(self) -> int:
        return self.cpu_ns

    def monotonic(self) -> float:
        return 1e-9 * self.wall_ns

    def sleep(self, seconds: float) -> None:
        self.wall_ns += round(1e9 * seconds)

    def take(self, wall_ms: int) -> None:
        """A call that keeps two threads busy."""
        self.calls += 1
        self.wall_ns += 1_000_000 * wall_ms
        self.cpu_ns += 2_000_000 * wall_ms


def test_times_are_of_the_calls_alone_and_of_those_after_the_first_rounds(monkeypatch: pytest.MonkeyPatch) -> None:
    """One takes 0 to 100 ms, from both ends, after two rounds of an hour; another 7 ms, untimed for 20 first."""
    clocks, rounds = Clocks(), list[int]()
    monkeypatch.setattr("edge.bench.timing.time", clocks)
    monkeypatch.setattr("edge.bench.timing.wait_until_quiet", lambda: clocks.sleep(1.0))
    left = [3_600_000, 3_600_000, *(k // 2 if k % 2 == 0 else 100 - k // 2 for k in range(101))]
    calls = {"one": lambda: clocks.take(left.pop(0)), "other": lambda: clocks.take(7)}
    ms = time_in_turns(calls, 101, rounds.append, warm={"other"})
    assert ms["one"] == Milliseconds(10.0, 50.0, 99.0, 100.0)
    assert ms["other"] == Milliseconds(7.0, 7.0, 7.0, 14.0)
    assert clocks.calls == 103 * (1 + 3 + 1)
    assert rounds == list(range(1, 104))


def test_no_thread_of_one_case_runs_while_the_next_is_timed() -> None:
    """As those of OpenVINO and PyTorch, which spin after a call has returned."""

    def work() -> None:
        hashlib.pbkdf2_hmac("sha256", b"", b"", 200_000)  # without Python's lock

    left = list[Thread]()

    def leaves_a_thread() -> None:
        left.append(Thread(target=work))
        left[-1].start()

    ms = time_in_turns({"work": work, "leaves": leaves_a_thread, "next": lambda: left[-1].join()}, 2, lambda _: None)
    assert ms["next"].cpu < ms["work"].cpu / 5


@pytest.mark.parametrize(
    ("cpuinfo", "name"),
    [
        ("processor\t: 0\nmodel name\t: A CPU: 2 GHz\n\nprocessor\t: 1\nmodel name\t: another\n", "A CPU: 2 GHz"),
        ("processor\t: 0\nBogoMIPS\t: 108.00\n\nModel\t\t: A Board 5\n", "A Board 5"),  # as of Arm's kernels
        ("processor\t: 0\nBogoMIPS\t: 108.00\n", platform.machine()),
        (None, platform.machine()),
    ],
)
def test_the_processor_is_named_and_its_cores_that_may_be_used_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, toy_model: Path, cpuinfo: str | None, name: str
) -> None:
    monkeypatch.setattr("edge.bench.measure.CPU_INFO", tmp_path / "cpuinfo")
    if cpuinfo is not None:
        (tmp_path / "cpuinfo").write_text(cpuinfo)
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    try:
        measured = measure([toy_model], [1], spinning=False, rounds=1, others=False, on_round=lambda _: None)
    finally:
        os.sched_setaffinity(0, cores)
    assert table(measured).startswith(f"{name}, 1 cores, ONNX Runtime ")


def test_files_of_one_name_are_told_apart(cli: Cli, tmp_path: Path) -> None:
    for name in ("old/toy.onnx", "new/toy.onnx", "new/other.onnx"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_toy_model(tmp_path / name, track_size_wh=None)
    done = cli("bench", "old/toy.onnx", "new/toy.onnx", "new/other.onnx", "--runs", "1", "--threads", "1", "--alone")
    rows = [line.split()[0] for line in done.stdout.splitlines() if " onnxruntime " in line]
    assert rows == ["old/toy.onnx", "new/toy.onnx", "other"]


def test_signals_to_the_pipeline_reach_the_harness(tmp_path: Path) -> None:
    """A wrapper around it would have to end it, and with it the programs that it started."""
    command = [sys.executable, "-m", "edge.cli", "bench", "--pipeline"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as bench:
        words = Path(f"/proc/{bench.pid}/cmdline")
        try:
            until(lambda: b"bench-pipeline" in words.read_bytes(), what="the harness")
        finally:
            bench.kill()


def test_the_pipeline_is_given_what_bench_was(tmp_path: Path) -> None:
    """By a harness that says what it was given, beside a Python in a folder of its own."""
    python = tmp_path / "python"
    python.symlink_to(sys.executable)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}

    def piped(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [python, "-m", "edge.cli", "bench", "--pipeline", *arguments]
        return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)

    missing = piped()
    assert (missing.returncode, f"is not installed beside {python}" in missing.stderr) == (2, True), missing.stderr
    (tmp_path / "uavpose-replay").write_text('#!/bin/sh\necho "$@"\n')
    (tmp_path / "uavpose-replay").chmod(0o755)
    assert piped().stdout == "bench-pipeline\n"
    told = piped("a.onnx", "--sequence", "scene", "--minutes", "0.5", "--fps", "20", "--json").stdout
    assert told == "bench-pipeline --sequence scene --minutes 0.5 --fps 20.0 --model a.onnx --json\n"


def test_the_report_holds_its_ratios(cli: Cli, tmp_path: Path, toy_model: Path) -> None:
    int8 = write_toy_model(tmp_path / "int8.onnx", precision="int8")
    paper = write_toy_model(tmp_path / "paper.onnx", configuration="paper", track_size_wh=None)
    done = cli("bench", toy_model, int8, paper, "--runs", "5", "--threads", "2,1,2", "--alone", "--json")
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    rows = {(Path(r["file"]).stem, r["stage"], r["threads"]): r for r in result["rows"]}
    assert len(rows) == len(result["rows"]) == 2 * (2 + 2 + 1)
    p10 = {key: row["ms"]["p10"] for key, row in rows.items()}
    ratios = result["ratios"]
    assert ratios["int8_over_fp32"] == pytest.approx(p10["int8", "track", 2] / p10["toy", "track", 2])
    assert ratios["edge_over_paper_fp32"] == pytest.approx(p10["toy", "acquire", 2] / p10["paper", "acquire", 2])
    assert ratios["over_vnni_limit"] is None, "a network without convolutions and products has no limit"
    assert result["track_ms"] == rows["int8", "track", 2]["ms"]["p50"]
    assert result["acquire_ms"] == rows["int8", "acquire", 2]["ms"]["p50"]
    assert {model["precision"]: len(model["sha256"]) for model in result["models"]} == {"fp32": 64, "int8": 64}
    assert all(peak["int8_gmac_per_s"] > 0 and peak["fp32_gmac_per_s"] > 0 for peak in result["peaks"])


def test_ratios_are_told_as_worked_by_hand() -> None:
    """Of 10th percentiles, and of processor time; p50 and p99 are other numbers."""

    def row(kind: str, stage: str, threads: int, p10: float, cpu: float, engine: str = ORT) -> Row:
        configuration, precision = kind.split()
        case, ms = (
            Case(f"{configuration}-{precision}.onnx", stage, threads, engine),
            Milliseconds(p10, 9 * p10, 99.0, cpu),
        )
        return Row(case, configuration, precision, (224, 224), Macs(60_000_000, 500_000), ms, limit_ms=2.0)

    rows = (
        row("edge int8", "track", 1, 6.0, 6.0),
        row("edge fp32", "track", 1, 20.0, 12.0),
        row("edge int8", "track", 2, 4.0, 5.0),
        row("edge fp32", "track", 2, 10.0, 20.0),
        row("edge int8", "acquire", 2, 8.0, 9.0),
        row("edge fp32", "acquire", 2, 30.0, 36.0),
        row("paper fp32", "track", 2, 40.0, 40.0),
        row("paper fp32", "acquire", 2, 60.0, 90.0),
        row("edge int8", "track", 2, 5.0, 2.5, "openvino"),
        row("edge fp32", "track", 2, 25.0, 80.0, "pytorch"),
    )
    measured = Measured(Machine("a CPU", 2, "1.31", None), 50, {}, (Peak(2, 435.0, 80.0),), rows)
    tree = to_tree(measured)
    assert (tree["track_ms"], tree["acquire_ms"]) == (36.0, 72.0)
    floats = to_tree(replace(measured, rows=tuple(row for row in rows if row.precision == "fp32")))
    assert (floats["track_ms"], floats["ratios"]["int8_over_fp32"]) == (90.0, None)
    assert tree["ratios"] == {
        "int8_over_fp32": pytest.approx(0.4),
        "edge_over_paper_fp32": pytest.approx(0.5),
        "ort_over_openvino": pytest.approx(0.8),
        "ort_over_eager": pytest.approx(0.4),
        "over_vnni_limit": pytest.approx(2.0),
    }
    told = [" ".join(line.split()) for line in table(measured).splitlines()]
    assert "INT8 / FP32 of the edge configuration at one input size track 1 0.30 0.50" in told
    assert "INT8 / FP32 of the edge configuration at one input size track 2 0.40 0.25" in told
    assert "INT8 / FP32 of the edge configuration at one input size acquire 2 0.27 0.25" in told
    assert "edge / paper configuration, FP32, each at its own input size acquire 2 0.50 0.40" in told
    assert "ONNX Runtime / OpenVINO, INT8 track 2 0.80 2.00" in told
    assert "INT8 / its multiply-accumulates at this machine's peak track 1 3.00 -" in told
    assert "edge-int8 track 224x224 2 onnxruntime 4.00 36.00 99.00 5.00 60.0 0.5 2.00" in told
    assert "2 threads: INT8 435, FP32 80" in told
    alone = [" ".join(line.split()) for line in table(replace(measured, rows=rows[:1])).splitlines()]
    assert "INT8 / FP32 of the edge configuration at one input size needs two such models" in alone
    assert "ONNX Runtime / OpenVINO, INT8 no such engine" in alone


def test_other_engines_infer_the_same_files(cli: Cli, tmp_path: Path) -> None:
    # PyTorch builds the network of that backbone; of any other it has none to compare.
    small = {"acquire_size_wh": (96, 64), "track_size_wh": (64, 64), "backbone": "efficientnet_lite0"}
    other = write_toy_model(tmp_path / "other.onnx", **{**small, "backbone": "none"})
    fp32 = write_toy_model(tmp_path / "fp32.onnx", **small)
    int8 = write_toy_model(tmp_path / "int8.onnx", precision="int8", **small)
    done = cli("bench", fp32, int8, other, "--runs", "1", "--threads", "1", "--json", timeout_s=200.0)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    p10 = {(Path(r["file"]).stem, r["engine"]): r["ms"]["p10"] for r in result["rows"] if r["stage"] == "track"}
    assert set(p10) == {
        *(("fp32", engine) for engine in ("onnxruntime", "openvino", "pytorch")),
        *((name, engine) for name in ("int8", "other") for engine in ("onnxruntime", "openvino")),
    }
    ratios = result["ratios"]
    assert ratios["ort_over_openvino"] == pytest.approx(p10["int8", "onnxruntime"] / p10["int8", "openvino"])
    assert ratios["ort_over_eager"] == pytest.approx(p10["fp32", "onnxruntime"] / p10["fp32", "pytorch"])


def test_precisions_are_compared_at_one_size_alone(cli: Cli, tmp_path: Path, toy_model: Path) -> None:
    int8 = write_toy_model(tmp_path / "int8.onnx", precision="int8", track_size_wh=(128, 128))
    done = cli("bench", toy_model, int8, "--runs", "1", "--threads", "1", "--alone", "--json")
    assert done.returncode == 0, done.stderr
    compared = [r["stage"] for r in json.loads(done.stdout)["all_ratios"] if r["name"] == "int8_over_fp32"]
    assert compared == ["acquire"]


def test_the_shipped_model_is_held_to_the_machine(cli: Cli) -> None:
    done = cli("bench", "--runs", "2", "--threads", "1", "--alone", "--json", timeout_s=200.0)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    for row in result["rows"]:
        assert row["macs"]["int8"] > 10 * row["macs"]["float32"], "the network's work is quantised"
        peaks = result["peaks"][0]
        limit_ms = (
            row["macs"]["int8"] / peaks["int8_gmac_per_s"] + row["macs"]["float32"] / peaks["fp32_gmac_per_s"]
        ) / 1e6
        assert row["limit_ms"] == pytest.approx(limit_ms)
    track = next(row for row in result["rows"] if row["stage"] == "track")
    assert result["ratios"]["over_vnni_limit"] == pytest.approx(track["ms"]["p10"] / track["limit_ms"])
    assert result["ratios"]["int8_over_fp32"] is None
    area = math.prod(result["rows"][0]["size_wh"]) / math.prod(track["size_wh"])
    assert result["rows"][0]["macs"]["int8"] / track["macs"]["int8"] == pytest.approx(area, rel=0.1)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--threads", "two"], "--threads two"),
        (["--threads", "0"], "--threads 0"),
        (["--threads", "65"], "integers from 1 to 64"),
        (["--threads", "1,99999999999999999999"], "integers from 1 to 64"),
        (["--runs", "0"], "--runs 0"),
        (["none.onnx", "--alone"], "none.onnx"),
        (["--minutes", "1"], "--minutes needs --pipeline"),
        (["--pipeline", "--threads", "1"], "--threads cannot be combined with --pipeline"),
        (["--sequence", "scene"], "--sequence needs --pipeline"),
        (["--fps", "20"], "--fps needs --pipeline"),
        (["--pipeline", "--alone"], "--alone cannot be combined with --pipeline"),
        (["--pipeline", "--spinning"], "--spinning cannot be combined with --pipeline"),
        (["--pipeline", "--runs", "9"], "--runs cannot be combined with --pipeline"),
        (["--pipeline", "a.onnx", "b.onnx"], "--pipeline takes one model, not 2"),
    ],
)
def test_what_cannot_be_timed_is_named(cli: Cli, arguments: list[str], named: str) -> None:
    done = cli("bench", *arguments)
    assert done.returncode == 2
    assert named in done.stderr
    assert "Traceback" not in done.stderr
