"""What a checkpoint or a model file tells of the heads that `uavpose-trainer refine` trained. Without torch."""

from __future__ import annotations

from collections.abc import Mapping

BESIDE_MOST = 3  # presence heads beside the first
# The prefix of what the weights' `training` tells of each head's; those beside that of presence are numbered.
TOLD_PREFIX = {"refinement": "refined", "presence": "presence", "choice": "choice"}
TOLD_PREFIX_BESIDE = "presence_beside_"


def heads_told(training: Mapping[str, object]) -> dict[str, str]:
    """What `training` says of each trained head: the prefix of its keys, and the head's name."""
    beside = (f"{TOLD_PREFIX_BESIDE}{i}" for i in range(1, 1 + BESIDE_MOST))
    names = {prefix: f"{head} head" for head, prefix in TOLD_PREFIX.items()}
    names |= {prefix: "presence head beside it" for prefix in beside}
    order = ("refined", "presence", *(prefix for prefix in names if prefix.startswith(TOLD_PREFIX_BESIDE)), "choice")
    return {prefix: names[prefix] for prefix in order if any(key.startswith(f"{prefix}_") for key in training)}
