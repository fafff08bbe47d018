"""Whether the poses of a flight are such as its truth asks for."""

from __future__ import annotations

from sim_replay.ground_truth import PlayedSequence
from sim_replay.result import PEERS, Result


def wrong_poses(sequence: PlayedSequence, result: Result) -> tuple[str, ...]:
    """A sentence for each peer without a pose though a target is seen, or with one though none is. Empty: all is well.

    Of a sequence whose truth nobody knows, anything goes.
    """
    told = []
    for name, peer in zip(PEERS, (result.subscriber, result.autopilot), strict=True):
        if sequence.scene.shows_target and not peer.ages and not peer.strays:
            told.append(f"the {name} received no pose")
        false = len(peer.false_poses) + peer.strays
        if sequence.scene.target_free and false:
            told.append(f"the {name} received {false} poses, but there is no target to be seen")
    return tuple(told)
