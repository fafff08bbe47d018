"""What a checkpoint or a model file tells of the heads that `uavpose-trainer refine` trained. Without torch."""

from __future__ import annotations

from collections.abc import Mapping

BESIDE_MOST = 3  # presence heads beside the first
# The prefix of what the weights' `training` tells of each head's; those beside that of presence are numbered.
TOLD_PREFIX = {"refinement": "refined", "presence": "presence", "choice": "choice"}
TOLD_PREFIX_BESIDE = "presence_beside_"


def heads_told(training: Mapping[str, object]) -> dict[str, str]:
    """What `training` says of each trained head: the prefix of its keys, and the head's name."""
    names = {
        "refined": "refinement head",
        "presence": "presence head",
        **{f"{TOLD_PREFIX_BESIDE}{i}": "presence head beside it" for i in range(1, 1 + BESIDE_MOST)},
        "choice": "choice head",
    }
    return {prefix: name for prefix, name in names.items() if any(key.startswith(f"{prefix}_") for key in training)}
