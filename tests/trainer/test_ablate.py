"""One command trains the variants, each with one thing changed, and puts them side by side."""

from __future__ import annotations

import json
import shutil
import signal
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import synthetic_sampler
import tiny
import torch
from odd_samplers import PartlyEmpty

from msgs.command_line import EXIT_INTERRUPTED
from trainer.ablate import FULL, VARIANTS, Scale, ablate, chosen, table, varied
from trainer.checkpoint import load_file, write_atomic
from trainer.cli import main
from trainer.config import ConfigError, DataConfig, load_config, parse_config
from trainer.model import PoseNet

SCALE = Scale(samples=8, size_px=64, windows=16)


def open_view(data: DataConfig, seed: int, size_px: int) -> partial:
    return synthetic_sampler.opener(seed, size_px)


def silent(_: str) -> None:
    pass


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("measured")
    ablate(tiny.config(), [FULL], SCALE, out, silent, open_view)
    return out


@pytest.fixture
def full(measured: Path, tmp_path: Path) -> Path:
    """A folder in which the variant `full` has been trained and measured."""
    return Path(shutil.copytree(measured, tmp_path / "runs"))


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: v.name)
def test_a_variant_is_another_configuration_of_the_same_code(variant) -> None:
    base, config = tiny.config(), parse_config(varied(tiny.config(), variant, SCALE), variant.name)
    differing = {k for k in base.model.model_dump() if getattr(base.model, k) != getattr(config.model, k)}
    if variant.network_of is None:
        assert differing == set(variant.change.get("model", {}))
    else:
        assert config.model == load_config(variant.network_of).model
        assert config.loss == load_config(variant.network_of).loss
    assert config.data.seed == base.data.seed
    torch.manual_seed(0)
    image = torch.randint(0, 255, (1, 64, 64, 3), dtype=torch.uint8)
    K = torch.tensor([[[900.0, 0, 32], [0, 900.0, 32], [0, 0, 1]]])
    outputs = PoseNet(config.model).eval()(image, K)
    assert all(torch.isfinite(value).all() for value in outputs)


def test_without_the_ray_a_target_off_the_axis_is_not_turned() -> None:
    """The same picture with the principal point elsewhere: the ray alone differs."""
    image = torch.randint(0, 255, (1, 64, 64, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    turns = {}
    for name in ("full", "no-ray"):
        text = varied(tiny.config(), chosen([name])[0], SCALE)
        torch.manual_seed(2)
        network = PoseNet(parse_config(text, name).model).eval()
        rotations = []
        for cx in (32.0, 432.0):
            K = torch.tensor([[[900.0, 0, cx], [0, 900.0, 32], [0, 0, 1]]])
            rotations.append(network(image, K)[5][0, 0].detach().numpy())
        turns[name] = np.abs(rotations[0] - rotations[1]).max()
    assert turns["no-ray"] < 1e-5
    assert turns["full"] > 0.1


def test_rows_are_trained_once_and_stand_in_one_table(tmp_path: Path) -> None:
    said: list[str] = []
    variants = chosen(["full", "direct-depth"])
    first = ablate(tiny.config(), variants, SCALE, tmp_path, said.append, open_view)
    assert [row["trained_samples"] for row in first["rows"].values()] == [8, 8]
    written = (tmp_path / "table.md").read_text()
    assert written == table(json.loads((tmp_path / "ablation.json").read_text()))
    assert "8 training windows of 64 px" in written
    again = ablate(tiny.config(), variants, SCALE, tmp_path, said.append, open_view)
    assert again == first
    assert json.loads((tmp_path / "full" / "log.jsonl").read_text().splitlines()[-1])["samples"] == 8
    commit = first["rows"]["full"]["commit"]
    content = load_file(tmp_path / "full")
    content["training"]["commit"] = "an-older-one"
    write_atomic(tmp_path / "full" / "weights.pt", content)
    ablate(tiny.config(), variants, SCALE, tmp_path, said.append, open_view)
    assert f"the code of `an-older-one`, `{commit}`" in (tmp_path / "table.md").read_text()
    with pytest.raises(ConfigError, match="another configuration or scale"):
        ablate(tiny.config(), [FULL], Scale(12, 64, 16), tmp_path, said.append, open_view)


def test_rows_of_other_variants_stay_where_one_is_added(full: Path) -> None:
    said: list[str] = []
    before = json.loads((full / "ablation.json").read_text())
    both = ablate(tiny.config(), chosen(["direct-depth"]), SCALE, full, said.append, open_view)
    assert list(both["rows"]) == ["full", "direct-depth"]
    assert both["rows"]["full"] == before["rows"]["full"]
    assert json.loads((full / "ablation.json").read_text()) == both
    more = ablate(tiny.config(), [FULL], Scale(8, 64, 32), full, said.append, open_view)
    assert (list(more["rows"]), more["windows"]) == (["full"], 32)
    assert said[-1] == "direct-depth: its row is dropped: it was measured on 16 windows"


def test_rows_of_another_scale_seed_or_configuration_are_not_mixed_in(full: Path) -> None:
    before = (full / "ablation.json").read_text()
    added = chosen(["direct-depth"])
    other_seed = parse_config(tiny.TOML.replace("seed = 3", "seed = 5", 1), "other seed")
    other_batches = parse_config(tiny.TOML.replace("batch_size = 4", "batch_size = 2"), "other batches")
    for config, scale, told in (
        (
            tiny.config(),
            Scale(16, 64, 16),
            r"ablation\.json: has rows of another configuration or scale",
        ),
        (other_seed, SCALE, r"ablation\.json: has rows of another configuration or scale"),
        (other_batches, SCALE, "full: contains a run of another configuration"),
    ):
        with pytest.raises(ConfigError, match=told):
            ablate(config, added, scale, full, silent, open_view)
    assert (full / "ablation.json").read_text() == before
    (full / "ablation.json").write_text(before[:20])
    with pytest.raises(ConfigError, match=r"ablation\.json: not a result of `ablate`"):
        ablate(tiny.config(), added, SCALE, full, silent, open_view)


def test_an_interrupted_variant_has_no_row_and_the_next_call_goes_on(tmp_path: Path) -> None:
    said: list[str] = []
    variants = chosen(["full", "direct-depth"])

    def interrupted_in_the_second(data: DataConfig, seed: int, size_px: int) -> partial:
        if said[-1].startswith("direct-depth:"):
            signal.raise_signal(signal.SIGINT)
        return open_view(data, seed, size_px)

    first = ablate(tiny.config(), variants, SCALE, tmp_path, said.append, interrupted_in_the_second)
    assert list(first["rows"]) == ["full"]
    assert said[-1].startswith("direct-depth: interrupted")
    whole = ablate(tiny.config(), variants, SCALE, tmp_path, said.append, open_view)
    assert [row["trained_samples"] for row in whole["rows"].values()] == [8, 8]


def test_where_every_window_holds_a_target_false_alarms_are_null_and_not_nan(tmp_path: Path) -> None:
    def full_view(data: DataConfig, seed: int, size_px: int) -> partial:
        return partial(synthetic_sampler.PlateSampler, seed, size_px, empty_share=0.0)

    result = ablate(tiny.config(), [FULL], SCALE, tmp_path, lambda _: None, full_view)
    assert result["rows"]["full"]["false_alarms"] is None
    written = [(tmp_path / "ablation.json").read_text(), *(tmp_path / "full" / "log.jsonl").read_text().splitlines()]
    assert all("NaN" not in line for line in written)
    assert json.loads(written[-1])["score_auc"] is None


def test_the_table_says_how_many_windows_were_measured_and_not_how_many_were_asked_for(tmp_path: Path) -> None:
    """Also not how many show no second aircraft: other kinds of windows have more, and would replace the rows."""

    def with_others(data: DataConfig, seed: int, size_px: int) -> partial:
        return partial(PartlyEmpty, seed, size_px)

    result = ablate(tiny.config(), [FULL], Scale(samples=8, size_px=64, windows=5), tmp_path, silent, with_others)
    assert result["windows"] == result["rows"]["full"]["windows"] == 16
    assert "16 held-out windows" in (tmp_path / "table.md").read_text()


def test_a_figure_that_was_not_measured_is_a_dash_in_the_table(measured: Path) -> None:
    result = json.loads((measured / "ablation.json").read_text())
    result["rows"]["full"]["bearing_median_deg"] = None
    assert "| – | `" in table(result)


def test_an_unknown_variant_is_named_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match="'no-such'; known variants: full, no-ray"):
        chosen(["no-such"])


def test_as_json_standard_output_holds_the_result_alone(
    full: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command measures it alone."""
    (tmp_path / "tiny.toml").write_text(tiny.TOML)
    options = ["--samples", "8", "--size", "64", "--windows", "16", "--variants", "full", "--json"]
    assert main(["ablate", "--config", str(tmp_path / "tiny.toml"), "--out", str(full), *options]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out) == json.loads((full / "ablation.json").read_text())
    assert "full: all of it" in err


def test_the_exit_code_of_an_interrupted_call_tells_that_rows_are_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(data: DataConfig, seed: int, size_px: int) -> partial:
        signal.raise_signal(signal.SIGINT)
        return open_view(data, seed, size_px)

    config = tmp_path / "tiny.toml"
    config.write_text(tiny.TOML)
    asked = ["--samples", "8", "--size", "64", "--windows", "16", "--variants", "full", "--json"]
    command = ["ablate", "--config", str(config), "--out", str(tmp_path / "out"), *asked]
    monkeypatch.setattr("trainer.ablate.ablate", partial(ablate, open_view=interrupted))
    assert main(command) == EXIT_INTERRUPTED
    assert json.loads(capsys.readouterr().out)["rows"] == {}
    monkeypatch.setattr("trainer.ablate.ablate", partial(ablate, open_view=open_view))
    assert main(command) == 0
