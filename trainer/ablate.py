"""Ablations: the same training with one change at a time, one table row each.

The paper's four (observation ray, eight-point context, perspective-scale depth, heatmap centre) and this project's own.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tomli_w

from trainer.checkpoint import WEIGHTS_NAME, load_file, load_model
from trainer.config import ConfigError, DataConfig, TrainerConfig, load_config, parse_config
from trainer.data import Sampler, render_once
from trainer.evaluate import measure, null_where_unknown, predict_all, torch_predictor
from trainer.sources import window_sampler
from trainer.tally import windows_in
from trainer.train import run_training

OpenView = Callable[[DataConfig, int, int], Callable[[], Sampler]]
RESULT_NAME = "ablation.json"


@dataclass(frozen=True)
class Variant:
    """A change of the configuration; `says` is the name of its table row."""

    name: str
    says: str
    change: dict[str, dict[str, Any]]
    network_of: Path | None = None  # a configuration whose network and loss replace those of the base


PAPER_CONFIG = Path(__file__).parent / "configs" / "paper.toml"
FULL = Variant("full", "all of it", {})
VARIANTS = (
    FULL,
    Variant("no-ray", "without PAM: no observation ray", {"model": {"ray": False}}),
    Variant("no-topology", "without DTS: no eight-point context", {"model": {"topology": False}}),
    Variant("direct-depth", "direct Z instead of APDD", {"model": {"depth": "direct"}}),
    Variant("regressed-center", "centre regressed, no heatmap features", {"model": {"center": "regressed"}}),
    Variant("plain-depth", "APDD's scale free of rotation", {"model": {"depth": "plain"}}),
    Variant("one-hypothesis", "one rotation hypothesis", {"model": {"hypotheses": 1}, "loss": {"hypothesis": 0.0}}),
    Variant(
        "no-dense", "no dense heads while training", {"model": {"dense": False}, "loss": {"mask": 0.0, "noc": 0.0}}
    ),
    Variant("no-uncertainty", "no refinement head", {"model": {"uncertainty": False}, "loss": {"uncertainty": 0.0}}),
    Variant("no-window", "whole reduced frames only, and measured on such", {"data": {"acquire_share": 1.0}}),
    Variant("paper", "the paper's network and loss, on the same windows", {}, PAPER_CONFIG),
)
COLUMNS = {
    "E_r_mean_deg": ("E_r mean °", 1.0, 1),
    "E_r_median_deg": ("median °", 1.0, 1),
    "rot_lt_10deg": ("Rot<10° %", 100.0, 1),
    "depth_rel_median": ("depth median %", 100.0, 1),
    "depth_lt_5pct": ("Depth<5 % %", 100.0, 1),
    "pose_10deg_5pct": ("Pose@10°/5 % %", 100.0, 1),
    "bearing_median_deg": ("bearing median °", 1.0, 3),
}


@dataclass(frozen=True)
class Scale:
    """Amount of training and evaluation of each variant."""

    samples: int
    size_px: int
    windows: int


def chosen(names: Sequence[str] | None) -> tuple[Variant, ...]:
    """Variants with these names, in the table's order; None: all. Raises ConfigError that lists the known names."""
    known = {variant.name: variant for variant in VARIANTS}
    for name in names or ():
        if name not in known:
            raise ConfigError(f"--variants: unknown variant {name!r}; known variants: {', '.join(known)}")
    return tuple(v for v in VARIANTS if names is None or v.name in names)


def varied(base: TrainerConfig, variant: Variant, scale: Scale) -> str:
    """TOML of a variant: the base configuration with its change and a single window size. Raises ConfigError."""
    tree = base.model_dump(mode="json", exclude_none=True)
    if variant.network_of is not None:
        other = load_config(variant.network_of).model_dump(mode="json", exclude_none=True)
        tree |= {section: other[section] for section in ("model", "loss")}
    for section, values in variant.change.items():
        tree[section].update(values)
    tree["schedule"].update(samples=scale.samples, sizes=[{"from_progress": 0.0, "size_px": scale.size_px}])
    tree["schedule"]["warmup_samples"] = min(base.schedule.warmup_samples, scale.samples // 10)
    tree["run"]["validate_every_samples"] = scale.samples
    return tomli_w.dumps(tree)


def ablate(
    base: TrainerConfig,
    variants: Sequence[Variant],
    scale: Scale,
    out: Path,
    say: Callable[[str], None],
    open_view: OpenView = window_sampler,
) -> dict[str, Any]:
    """Train the variants not trained yet, evaluate them on held-out windows, write ablation.json and table.md.

    Rows of other variants that are in `out` already are kept, unless they were measured on another number of windows.
    The held-out windows are the same for all, except that a variant trained only on whole reduced frames is evaluated
    on those.

    If a run is interrupted, it stops with the rows completed so far; the same call continues there. Raises ConfigError
    if `out` contains runs of another configuration or scale.
    """
    result: dict[str, Any] = {"samples": scale.samples, "size_px": scale.size_px, "windows": scale.windows, "rows": {}}
    result["seed"], result["validation_seed"] = base.data.seed, base.data.validation_seed
    result |= _earlier(out / RESULT_NAME, result)
    for variant in chosen([*result["rows"]]):
        _refuse_another_run(out / variant.name, parse_config(varied(base, variant, scale), f"variant {variant.name}"))
    for variant in variants:
        text = varied(base, variant, scale)
        config = parse_config(text, f"variant {variant.name}")
        folder = out / variant.name
        say(f"{variant.name}: {variant.says}")
        started = (folder / WEIGHTS_NAME).exists()
        _refuse_another_run(folder, config)
        if not started or int(load_model(folder)[2]["samples"]) < scale.samples:
            opener = lambda seed, size, data=config.data: open_view(data, seed, size)  # noqa: E731
            if run_training(config, text, folder, resume=started, open_sampler=opener).samples < scale.samples:
                say(f"{variant.name}: interrupted; the same command continues here")
                break
        row = {"says": variant.says, **_measured(folder, config, scale, open_view)}
        result["windows"] = int(row["windows"])  # rounded up to whole chunks
        result["rows"] = _with_row(result["rows"], variant.name, row, say)
        (out / RESULT_NAME).write_text(json.dumps(result, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        (out / "table.md").write_text(table(result), encoding="utf-8")
    return result


def _earlier(path: Path, of: dict[str, Any]) -> dict[str, Any]:
    """ablation.json, if there is one. Raises ConfigError if its rows cannot be in one table with those of a result."""
    if not path.exists():
        return {}
    try:
        earlier = json.loads(path.read_text(encoding="utf-8"))
        same = all(earlier[key] == of[key] for key in of.keys() - {"windows", "rows"})
        same &= earlier["rows"].keys() <= {variant.name for variant in VARIANTS}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path}: not a result of `ablate`; remove it or give another --out") from error
    if not same:
        raise ConfigError(f"{path}: has rows of another configuration or scale; give another --out")
    return dict(earlier)


def _refuse_another_run(folder: Path, config: TrainerConfig) -> None:
    if not (folder / WEIGHTS_NAME).exists():
        return
    if parse_config(load_file(folder)["config"], f"{folder} (config)") != config:
        raise ConfigError(f"{folder}: contains a run of another configuration or scale; give another --out")


def _with_row(rows: dict[str, Any], name: str, row: dict[str, Any], say: Callable[[str], None]) -> dict[str, Any]:
    """The rows with another one, in the table's order, without those measured on another number of windows."""
    rows = rows | {name: row}
    kept = {v.name: rows[v.name] for v in VARIANTS if v.name in rows and rows[v.name]["windows"] == row["windows"]}
    for left_out in sorted(rows.keys() - kept.keys()):
        say(f"{left_out}: its row is dropped: it was measured on {rows[left_out]['windows']:.0f} windows")
    return kept


def _measured(folder: Path, config: TrainerConfig, scale: Scale, open_view: OpenView) -> dict[str, Any]:
    """Metrics on windows of the kind the variant was trained for, with the weights' hash and the code's commit."""
    model, _, training, sha256 = load_model(folder)
    only_frames = config.data.acquire_share == 1.0
    data = config.data.model_copy(update={"acquire_share": 1.0 if only_frames else 0.0})
    batches = render_once(open_view(data, config.data.validation_seed, scale.size_px), scale.windows)
    metrics = measure(predict_all(torch_predictor(model), batches), batches)
    origin = {"weights_sha256": sha256, "trained_samples": training["samples"], "commit": training["commit"]}
    # Not only those that show no second aircraft, whose number differs between kinds of windows.
    return {**origin, **null_where_unknown(metrics), "windows": float(windows_in(batches))}


def table(result: dict[str, Any]) -> str:
    """Markdown table of the rows, and the scale at which they were run."""
    head = ["variant", *(title for title, _, _ in COLUMNS.values()), "weights"]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in result["rows"].values():
        values = ((row[key], scale, digits) for key, (_, scale, digits) in COLUMNS.items())
        cells = ["–" if value is None else f"{scale * value:.{digits}f}" for value, scale, digits in values]
        lines.append("| " + " | ".join([row["says"], *cells, f"`{row['weights_sha256'][:12]}`"]) + " |")
    commits = ", ".join(f"`{commit}`" for commit in dict.fromkeys(row["commit"] for row in result["rows"].values()))
    scale = (
        f"Trained with the code of {commits}: {result['samples']} training windows of {result['size_px']} px each "
        f"(seed {result['seed']}), {result['windows']} held-out windows (seed {result['validation_seed']})."
    )
    return "\n".join([*lines, "", scale, ""])
