"""Results of a run: ratios, then milliseconds with the number of operations. Pure functions."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from edge.bench.measure import ORT, Measured, Row

BETWEEN_ENGINES = ("ort_over_openvino", "ort_over_eager")
STATISTICS = {"track_ms": "p50", "acquire_ms": "p50", "ratios": "p10", "all_ratios.cpu": "p50 of processor time"}
HEADLINES = {  # each ratio's stage for the one figure in `ratios`; without that stage, the other
    "int8_over_fp32": "track",
    "edge_over_paper_fp32": "acquire",
    "ort_over_openvino": "track",
    "ort_over_eager": "track",
    "over_vnni_limit": "track",
}
MEANING = {
    "int8_over_fp32": "INT8 / FP32 of the edge configuration at one input size",
    "edge_over_paper_fp32": "edge / paper configuration, FP32, each at its own input size",
    "ort_over_openvino": "ONNX Runtime / OpenVINO, INT8",
    "ort_over_eager": "ONNX Runtime / PyTorch eager, FP32",
    "over_vnni_limit": "INT8 / its multiply-accumulates at this machine's peak",
}


@dataclass(frozen=True)
class Ratio:
    """One case over another."""

    name: str
    stage: str
    threads: int
    value: float | None  # of 10th percentiles; None: the denominator is not known
    cpu: float | None  # of processor time; None: the denominator has none


def ratios(measured: Measured) -> list[Ratio]:
    """All ratios that the given files allow. The first file of a kind represents it."""
    return [
        ratio
        for threads in sorted({row.case.threads for row in measured.rows})
        for stage in ("track", "acquire")
        for ratio in _at(measured, stage, threads)
    ]


def _at(measured: Measured, stage: str, threads: int) -> Iterator[Ratio]:
    def first(configuration: str, precision: str, engine: str = ORT) -> Row | None:
        kind = (configuration, precision, engine, stage, threads)
        rows = (row for row in measured.rows if _kind(row) == kind)
        return next(rows, None)

    int8, fp32, paper = first("edge", "int8"), first("edge", "fp32"), first("paper", "fp32")
    same_size = int8 is not None and fp32 is not None and int8.size_wh == fp32.size_wh
    pairs = {
        "int8_over_fp32": (int8, fp32 if same_size else None),
        "edge_over_paper_fp32": (fp32, paper),
        "ort_over_openvino": (int8, first("edge", "int8", "openvino")),
        "ort_over_eager": (fp32, first("edge", "fp32", "pytorch")),
    }
    for name, (one, other) in pairs.items():
        if one is not None and other is not None:
            yield Ratio(name, stage, threads, one.ms.p10 / other.ms.p10, one.ms.cpu / other.ms.cpu)
    if int8 is not None and int8.limit_ms != 0:
        value = None if int8.limit_ms is None else int8.ms.p10 / int8.limit_ms
        yield Ratio("over_vnni_limit", stage, threads, value, None)


def _kind(row: Row) -> tuple[str, str, str, str, int]:
    return row.configuration, row.precision, row.case.engine, row.case.stage, row.case.threads


def headline(found: list[Ratio], name: str) -> float | None:
    """The single figure of a ratio: on the most threads, at its stage in HEADLINES if that was measured."""
    own = [ratio for ratio in found if ratio.name == name]
    best = max(own, key=lambda ratio: (ratio.stage == HEADLINES[name], ratio.threads), default=None)
    return best.value if best is not None else None


def stage_ms(measured: Measured, stage: str) -> float | None:
    """p50 of the first INT8 file, or of the first file if none is INT8, on the most threads; None: no such stage."""
    rows = [row for row in measured.rows if row.case.engine == ORT]
    of_model = [row for row in rows if row.precision == "int8"] or rows
    own = [row for row in of_model if row.case.file == of_model[0].case.file and row.case.stage == stage]
    return max(own, key=lambda row: row.case.threads).ms.p50 if own else None


def to_tree(measured: Measured) -> dict[str, Any]:
    """For scripts: JSON types. `null`: not measured."""
    found = ratios(measured)
    return {
        "machine": asdict(measured.machine),
        "rounds": measured.rounds,
        "statistics": STATISTICS,
        "track_ms": stage_ms(measured, "track"),
        "acquire_ms": stage_ms(measured, "acquire"),
        "ratios": {name: headline(found, name) for name in HEADLINES},
        "all_ratios": [asdict(ratio) for ratio in found],
        "peaks": [asdict(peak) for peak in measured.peaks],
        "models": [
            {
                "file": file,
                "sha256": model.sha256,
                **model.contract.model_dump(include={"name", "configuration", "precision"}),
            }
            for file, model in measured.models.items()
        ],
        "rows": [_row_tree(row) for row in measured.rows],
    }


def _row_tree(row: Row) -> dict[str, Any]:
    tree = asdict(row)
    return {**tree.pop("case"), **tree}


def table(measured: Measured) -> str:
    """For a person."""
    machine = measured.machine
    lines = [f"{machine.cpu}, {machine.cores} cores, ONNX Runtime {machine.onnxruntime}, {measured.rounds} rounds"]
    return "\n".join([*lines, "", *_ratio_lines(measured), "", *_row_lines(measured), "", *_peak_lines(measured)])


def _ratio_lines(measured: Measured) -> Iterator[str]:
    found = ratios(measured)
    yield f"{'ratios, of 10th percentiles and of processor time':64} {'stage':8} {'threads':>7} {'ratio':>7} {'CPU':>7}"
    for name, meaning in MEANING.items():
        own = [ratio for ratio in found if ratio.name == name]
        for ratio in own:
            yield f"{meaning:64} {ratio.stage:8} {ratio.threads:7d} {_known(ratio.value, 7)} {_known(ratio.cpu, 7)}"
        if not own:
            reason = "no such engine" if name in BETWEEN_ENGINES else "needs two such models"
            yield f"{meaning:64} {reason:>24}"


def _row_lines(measured: Measured) -> Iterator[str]:
    labels = told_apart(row.case.file for row in measured.rows)
    width = max(34, *map(len, labels.values()))
    yield (
        f"{'model':{width}} {'stage':8} {'input':>8} {'threads':>7} {'engine':12}"
        f" {'p10 ms':>8} {'p50 ms':>8} {'p99 ms':>8} {'CPU ms':>8} {'INT8 MMAC':>10} {'FP32 MMAC':>10} {'limit ms':>9}"
    )
    for row in measured.rows:
        case, ms = row.case, row.ms
        size = "x".join(map(str, row.size_wh))
        yield (
            f"{labels[case.file]:{width}} {case.stage:8} {size:>8} {case.threads:7d} {case.engine:12}"
            f" {ms.p10:8.2f} {ms.p50:8.2f} {ms.p99:8.2f} {ms.cpu:8.2f}"
            f" {row.macs.int8 / 1e6:10.1f} {row.macs.float32 / 1e6:10.1f} {_known(row.limit_ms, 9)}"
        )


def _peak_lines(measured: Measured) -> Iterator[str]:
    yield "peak of a large matrix product, GMAC/s"
    for peak in measured.peaks:
        doubt = ": hardly more than one, so no limit is told (other load, or one core's threads)" if peak.shared else ""
        yield f"  {peak.threads} threads: INT8 {peak.int8_gmac_per_s:.0f}, FP32 {peak.fp32_gmac_per_s:.0f}{doubt}"


def _known(value: float | None, width: int) -> str:
    return f"{'-':>{width}}" if value is None else f"{value:{width}.2f}"


def told_apart(files: Iterable[str]) -> dict[str, str]:
    """For each file its name without suffix; where another has the same, as much of its path as tells them apart."""
    paths = {file: Path(file).absolute() for file in files}
    labels = {}
    for file, path in paths.items():
        namesakes = [other for other in paths.values() if other != path and other.stem == path.stem]
        kept = 1
        while any(other.parts[-kept:] == path.parts[-kept:] for other in namesakes):
            kept += 1
        labels[file] = str(Path(*path.parts[-kept:])) if namesakes else path.stem
    return labels
