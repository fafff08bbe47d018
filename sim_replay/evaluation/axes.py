"""Whether a dataset's model axes are others than it says: rotations are then all off by the same turn. Pure."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from sim_replay.evaluation.judge import JudgedFrame
from sim_replay.metrics import rotation_error_deg

Array = NDArray[np.float64]
FEWEST = 8  # targets
WITHIN_DEG = 45.0  # of the common turn; of rotations at random, one in forty is
SHARE = 0.7


def _quarter_turns() -> Array:
    """The 24 rotations [24, 3, 3] that turn axes into axes."""
    signed = (
        np.eye(3)[list(order)] * signs for order in permutations(range(3)) for signs in product((1, -1), repeat=3)
    )
    return np.array([R for R in signed if np.linalg.det(R) > 0])


_TURNS = _quarter_turns()
# Nose taken for tail: the network's own mistake, in all of a flight.
_NOT_OF_AXES = (np.eye(3), np.diag([-1.0, -1.0, 1.0]))


def common_turn(R_est: Array, R_gt: Array) -> Array | None:
    """The R_true_told [3, 3] by which the axes of most rotations R_gt [N, 3, 3] must be turned to agree with R_est
    [N, 3, 3]; None if there is none, or the rotations agree as they are."""
    if len(R_est) < FEWEST:
        return None
    off = R_est.swapaxes(1, 2) @ R_gt
    shares = [(rotation_error_deg(off, turn) < WITHIN_DEG).mean() for turn in _TURNS]
    turn: Array = _TURNS[int(np.argmax(shares))]
    if max(shares) < SHARE or any((turn == one).all() for one in _NOT_OF_AXES):
        return None
    return turn


def told_of_axes(judged: Sequence[JudgedFrame]) -> list[str]:
    """A sentence about the objects whose axes seem to be others than model_frame.toml (or its absence) says."""
    pairs: dict[int, list[tuple[Array, Array]]] = defaultdict(list)
    for match in (match for frame in judged for match in frame.matches):
        if match.estimate is not None and match.estimate.rotation_known:
            pairs[match.truth.object_id].append((match.estimate.R_cam_target, match.truth.R_cam_target))
    needed: dict[str, list[int]] = defaultdict(list)  # by matrix
    for object_id, own in sorted(pairs.items()):
        turn = common_turn(np.array([R for R, _ in own]), np.array([R for _, R in own]))
        if turn is not None:
            told = turn @ judged[0].picture.scene.models.of(object_id).R_body_model
            rows = np.round(told, 3) + 0.0  # no -0.0
            needed[str(rows.tolist())].append(object_id)
    return [
        f"obj_id {', '.join(map(str, object_ids))}: most rotations are off by the same turn of the axes; if the "
        f"models' axes are others than the dataset says, model_frame.toml needs R_body_model = {R_body_model}"
        for R_body_model, object_ids in needed.items()
    ]
