"""Whether the poses of a flight agree with its ground truth."""

from __future__ import annotations

from sim_replay.ground_truth import PlayedSequence
from sim_replay.result import PEERS, Result


def wrong_poses(sequence: PlayedSequence, result: Result) -> tuple[str, ...]:
    """A sentence for each peer without a pose though a target is visible, or with one though none is; else empty.

    A sequence without ground truth is always accepted.
    """
    told = []
    for name, peer in zip(PEERS, (result.subscriber, result.autopilot), strict=True):
        if sequence.scene.shows_target and not peer.ages:
            strays = f" of a frame, but {peer.strays} of none" if peer.strays else ""
            told.append(f"the {name} received no pose{strays}")
        false = len(peer.false_poses) + peer.strays
        if sequence.scene.target_free and false:
            told.append(f"the {name} received {false} poses, but there is no target to be seen")
    return tuple(told)
