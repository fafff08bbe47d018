"""Refining: the head learns what answers are off by and how sure they are; nothing else of the network moves."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import tiny
import torch
from odd_samplers import Filling, NoTargets, PartlyEmpty

from msgs.contract import OUTPUT_NAMES
from sim_replay.airframes.invented import draw_invented
from tests.sim_replay.foreign import write_json, write_models_info, write_scene
from trainer.checkpoint import load_file, load_model, save_weights, write_atomic
from trainer.cli import main
from trainer.config import REFINED_HEADS, ConfigError, DataConfig, DatasetSource
from trainer.equations import heatmap_peaks
from trainer.graph import open_session, write_graph
from trainer.losses import pose_residual, to_tensors
from trainer.refine import fleet_size, look, refine
from trainer.refine_plan import RefinePlan
from trainer.sources import refinement_sampler, trained_scenes

PLAN = RefinePlan(seed=11, windows=96, epochs=2, strangers=0.5, heads=REFINED_HEADS)


def open_plates(data: DataConfig, seed: int, size_px: int, strangers: float, *_: object) -> Callable[[], Filling]:
    assert (seed, size_px, strangers) == (PLAN.seed, tiny.config().schedule.sizes[-1].size_px, PLAN.strangers)
    return partial(Filling, seed, size_px)


def open_others(data: DataConfig, seed: int, size_px: int, strangers: float, *_: object) -> Callable[[], Filling]:
    return partial(Filling, seed, size_px)


def open_empty(data: DataConfig, seed: int, size_px: int, strangers: float, *_: object) -> Callable[[], NoTargets]:
    return partial(NoTargets, seed, size_px)


def write_run(folder: Path, toml: str = tiny.TOML) -> Path:
    folder.mkdir()
    save_weights(folder / "weights.pt", tiny.network(3), toml, {"samples": 5, "steps": 2})
    return folder


def silent(_: str) -> None:
    pass


def test_the_head_alone_is_another_and_the_same_seed_makes_the_same(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    one, again = (refine(run, tmp_path / n, PLAN, open_sampler=open_plates, say=silent) for n in ("one", "again"))
    before, after = load_file(run)["weights"], load_file(one)["weights"]
    assert {name.split(".")[0] for name in after.keys() - before.keys()} == {"head_presence", "head_choice"}
    moved = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert moved == {"head_refine"}
    assert load_model(one)[3] == load_model(again)[3] != load_model(run)[3]
    told = load_model(one)[2]
    assert told["samples"] == 5
    assert told["refined_from"] == load_model(run)[3][:16]
    of_plan = ("seed", "windows", "epochs", "strangers")
    for head in ("refined", "presence", "choice"):
        assert {name: told[f"{head}_{name}"] for name in of_plan} == {name: getattr(PLAN, name) for name in of_plan}
    assert told["refined_dataset_share"] == 0.0


@pytest.mark.parametrize("head", ["presence", "choice"])
def test_an_added_head_may_be_trained_alone_also_again(tmp_path: Path, head: str) -> None:
    refined = refine(write_run(tmp_path / "run"), tmp_path / "refined", PLAN, open_sampler=open_plates, say=silent)
    alone, said = PLAN._replace(seed=12, heads=(head,)), list[str]()
    again = refine(refined, tmp_path / "again", alone, open_sampler=open_others, say=said.append)
    few = [line for line in said if line.startswith("WARNING: 15 of the 96 peaks are of no target: too few")]
    assert len(few) == (head == "presence")
    before, after = load_file(refined)["weights"], load_file(again)["weights"]
    assert before.keys() == after.keys()
    assert {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])} == {f"head_{head}"}
    told = load_model(again)[2]
    assert (told["refined_seed"], told[f"{head}_seed"]) == (PLAN.seed, 12)
    assert told[f"{head}_from"] == load_model(refined)[3][:16]


def test_a_presence_head_beside_another_leaves_it_as_it_is_and_the_score_is_the_mean(tmp_path: Path) -> None:
    refined = refine(write_run(tmp_path / "run"), tmp_path / "one", PLAN, open_sampler=open_plates, say=silent)
    plan = PLAN._replace(seed=12, heads=("presence",))
    second = refine(refined, tmp_path / "instead", plan, open_sampler=open_others, say=silent)
    both = refine(refined, tmp_path / "both", plan._replace(beside=True), open_sampler=open_others, say=silent)
    of_one, of_second, of_both = (load_file(path)["weights"] for path in (refined, second, both))
    assert all(torch.equal(of_both[name], value) for name, value in of_one.items())
    more = {name: value for name, value in of_both.items() if name not in of_one}
    assert {name.replace("beside.0.", "") for name in more} == {n for n in of_one if n.startswith("head_presence.")}
    assert all(torch.equal(value, of_second[name.replace("beside.0.", "")]) for name, value in more.items())
    image, labels = tiny.batch(3)
    with torch.no_grad():
        odds = [torch.logit(load_model(path)[0](image, labels.K)[0].double()) for path in (refined, second, both)]
    torch.testing.assert_close(odds[2], (odds[0] + odds[1]) / 2, rtol=1e-3, atol=1e-3)
    write_graph(load_model(both)[0], tmp_path / "graph.onnx")
    ran = open_session(tmp_path / "graph.onnx").run(["score"], {"image": image.numpy(), "K": labels.K.numpy()})[0]
    np.testing.assert_allclose(ran, torch.sigmoid(odds[2]).numpy(), rtol=1e-3, atol=1e-3)
    told = load_model(both)[2]
    assert (told["presence_seed"], told["presence_beside_1_seed"]) == (PLAN.seed, 12)
    again = refine(both, tmp_path / "again", plan, open_sampler=open_others, say=silent)
    assert load_file(again)["weights"].keys() == of_one.keys(), "one in place of both"
    assert not any(key.startswith("presence_beside") for key in load_model(again)[2])


def test_beside_no_presence_head_there_is_none(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    beside = PLAN._replace(heads=("presence",), beside=True)
    with pytest.raises(ConfigError, match="has no presence head for another one to be beside"):
        refine(run, tmp_path / "out", beside, open_sampler=open_plates, say=silent)
    with pytest.raises(ConfigError, match="only that of presence can be several"):
        refine(
            run, tmp_path / "out", beside._replace(heads=("presence", "choice")), open_sampler=open_plates, say=silent
        )


def test_weights_from_before_there_was_such_a_head_are_refined_all_the_same(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    content = load_file(run)
    older = {name: value for name, value in content["weights"].items() if not name.startswith("head_refine.")}
    write_atomic(run / "weights.pt", content | {"weights": older | {"head_sigma_t.0.weight": torch.zeros(8, 32)}})
    load_model(refine(run, tmp_path / "out", PLAN, open_sampler=open_plates, say=silent))


def test_flights_to_render_anew_that_are_not_there_are_told_before_anything_is_rendered() -> None:
    data = DataConfig(seed=1, validation_seed=2, batch_size=8, flown=[Path("/no/longer/there")], flown_share=0.5)
    with pytest.raises(ConfigError, match="/no/longer/there"):
        refinement_sampler(data, 12, 96, 0.35)


def test_its_strangers_are_none_that_training_draws() -> None:
    """Two of three are asked to be strangers, and two of five windows to be empty."""
    data = DataConfig(seed=1, validation_seed=2, batch_size=8, airframe_ids=[0, 3, 6], empty_share=0.4)
    batch = refinement_sampler(data, 12, 96, 2 / 3)().batch(0, 40)
    strange = batch.airframe_id >= fleet_size()
    assert 0.35 < batch.present.mean() < 0.8
    assert 0.4 < strange[batch.present].mean() < 0.9
    names = {int(number) for number in batch.airframe_id[strange]}
    of_training = {draw_invented(np.random.default_rng(k), data.airframe_ids or []) for k in range(400)}
    assert names
    assert not names & of_training


def write_splits(root: Path, *splits: str) -> None:
    """A dataset with a scene in each split."""
    write_models_info(root)
    for number, split in enumerate(splits):
        write_scene(root / split / f"{number:06d}")


def run_on(folder: Path, path: Path) -> Path:
    """A run that was trained on the split train of a dataset."""
    named = f'[data]\ndatasets = [{{ path = "{path}", share = 0.5 }}]\n'
    return write_run(folder, tiny.TOML.replace("[data]\n", named))


def refine_on(run: Path, path: Path, split: str | None = None) -> None:
    plan = PLAN._replace(datasets=(path,), split=split)
    refine(run, run.with_name("out"), plan, open_sampler=open_plates, say=silent)


def test_images_that_the_network_was_trained_on_are_refused(tmp_path: Path) -> None:
    own = tmp_path / "own"
    write_splits(own, "train_pbr", "val")
    run = run_on(tmp_path / "run", own)
    for folder in ("run/../own", "own/train_pbr", "own/train_pbr/000000", "."):
        with pytest.raises(ConfigError, match=r"--dataset .*: the network was trained on it; give another"):
            refine_on(run, tmp_path / folder)
    refine_on(run, own / "val")
    refine_on(run, own, "val")
    told = load_model(run.with_name("out"))[2]
    assert {told[f"{head}_datasets"] for head in ("refined", "presence", "choice")} == {"own, split val"}


def test_images_that_the_network_was_trained_on_are_refused_where_they_are_linked_or_lie_deeper(
    tmp_path: Path,
) -> None:
    """A split may be a link to another disk, and the dataset a folder below the one that training was given."""
    own, disk = tmp_path / "unpacked" / "own", tmp_path / "disk" / "hawks"
    write_splits(own, "val")
    write_scene(disk / "000007")
    (own / "train").symlink_to(disk)
    for number, trained_on in enumerate((own, own.parent)):
        run = run_on(tmp_path / f"run{number}", trained_on)
        for given in (own, own / "train", own / "train" / "000007", disk, disk / "000007"):
            with pytest.raises(ConfigError, match=r"--dataset .*: the network was trained on it; give another"):
                refine_on(run, given)
        refine_on(run, own / "val")


def test_that_training_images_are_not_where_they_were_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A relative path is one of the working directory that training had."""
    write_splits(tmp_path / "own", "train", "val")
    trained_on = DatasetSource(path=Path("own"), share=0.5)
    monkeypatch.chdir(tmp_path)
    assert trained_scenes(trained_on) == {tmp_path.resolve() / "own" / "train" / "000000"}
    assert not caplog.messages
    monkeypatch.chdir(tmp_path / "own")
    assert trained_scenes(trained_on) == set()
    (told,) = caplog.messages
    assert told.startswith(f"own is not a folder in {Path.cwd()}: the network was trained on it")


def test_a_test_split_is_refined_on_only_if_named(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    write_splits(tmp_path / "other", "train", "test")
    with pytest.raises(ConfigError, match=r"--dataset .*other: contains the split 'test', .* --split"):
        refine_on(run, tmp_path / "other")
    with pytest.raises(ConfigError, match=r"--dataset .*other: no split 'val'; it has test, train"):
        refine_on(run, tmp_path / "other", "val")
    refine_on(run, tmp_path / "other", "train")
    refine_on(run, tmp_path / "other" / "test")


def test_the_command_takes_the_split_and_the_share_of_its_datasets(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    own = tmp_path / "own"
    write_splits(own, "train", "val")
    asked = f"refine --checkpoint {run_on(tmp_path / 'run', own)} --out {tmp_path / 'out'} --seed 11 --dataset {own}"
    for more, told in (
        ("--dataset-share 0.3", "the network was trained on it; give another, or another --split"),
        ("--dataset-share 0.3 --split test", "no split 'test'; it has train, val"),
    ):
        assert main(f"{asked} {more}".split()) == 2
        assert capsys.readouterr().err == f"uavpose-trainer: --dataset {own}: {told}\n"


def test_the_command_takes_flights_and_the_heads_to_train(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = f"refine --checkpoint {write_run(tmp_path / 'run')} --out {tmp_path / 'out'} --seed 11"
    nowhere = tmp_path / "nowhere"
    assert main(f"{asked} --heads choice --flown {nowhere}".split()) == 2
    assert str(nowhere) in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(f"{asked} --heads rotation".split())
    assert "choose from refinement, presence, choice" in capsys.readouterr().err.replace("'", "")


def test_windows_are_cut_from_the_split_that_is_named(tmp_path: Path) -> None:
    write_splits(tmp_path, "train", "val")
    target = json.loads((tmp_path / "val" / "000001" / "scene_gt.json").read_text())
    target["0"][0]["cam_t_m2c"][2] = 4e5
    write_json(tmp_path / "val" / "000001" / "scene_gt.json", target)
    data = DataConfig(seed=1, validation_seed=2, batch_size=8, airframe_ids=[0])
    batch = refinement_sampler(data, 12, 32, 0.0, (tmp_path,), 1.0, "val")().batch(0, 8)
    assert set(batch.t_cam_target_m[batch.present, 2]) == {400.0}


def test_what_is_kept_tells_which_of_the_found_are_strangers() -> None:
    kept = look(tiny.network(3).eval(), tiny.config(), partial(Filling, 7, 96, 0.0), 96, silent)
    assert kept.residual.shape == (96, 6)
    assert kept.strange.tolist() == [index % 3 == 0 for index in range(96)]
    assert kept.target.all()


def test_peaks_of_no_target_are_kept_as_such_unless_they_may_be_another_aircraft() -> None:
    """Of six windows four are targets, one is empty, and one is empty but for an aircraft without labels."""
    network = tiny.network(3).eval()
    kept = look(network, tiny.config(), partial(PartlyEmpty, 7, 96), 96, silent)
    kinds = [index % 6 for index in range(96)]
    assert kept.target.tolist() == [kind < 4 for kind in kinds if kind < 5]
    image, _ = to_tensors(PartlyEmpty(7, 96).batch(0, 8), torch.device("cpu"))
    with torch.no_grad():
        score = network(image, torch.eye(3).repeat(8, 1, 1))[0][:, 0]
    torch.testing.assert_close(kept.score[:7], score[[0, 1, 2, 3, 4, 6, 7]], rtol=0.05, atol=1e-3)


def test_a_correction_by_what_an_answer_is_off_by_makes_the_truth() -> None:
    """The truth here lies a tenth of a box right of the answer, a twentieth above it, and e^0.2 times as far."""
    network = tiny.network(3).eval()
    image, labels = tiny.batch(8)
    off = torch.tensor([0.1, -0.05, 0.2])
    with torch.no_grad():
        seen = network.perceive(image)
        out = network.decode(seen, labels.K, heatmap_peaks(torch.sigmoid(seen.heat_logits), 1)[1])
        side_px = torch.sqrt(torch.exp(out.log_size[:, 0]).prod(-1, keepdim=True))
        point = torch.cat([out.origin_px[:, 0] + side_px * off[:2], torch.ones(8, 1)], dim=-1)
        true_m = torch.exp(out.log_Z + off[2]) * torch.linalg.solve(labels.K, point[..., None])[..., 0]
        truth = labels._replace(t_cam_target_m=true_m, R_cam_target=out.R_ego[:, 0])
        residual = pose_residual(out, truth)
        torch.testing.assert_close(residual[:, :3], -off.expand(8, 3), rtol=1e-3, atol=1e-4)
        assert network.head_refine is not None
        network.head_refine.range.bias.copy_(-residual[:, 2].mean())
        _, _, _, _, t_m, _, _ = network(image, labels.K)
    told = (true_m[:, 2] > 50) & (true_m[:, 2] < 600)
    assert told.any()
    torch.testing.assert_close(t_m[told, 0, 2], true_m[told, 2], rtol=1e-3, atol=1e-2)


def test_what_cannot_be_refined_is_a_sentence(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    with pytest.raises(ConfigError, match="--seed 3: was used to train or validate the network"):
        refine(run, tmp_path / "out", PLAN._replace(seed=3), open_sampler=open_plates, say=silent)
    with pytest.raises(ConfigError, match="detected 0 targets in 96 windows: too few"):
        refine(run, tmp_path / "out", PLAN, open_sampler=open_empty, say=silent)
    unsure = write_run(tmp_path / "unsure", tiny.TOML.replace("uncertainty = true", "uncertainty = false"))
    with pytest.raises(ConfigError, match="uncertainty is false"):
        refine(unsure, tmp_path / "out", PLAN, open_sampler=open_plates, say=silent)
    write_atomic(tmp_path / "going" / "resume.pt", {})
    with pytest.raises(ConfigError, match="a run that can be resumed"):
        refine(run, tmp_path / "going", PLAN, open_sampler=open_plates, say=silent)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="file is a file"):
        refine(run, tmp_path / "file", PLAN, open_sampler=open_plates, say=silent)
    content = load_file(run)
    write_atomic(run / "weights.pt", content | {"weights": {**content["weights"], "head_trans.weight": torch.zeros(1)}})
    with pytest.raises(ConfigError, match="do not match the network"):
        refine(run, tmp_path / "out", PLAN, open_sampler=open_plates, say=silent)
    assert not (tmp_path / "out" / "weights.pt").exists()


def test_a_refined_network_s_graph_says_the_presence_head_s_scores(tmp_path: Path) -> None:
    run = write_run(tmp_path / "run")
    refined = refine(run, tmp_path / "out", PLAN, open_sampler=open_plates, say=silent)
    network = load_model(refined)[0]
    assert network.head_presence is not None
    with torch.no_grad():
        network.head_presence.gain.fill_(0.5)
    image, labels = tiny.batch(3)
    write_graph(network, tmp_path / "graph.onnx")
    feeds = {"image": image.numpy(), "K": labels.K.numpy()}
    ran = open_session(tmp_path / "graph.onnx").run(list(OUTPUT_NAMES), feeds)
    outputs = dict(zip(OUTPUT_NAMES, ran, strict=True))
    with torch.no_grad():
        expected = dict(zip(OUTPUT_NAMES, network(image, labels.K), strict=True))
        network.head_presence = None
        plain = dict(zip(OUTPUT_NAMES, network(image, labels.K), strict=True))
    for name in OUTPUT_NAMES:
        np.testing.assert_allclose(outputs[name], expected[name].numpy(), rtol=1e-3, atol=1e-3)
        if name != "score":
            torch.testing.assert_close(expected[name], plain[name])
    assert not torch.allclose(expected["score"], plain["score"], atol=1e-3)
