"""The results page: one model on the benchmark's datasets beside the paper, made again by one command."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal

from msgs.settings import read_toml
from sim_replay.datasets import open_dataset
from sim_replay.evaluation.judge import is_seen
from sim_replay.offline import InputError
from trainer.config import ConfigError, made_folder
from trainer.evaluate_dataset import DatasetRequest, evaluate_dataset

# MF-UAVPose6D, the paper's own network on its own dataset (tables of its section on results).
PAPER = {
    "rotation_error_deg": {"mean": 4.96},
    "translation_error_m": {"mean": 7.28},
    "depth_error_m": {"mean": 6.96},
    "rot_10deg": 0.909,
    "depth_5pct": 0.890,
    "pose_10deg_5pct": 0.828,
    "add_0_5d": 0.885,
}
TEST_SPLIT = "test"  # what is trained on and chosen by lies beside it
KEPT_METRICS = ("E_", "rot_", "depth_", "pose_", "bearing_", "recall", "false_alarms")
HISTORY = Path(__file__).parent / "checkpoints" / "history.jsonl"
EXPLANATION = (
    "Missed targets count as failures in every rate; mean and median errors are over detected targets. Results are for "
    "single frames; where a row says *track*, they are for the output of the daemon's tracker, which is given the own "
    "ship's attitude and position with the errors typical of an autopilot. *False / 1,000*: false positives per 1,000 "
    "frames in which no target is visible. *Pose, 95 %*: 95 % bootstrap confidence interval of Pose@10°/5 %, resampled "
    "over flights."
)
Cell = Callable[[Mapping[str, Any]], float | None]
Pictures = tuple[str | int | None, ...]  # dataset, split, every, frames, targets, mode, own ship


def _at(*keys: str, scale: float = 1.0) -> Cell:
    def cell(group: Mapping[str, Any]) -> float | None:
        value: Any = group
        for key in keys:
            value = value.get(key) if isinstance(value, Mapping) else None
        return None if value is None else scale * float(value)

    return cell


COLUMNS: tuple[tuple[str, Cell, str], ...] = (
    ("recall %", _at("recall", scale=100), ".1f"),
    ("false / 1,000", _at("false_positives_per_1000"), ".0f"),
    ("E_r mean °", _at("rotation_error_deg", "mean"), ".1f"),
    ("median °", _at("rotation_error_deg", "median"), ".1f"),
    ("Rot<10° %", _at("rot_10deg", scale=100), ".1f"),
    ("E_t mean m", _at("translation_error_m", "mean"), ".1f"),
    ("E_z mean m", _at("depth_error_m", "mean"), ".1f"),
    ("Depth<5 % %", _at("depth_5pct", scale=100), ".1f"),
    ("Pose@10°/5 % %", _at("pose_10deg_5pct", scale=100), ".1f"),
    ("ADD-0.5d %", _at("add_0_5d", scale=100), ".1f"),
    ("ADD-0.1d %", _at("add_0_1d", scale=100), ".1f"),
    ("bearing mean °", _at("bearing_error_deg", "mean"), ".3f"),
)


def datasets_in(benchmark: Path) -> list[Path]:
    """Folders with a dataset.toml in `benchmark`, sorted. Raises ConfigError if there is none."""
    found = sorted(path.parent for path in benchmark.glob("*/dataset.toml"))
    if not found:
        raise ConfigError(
            f"{benchmark}: contains no folder with a dataset.toml; generate some with uavpose-replay generate"
        )
    return found


def measure(
    models: Sequence[Path | None], datasets: Sequence[Path], say: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Scores of each model on each dataset: single frames and, where its sequences are whole, through the tracker too.

    A model that is None is the shipped INT8 file.
    """
    scores = []
    for dataset in datasets:
        split, modes = _split(dataset), _modes(dataset)
        recipe = _manifest(dataset).get("command", "")
        if recipe and split:
            recipe += f" --split {split}"
        for model in models:
            for mode in modes:
                request = DatasetRequest(model=model, dataset=dataset, split=split, mode=mode)
                score = evaluate_dataset(request).score
                scores.append({**score, "dataset": dataset.name, "recipe": recipe})
                say(f"{dataset.name}, {mode}: {score['overall']['frames']} frames, {score['method']['file']}")
    return scores


def read_beside(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Scores that `evaluate` wrote of other models or methods. Raises ConfigError where a file is none."""
    beside = []
    for path in paths:
        try:
            score = json.loads(path.read_text(encoding="utf-8"))
            _pictures(score), _called(score["method"])
        except (OSError, ValueError, LookupError, TypeError) as error:
            raise ConfigError(f"{path}: is not a metrics.json from evaluate: {error}") from error
        beside.append(score)
    return beside


def refuse_other_pictures(beside: Sequence[Mapping[str, Any]], datasets: Sequence[Path]) -> None:
    """Raises ConfigError where one beside does not tell of what is measured on any of the datasets."""
    known = {pictures for dataset in datasets for pictures in _to_judge(dataset)} if beside else set()
    for score in beside:
        if _pictures(score) not in known:
            raise ConfigError(f"{_called(score['method'])}: was evaluated on other images: {_pictures(score)}")


def _pictures(score: Mapping[str, Any]) -> Pictures:
    """What was judged, and how; scores written before own_ship and every were told have neither."""
    overall = score["overall"]
    which = score["dataset"], score["split"], score.get("every", 1), overall["frames"], overall["targets"]
    return *which, score["mode"], score.get("own_ship")


def _to_judge(dataset: Path) -> list[Pictures]:
    """The same of what `measure` makes of a dataset, by its labels alone. Raises ConfigError."""
    try:
        opened = open_dataset(dataset, _split(dataset))
        pictures = opened.labelled_frames()
    except InputError as error:
        raise ConfigError(str(error)) from error
    targets = sum(is_seen(target) for picture in pictures for target in picture.targets)
    own_ship = {"frames": None, "track": DatasetRequest().own_ship}
    which = dataset.name, opened.split, DatasetRequest().every, len(pictures), targets
    return [(*which, mode, own_ship[mode]) for mode in _modes(dataset)]


def _split(dataset: Path) -> str | None:
    return TEST_SPLIT if (dataset / TEST_SPLIT).is_dir() else None


def _modes(dataset: Path) -> tuple[Literal["frames", "track"], ...]:
    """Only a sequence that has every frame can be followed."""
    return ("frames", "track") if _manifest(dataset).get("every", 1) == 1 else ("frames",)


def _called(method: Mapping[str, Any]) -> str:
    """A model of one's own is told by its name and how long it learnt, another method by its file."""
    if method.get("name") is None:
        return str(method["file"])
    samples = method.get("training_samples")
    learnt = "" if samples is None else f", after {samples:,} windows"
    return f"{method['name']}, {method['precision']}{learnt}"


def _manifest(dataset: Path) -> dict[str, Any]:
    path = dataset / "dataset.toml"
    return read_toml(path, ConfigError) if path.is_file() else {}


def page(
    scores: Sequence[Mapping[str, Any]], command: str, trained: str, beside: Sequence[Mapping[str, Any]] = ()
) -> str:
    """Markdown: overall beside the paper and what else was measured, then each dataset by distance and by airframe."""
    models = {score["method"]["sha256"]: score["method"] for score in scores}
    kinds = [method["precision"] for method in models.values()]
    named = {
        sha256: method["precision"] + (f" `{sha256[:8]}`" if kinds.count(method["precision"]) > 1 else "")
        for sha256, method in models.items()
    }
    lines = ["# Results", "", f"{EXPLANATION} Generated by `{command}`."]
    lines += ["", *(f"- `{m['file']}`: {m['precision']}, sha256 `{sha256[:16]}`" for sha256, m in models.items())]
    for score in beside:
        sha256 = score["method"].get("sha256", "")
        lines.append(f"- {_called(score['method'])}" + (f": sha256 `{sha256[:16]}`" if sha256 else ""))
    lines += ["", trained, "", "![Held-out windows as training went on](learning.png)"]
    lines += ["", "## Overall", "", *_header("dataset", "model", "frames", "Pose, 95 %")]
    rows = [(score, named[score["method"]["sha256"]]) for score in scores]
    rows += [(score, _called(score["method"])) for score in beside]
    names = [score["dataset"] for score in scores]
    for score, called in sorted(rows, key=lambda row: names.index(row[0]["dataset"])):
        first = [f"{score['dataset']}{', track' if score['mode'] == 'track' else ''}", called]
        lines.append(_row([*first, str(score["overall"]["frames"]), _interval(score)], score["overall"]))
    lines.append(_row(["FW-UAV6DPose (the paper's own data)", "the paper, FP32", "4,500", "–"], PAPER))
    for score in scores:
        name = f"{score['dataset']}, {named[score['method']['sha256']]}, {score['mode']}"
        lines += [
            "",
            f"## {name}",
            "",
            f"`{score['recipe']}`" if score["recipe"] else "",
            "",
            *_header("range m", "targets"),
        ]
        lines += [_row([band, str(g["targets"])], g) for band, g in score["by_range"].items() if g["targets"]]
        lines += ["", *_header("airframe", "targets")]
        lines += [_row([name, str(g["targets"])], g) for name, g in score["by_airframe"].items() if g["targets"]]
    return "\n".join(lines) + "\n"


def _interval(score: Mapping[str, Any]) -> str:
    intervals = score.get("intervals_95")  # not in scores of one flight, nor in older ones
    return "{:.0f}–{:.0f}".format(*(100 * end for end in intervals["pose_10deg_5pct"])) if intervals else "–"


def _header(*first: str) -> list[str]:
    names = [*first, *(name for name, _, _ in COLUMNS)]
    return ["| " + " | ".join(names) + " |", "|" + "---|" * len(names)]


def _row(first: Sequence[str], group: Mapping[str, Any]) -> str:
    values = [(cell(group), form) for _, cell, form in COLUMNS]
    return "| " + " | ".join([*first, *("–" if v is None else f"{v:{form}}" for v, form in values)]) + " |"


def read_history(path: Path) -> list[dict[str, Any]]:
    """Validations of all training runs behind the shipped weights, in order. Raises ConfigError."""
    try:
        return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    except (OSError, json.JSONDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error


def gathered(earlier: Sequence[dict[str, Any]], runs: Sequence[Path]) -> list[dict[str, Any]]:
    """A history up to the first of the run folders, and their validations, each begun from the one before.

    Raises ConfigError.
    """
    names = {folder.name for folder in runs}
    history = list(takewhile(lambda line: line["run"] not in names, earlier))
    before = history[-1]["total_samples"] if history else 0
    for folder in runs:
        lines = [line for line in read_history(folder / "log.jsonl") if line["kind"] == "validation"]
        if not lines:
            raise ConfigError(f"{folder / 'log.jsonl'}: contains no validation")
        kept = ("samples", "size_px", "windows", *(key for key in lines[0] if key.startswith(KEPT_METRICS)))
        for line in lines:
            total = before + line["samples"]
            values = {key: None if line[key] is None else round(line[key], 5) for key in kept}
            history.append({"run": folder.name, "total_samples": total, **values})
        before = history[-1]["total_samples"]
    return history


def told(history: Sequence[Mapping[str, Any]], training: Mapping[str, str | int | float]) -> str:
    """How much training is behind the last line, and behind a model whose contract tells `training`."""
    runs = len({line["run"] for line in history})
    words = (
        f"Trained on {history[-1]['total_samples']:,} rendered windows in {runs} runs, each initialised from the "
        "weights of earlier runs (those of the run before it, or a mean of several)."
    )
    if "refined_windows" in training:
        strangers = 100 * float(training["refined_strangers"])
        words += (
            f" The refinement head was then trained alone for {training['refined_epochs']} epochs on "
            f"{training['refined_windows']:,} further windows (seed {training['refined_seed']}; {strangers:g} % of the "
            "targets are randomly generated aircraft)."
        )
    return words


def draw_history(history: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Held-out errors over training samples; a run's windows may differ from the last one's in size and airframes."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), constrained_layout=True)
    panels = (
        (("E_r_mean_deg", "E_r_median_deg"), 1.0, "rotation error, degrees"),
        (("depth_rel_mean", "depth_rel_median"), 100.0, "depth error, %"),
        (("pose_10deg_5pct", "rot_lt_10deg"), 100.0, "Pose@10°/5 % and Rot<10°, %"),
    )
    for axis, (keys, scale, title) in zip(axes, panels, strict=True):
        for run in dict.fromkeys(line["run"] for line in history):
            lines = [line for line in history if line["run"] == run]
            for key, style in zip(keys, ("-", "--"), strict=True):
                x = [line["total_samples"] / 1000 for line in lines]
                label = key if run == history[0]["run"] else None
                axis.plot(x, [scale * line[key] for line in lines], style, color=f"C{keys.index(key)}", label=label)
            axis.axvline(lines[0]["total_samples"] / 1000, color="0.85", linewidth=0.8)
        axis.set(title=title, xlabel="thousand training windows", ylim=(0, None))
        axis.legend(fontsize=7)
    figure.savefig(path, dpi=90)
    plt.close(figure)


def register(commands: argparse._SubParsersAction) -> None:
    """Add the sub-command."""
    results = commands.add_parser(
        "results",
        help="evaluate the shipped model on generated datasets and write the results page",
        description="Evaluate the shipped INT8 file (and --model files) on every dataset in a folder and write "
        "results.md, results.json and learning.png.",
    )
    results.add_argument("--benchmark", type=Path, required=True, metavar="DIR", help="folder of generated datasets")
    results.add_argument(
        "--model", type=Path, action="append", default=[], help="another ONNX file to evaluate; may be repeated"
    )
    results.add_argument(
        "--beside",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="metrics.json of evaluate for another model or method on the same images: adds a row; may be repeated",
    )
    results.add_argument("--out", type=Path, required=True, metavar="DIR", help="output folder")
    results.add_argument(
        "--runs",
        type=Path,
        nargs="+",
        metavar="DIR",
        help="run folders to append to the training history of the shipped weights, oldest first; a run that the "
        "history already contains, and all after it, are replaced",
    )
    results.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> None:
    """Measure and write. Raises ConfigError."""
    from sim_replay.offline import SHIPPED_MODEL
    from trainer.graph import read_contract

    # What can be wrong is looked at before the hours of measuring.
    history, shipped = read_history(HISTORY), read_contract(SHIPPED_MODEL).training
    if arguments.runs:
        history = gathered(history, arguments.runs)
    datasets, beside = datasets_in(arguments.benchmark), read_beside(arguments.beside)
    refuse_other_pictures(beside, datasets)
    for path in arguments.model:
        read_contract(path)
    made_folder(arguments.out)
    scores = measure([None, *arguments.model], datasets, lambda text: print(text, file=sys.stderr, flush=True))
    (arguments.out / "results.json").write_text(json.dumps(scores, indent=1) + "\n", encoding="utf-8")
    extra = "".join(f" --model {path}" for path in arguments.model)
    extra += "".join(f" --beside {path}" for path in arguments.beside)
    command = f"uavpose-trainer results --benchmark {arguments.benchmark}{extra} --out {arguments.out}"
    (arguments.out / "results.md").write_text(page(scores, command, told(history, shipped), beside), encoding="utf-8")
    draw_history(history, arguments.out / "learning.png")
    if arguments.runs:
        HISTORY.write_text("".join(json.dumps(line) + "\n" for line in history), encoding="utf-8")
