"""`uavpose-trainer refine`: train up to three heads of a trained network alone, all other weights fixed.

The heads' inputs are cached: each window is rendered and evaluated once, and used in every epoch.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from trainer import equations as eq
from trainer.checkpoint import (
    RESUME_NAME,
    TRAINING_ONLY_PREFIX,
    WEIGHTS_NAME,
    added_heads,
    load_file,
    presence_beside,
    save_weights,
    weights_sha256,
)
from trainer.choice import ChoiceHead, choice_nll
from trainer.config import (
    ConfigError,
    DataConfig,
    TrainerConfig,
    made_folder,
    parse_config,
    refuse_no_folder,
)
from trainer.data import Feed, Sampler, TrainingBatch
from trainer.heads import TOLD_PREFIX, TOLD_PREFIX_BESIDE
from trainer.losses import pose_residual, refinement_nll, to_tensors
from trainer.model import Perception, PoseNet
from trainer.presence import PresenceHead
from trainer.refine_plan import RefinePlan, refined_on, refuse_beside
from trainer.refinement import RANGE, Evidence, RefinementHead
from trainer.runlog import provenance
from trainer.sources import refinement_sampler

# The module of each of REFINED_HEADS.
HEADS = {"refinement": "head_refine", "presence": "head_presence", "choice": "head_choice"}
EMPTY_SHARE = 0.5  # of the rendered windows: what the presence head tells targets from
RENDERED_AT_ONCE = 32
BATCH = 512
HELD_OUT_SHARE = 0.04
FEWEST = 50  # targets; also peaks of none, which the presence head learns from
LEARNING_RATE, WEIGHT_DECAY = 2e-3, 0.2
# The choice is learnt from few windows in which the network errs, so it overfits sooner.
DROPOUT, DROPOUT_OF_CHOICE = 0.3, 0.5
# How far from the network's own log-odds towards those that the choice head has learnt: half the way, most is gained of
# what it knows better, and little lost where only the network is sure (docs/ablation.md#choice).
CHOICE_SHARE = 0.5


class Kept(NamedTuple):
    """Training data: N peaks, of targets or not, the evidence in half precision."""

    evidence: Evidence
    residual: Tensor  # [N, 6]; only those of targets count
    strange: Tensor  # [N], bool: a generated airframe, not one of the fleet
    score: Tensor  # [N], the heatmap's
    target: Tensor  # [N], bool: the peak is of the labelled target
    angle_rad: Tensor  # [N, K], of each hypothesis to the truth; only those of targets count

    def rows(self, which: Tensor | slice) -> Kept:
        """The selected rows, in single precision."""
        evidence = Evidence(*(value[which].float() for value in self.evidence))
        return Kept(evidence, *(value[which] for value in self[1:]))


def refine(
    checkpoint: Path,
    out: Path,
    plan: RefinePlan,
    *,
    open_sampler: Callable[
        [DataConfig, int, int, float, tuple[Path, ...], float, str | None], Callable[[], Sampler]
    ] = refinement_sampler,
    say: Callable[[str], None] = print,
) -> Path:
    """Write weights.pt with newly trained heads into `out`; returns its path. Raises ConfigError.

    A choice is learnt only where there is one: from networks with several hypotheses.
    """
    content = load_file(checkpoint)
    if not {"weights", "config", "training"} <= content.keys():
        raise ConfigError(f"{checkpoint}: contains no weights; give the run folder or its {WEIGHTS_NAME}")
    config = parse_config(content["config"], f"{checkpoint} (config)")
    if plan.seed in (config.data.seed, config.data.validation_seed):
        raise ConfigError(f"--seed {plan.seed}: was used to train or validate the network; give another")
    refuse_no_folder(out)
    if (out / RESUME_NAME).exists():
        raise ConfigError(f"{out}: contains a run that can be resumed; give another --out")
    torch.set_num_threads(config.run.threads)
    commit = provenance(config)["commit"]
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    trained = [head for head in HEADS if head in plan.heads and (head != "choice" or config.model.hypotheses > 1)]
    if not trained:
        raise ConfigError(f"{checkpoint}: has one rotation hypothesis, so there is no choice to train")
    if plan.beside:
        refuse_beside(plan.heads, content["weights"], checkpoint)
    replaced = set() if plan.beside else {HEADS[head] for head in trained}
    model = network_to_refine(config, content["weights"], checkpoint, replaced)
    torch.manual_seed(plan.seed)
    shape = config.model.channels, config.model.hidden, config.model.hypotheses
    heads = Heads(
        RefinementHead(*shape).to(device).eval() if "refinement" in trained else None,
        PresenceHead(*shape).to(device).eval() if "presence" in trained else None,
        ChoiceHead(*shape).to(device).eval() if "choice" in trained else None,
    )
    model.to(device)
    images_of = refined_on(plan, config.data)
    size_px = config.schedule.sizes[-1].size_px
    from_datasets = plan.datasets, plan.dataset_share, plan.split
    data = config.data.model_copy(update={"empty_share": EMPTY_SHARE if "presence" in trained else 0.0})
    if plan.flown:
        data = data.model_copy(update={"flown": list(plan.flown), "flown_share": plan.flown_share})
    opener = open_sampler(data, plan.seed, size_px, plan.strangers, *from_datasets)
    kept = look(model, config, opener, plan.windows, say)
    if heads.presence is not None and (others := int((~kept.target).sum())) < FEWEST:
        say(
            f"WARNING: {others} of the {len(kept.target)} peaks are of no target: too few to learn what is none. "
            "The presence head may take anything for one; give images without a target, or a smaller --dataset-share"
        )
    learnt = int(len(kept.residual) * (1.0 - HELD_OUT_SHARE))
    fit(heads, kept, learnt, plan.epochs, say)
    if plan.beside:
        assert model.head_presence is not None
        assert heads.presence is not None
        model.head_presence.beside.append(heads.presence)
    else:
        for module_name, head in zip(HEADS.values(), heads, strict=True):
            if head is not None:
                setattr(model, module_name, head)
    said = {
        "from": weights_sha256(content["weights"])[:16],
        "windows": plan.windows,
        "epochs": plan.epochs,
        "seed": plan.seed,
        "strangers": plan.strangers,
        "dataset_share": plan.dataset_share if plan.datasets else 0.0,
        "datasets": "; ".join(images_of),
        "flown_share": data.flown_share if data.flown else 0.0,
        "commit": commit,
    }
    before = content["training"]
    prefixes = [TOLD_PREFIX[head] for head in trained]
    if plan.beside:
        prefixes = [f"{TOLD_PREFIX_BESIDE}{1 + presence_beside(content['weights'])}"]
    elif "presence" in trained:
        before = {key: value for key, value in before.items() if not key.startswith(TOLD_PREFIX_BESIDE)}
    training = before | {f"{prefix}_{key}": value for prefix in prefixes for key, value in said.items()}
    made_folder(out)
    save_weights(out / WEIGHTS_NAME, model, content["config"], training)
    return out / WEIGHTS_NAME


def network_to_refine(config: TrainerConfig, weights: dict[str, Any], named: Path, trained: Collection[str]) -> PoseNet:
    """The trained network without what is to be trained: of the modules `trained`, a refinement head is untrained, the
    others are missing. Raises ConfigError if the network has no refinement head, or lacks weights.
    """
    dense = any(key.startswith(TRAINING_ONLY_PREFIX) for key in weights)  # deployed weights have none
    added = set(added_heads(weights)) - set(trained)
    own = config.model.model_copy(update={"pretrained": False, "dense": config.model.dense and dense})
    model = PoseNet(own, added, presence_beside(weights))
    if model.head_refine is None:
        raise ConfigError(f"{named}: [model] uncertainty is false: the network has no refinement head")
    kept = {key: value for key, value in model.state_dict().items() if key.partition(".")[0] not in trained}
    for key in kept:
        if key not in weights or weights[key].shape != kept[key].shape:
            raise ConfigError(f"{named}: its weights do not match the network that its [model] describes")
    given = {key: value for key, value in weights.items() if key in kept}
    model.load_state_dict(given, strict=False)
    return model.eval().requires_grad_(False)


def look(
    model: PoseNet, config: TrainerConfig, opener: Callable[[], Sampler], windows: int, say: Callable[[str], None]
) -> Kept:
    """Evaluate the network on windows, decode the highest peak as in flight, keep it unless it may be an aircraft
    without labels. Raises ConfigError if too few are of targets."""
    found: list[Tensor] = []  # the kept rows; allocated when the first batch gives their shapes
    count = 0
    starts = range(0, windows, RENDERED_AT_ONCE)
    workers, prefetch = config.data.workers, config.data.prefetch
    with Feed(opener, RENDERED_AT_ONCE, 0, workers, prefetch, batches=len(starts)) as feed, torch.no_grad():
        for done in starts:
            part = _found(model, config, feed.next())
            columns = [*part.evidence, *part[1:]]
            if not found:
                room = windows + RENDERED_AT_ONCE
                found = [one.new_empty((room, *one.shape[1:])) for one in columns]
            for whole, one in zip(found, columns, strict=True):
                whole[count : count + len(one)] = one
            count += len(part.residual)
            if done % (100 * RENDERED_AT_ONCE) == 0:
                say(f"{done} of {windows} windows evaluated")
    columns = [whole[:count] for whole in found]
    kept = Kept(Evidence(*columns[: len(Evidence._fields)]), *columns[len(Evidence._fields) :])
    if kept.target.sum() < FEWEST:
        raise ConfigError(f"the network detected {kept.target.sum()} targets in {windows} windows: too few to train on")
    return kept


def _found(model: PoseNet, config: TrainerConfig, batch: TrainingBatch) -> Kept:
    device = next(model.parameters()).device
    image, labels = to_tensors(batch, device)
    with torch.autocast(device.type, torch.bfloat16, enabled=config.run.bf16):
        perceived = model.perceive(image)
    perceived = Perception(perceived.F_global.float(), perceived.heat_logits.float())
    score, peaks_xy = eq.heatmap_peaks(torch.sigmoid(perceived.heat_logits), 1)
    out, seen = model.decode_with_evidence(perceived, labels.K, peaks_xy)
    off_px = (out.center_px[:, 0] - labels.center_px).abs()
    residual = pose_residual(out, labels)
    hit = (labels.present > 0) & (off_px < 0.5 * labels.size_px).all(-1)
    target = hit & residual.isfinite().all(-1)
    kept = target | ~(hit | labels.others.any(-1).any(-1))
    evidence = Evidence(*(value[kept].half() for value in seen))
    strange = labels.airframe_id >= fleet_size()
    angle_rad = eq.rotation_angle(out.R_ego_k[:, 0], labels.R_cam_target[:, None])
    return Kept(evidence, residual[kept], strange[kept], score[kept, 0], target[kept], angle_rad[kept])


def fleet_size() -> int:
    """Number of named airframes; ids of generated ones start there."""
    from sim_replay.airframes import AIRFRAMES

    return len(AIRFRAMES)


class Heads(NamedTuple):
    """What is trained, in the order of HEADS; None: stays as it is."""

    refine: RefinementHead | None = None
    presence: PresenceHead | None = None
    choice: ChoiceHead | None = None

    def loss(self, rows: Kept) -> Tensor:
        """Sum of each head's mean negative log-likelihood over the rows; they share no weights. From fewer than two
        targets, which have no statistics to normalise by, only the presence head learns."""
        loss = rows.score.new_zeros(()).requires_grad_()
        if self.presence is not None:
            logits = self.presence.logits(rows.evidence, rows.score)
            loss = loss + F.binary_cross_entropy_with_logits(logits, rows.target.float())
        of_targets = rows.rows(rows.target)
        if len(of_targets.score) < 2:
            return loss
        if self.refine is not None:
            refined = self.refine(of_targets.evidence)
            loss = loss + refinement_nll(of_targets.residual, refined.correction, refined.log_sigma).sum(-1).mean()
        if self.choice is not None:
            loss = loss + choice_nll(chosen_by(self.choice, of_targets.evidence), of_targets.angle_rad).mean()
        return loss


def chosen_by(head: ChoiceHead, evidence: Evidence) -> Tensor:
    """The head's logits [P, K]."""
    return head(evidence.grid, evidence.f_trans, evidence.f_rot, evidence.options)


def fit(heads: Heads, kept: Kept, learnt: int, epochs: int, say: Callable[[str], None]) -> None:
    """Train on the first `learnt` rows; report the metrics on the others after each epoch."""
    trained = [head for head in heads if head is not None]
    for head in trained:
        head.requires_grad_(True)
        head.dropout.p = DROPOUT_OF_CHOICE if head is heads.choice else DROPOUT
    parameters = [parameter for head in trained for parameter in head.parameters()]
    optimizer = torch.optim.AdamW(parameters, lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    batch = min(BATCH, learnt)
    steps = learnt // batch
    # OneCycleLR needs a minimum number of steps.
    total = max(epochs * steps + 1, 20)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, LEARNING_RATE, total_steps=total, pct_start=0.1)
    for epoch in range(epochs):
        for head in trained:
            head.train()
        order = torch.randperm(learnt)
        for step in range(steps):
            loss = heads.loss(kept.rows(order[step * batch : (step + 1) * batch]))
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            schedule.step()
        for head in trained:
            head.eval()
        say(f"epoch {epoch + 1} of {epochs}: training loss {loss.item():.3f}; held out: {told(heads, kept, learnt)}")
    for head in trained:
        head.dropout.p = 0.0
        head.requires_grad_(False)
    if heads.choice is not None:
        heads.choice.lean(CHOICE_SHARE)
        leant = told(Heads(choice=heads.choice), kept, learnt)
        say(f"choice, {CHOICE_SHARE:.0%} of the way from the network's own: {leant}")


@torch.no_grad()
def told(heads: Heads, kept: Kept, first: int) -> str:
    """Metrics of the heads on the rows from `first` on, as text."""
    last = kept.rows(slice(first, None))
    if not len(last.residual):
        return "no windows"
    of_targets = last.rows(last.target)
    words = [] if heads.refine is None or not len(of_targets.score) else _told_of_range(heads.refine, of_targets)
    if heads.presence is not None:
        words += _told_of_presence(heads.presence, last)
    if heads.choice is not None and len(of_targets.score):
        words.append(_told_of_choice(heads.choice, of_targets))
    return "; ".join(words)


def _told_of_range(head: RefinementHead, of_targets: Kept) -> list[str]:
    residual, strange = of_targets.residual, of_targets.strange
    refined = [head(of_targets.rows(rows).evidence) for rows in _by_batch(len(residual))]
    correction, log_sigma = (torch.cat(values) for values in zip(*refined, strict=True))
    nll = refinement_nll(residual, correction, log_sigma).sum(-1).mean()
    left = (residual[:, RANGE] + correction).abs()
    words = [f"NLL {nll:.3f}"]
    for name, of in (("fleet and datasets", ~strange), ("generated aircraft", strange)):
        if of.any():
            before, after = residual[of, RANGE].abs().mean(), left[of].mean()
            scale = torch.exp(log_sigma[of, RANGE]).median()
            words.append(
                f"{name}: mean error of log range {before:.3f} before, {after:.3f} after, predicted scale {scale:.3f}"
            )
    return words


def _told_of_presence(head: PresenceHead, last: Kept) -> list[str]:
    if last.target.all() or not last.target.any():
        return []
    parts = (last.rows(rows) for rows in _by_batch(len(last.score)))
    score = torch.cat([head(part.evidence, part.score) for part in parts])
    false = [_false_share(of, last.target) for of in (last.score, score)]
    return ["peaks of no target, where 95 % of the targets are found: {:.2%} before, {:.2%} after".format(*false)]


def _told_of_choice(head: ChoiceHead, of_targets: Kept) -> str:
    parts = [of_targets.rows(rows) for rows in _by_batch(len(of_targets.score))]
    own = torch.cat([part.evidence.options[:, -head.hypotheses :] for part in parts])
    chosen = torch.cat([chosen_by(head, part.evidence) for part in parts])
    angles_rad = (of_targets.angle_rad.gather(1, logits.argmax(-1, keepdim=True)) for logits in (own, chosen))
    rates = [float((angle < math.radians(10.0)).float().mean()) for angle in angles_rad]
    return "rotations within 10 degrees: {:.1%} before, {:.1%} after".format(*rates)


def _by_batch(count: int) -> list[slice]:
    return [slice(start, start + BATCH) for start in range(0, count, BATCH)]


def _false_share(score: Tensor, target: Tensor, found: float = 0.95) -> float:
    """Share of the peaks of no target whose score exceeds the one that the share `found` of the targets exceeds."""
    return float((score[~target] > torch.quantile(score[target], 1.0 - found)).float().mean())
