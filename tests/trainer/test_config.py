"""Wrong configurations and commands are answered with one sentence that names what is wrong."""

from __future__ import annotations

from pathlib import Path

import pytest
import tiny

import trainer
from trainer.cli import main
from trainer.config import ConfigError, load_config, parse_config

CONFIGS = Path(trainer.__file__).parent / "configs"


def test_shipped_configurations_are_valid_and_say_which_they_are() -> None:
    assert load_config(CONFIGS / "edge.toml").model.configuration == "edge"
    paper = load_config(CONFIGS / "paper.toml")
    assert paper.model.backbone == "repvit_m0_9"
    assert (paper.loss.heatmap, paper.loss.size, paper.loss.translation, paper.loss.rotation) == (50, 4, 4, 25)
    assert paper.data.airframe_ids == load_config(CONFIGS / "edge.toml").data.airframe_ids
    assert (paper.loss.depth, paper.loss.planar, paper.loss.rotation_6d, paper.model.origin_range) == (20, 50, 5, 1.25)


@pytest.mark.parametrize("name", ["flights.toml", "flights_cuda.toml"])
def test_the_flights_continue_the_training_of_the_network_that_ships(name: str) -> None:
    edge, flights = (load_config(CONFIGS / file) for file in ("edge.toml", name))
    assert (flights.model, flights.contract) == (edge.model, edge.contract)
    assert flights.data.airframe_ids == edge.data.airframe_ids
    assert 0.0 < flights.data.flown_share < 1.0


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("channels = 16", "chanels = 16", "model.chanels"),
        ("batch_size = 4", 'batch_size = "many"', "data.batch_size"),
        ("validation_seed = 4", "validation_seed = 3", "data: "),
        ("seed = 3\n", "seed = 4294967296\n", "data.seed: must be less than 4294967296"),
        ("mask = 1.0", "mask = inf", "loss.mask: must be a finite number"),
        ("size_px = 96", "size_px = 100", "schedule.sizes.1.size_px"),
        ("pretrained = false", "pretrained = true", "repvit_small"),
        ("[contract]", "[contract", "not valid TOML"),
        ("batch_size = 4", "batch_size = 4\nairframe_ids = [0, 21]", "data.airframe_ids: "),
        ("batch_size = 4", "batch_size = 4\nairframe_ids = [-1]", "the fleet's numbers, 0 to 20, each once"),
        ("batch_size = 4", "batch_size = 4\nairframe_ids = []", "data.airframe_ids: "),
        ("batch_size = 4", "batch_size = 4\nairframe_ids = [3, 3]", "data.airframe_ids: "),
        (
            "batch_size = 4",
            "batch_size = 4\nairframe_ids = [3]\nhard_airframe_ids = [4]",
            "must be some of airframe_ids",
        ),
        ("batch_size = 4", "batch_size = 4\nflown_share = 0.5", "flown and flown_share need each other"),
        ("batch_size = 4", 'batch_size = 4\nflown = ["data/flown"]', "flown and flown_share need each other"),
        ("acquire_size_wh = [128, 96]", "acquire_size_wh = [1280, 720]", "contract.acquire_size_wh.1: "),
        ("acquire_size_wh = [128, 96]", "acquire_size_wh = [0, 96]", "contract.acquire_size_wh.0: "),
        ("track_size_wh = [64, 64]", "track_size_wh = [200, 200]", "contract.track_size_wh.0: "),
        ("track_size_wh = [64, 64]", "track_size_wh = [224, 192]", "contract: track_size_wh must be square"),
        ('acquire_fit = "letterbox"', 'acquire_fit = "squash"', 'data.acquire_view = "frame"'),
        ("batch_size = 4", 'batch_size = 4\nacquire_view = "frame"', 'contract.acquire_fit = "squash"'),
    ],
)
def test_a_mistake_is_named_with_its_file_and_key(old: str, new: str, named: str) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_config(tiny.TOML.replace(old, new), "mine.toml")
    assert str(caught.value).startswith("mine.toml: ")
    assert named in str(caught.value)


@pytest.mark.parametrize(
    "arguments",
    [
        ["train", "--config", "{tmp}/none.toml", "--out", "{tmp}/run"],
        ["export", "--checkpoint", "{tmp}/none", "--out", "{tmp}/models"],
        ["evaluate", "--onnx", "{tmp}/none.onnx"],
    ],
)
def test_commands_end_with_2_and_a_sentence(
    arguments: list[str], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main([word.format(tmp=tmp_path) for word in arguments]) == 2
    message = capsys.readouterr().err
    assert message.startswith("uavpose-trainer: ")
    assert f"{tmp_path}/none" in message
    assert message.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "told"),
    [
        ("train --samples 0", "--samples: '0' is not an integer of at least 1"),
        ("train --budget-minutes nan", "--budget-minutes: 'nan' is not a number above 0"),
        ("refine --seed 2147483648", "--seed: '2147483648' is not an integer from 0 to 2147483647"),
        ("refine --strangers 35", "--strangers: '35' is not a number from 0 to 1"),
        ("export --samples many", "--samples: 'many' is not an integer of at least 1"),
    ],
)
def test_a_number_out_of_bounds_is_told_with_the_bounds(
    words: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words.split())
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith(f"argument {told}\n")
