"""Continuity of each target's track: acquired, lost, re-acquired, under how many names. Pure functions.

Counted as in CLEAR MOT (Bernardin & Stiefelhagen 2008): an identity switch is a frame whose pose names another track
than the target's last one; a fragment is each time that poses of a visible target stop and resume.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from sim_replay.score import Match


def continuity(matches: Sequence[Match], fps: float, unrecorded: Collection[int] = ()) -> dict[str, Any]:
    """The figures over all targets, and each target's own under "targets"; seconds from frame numbers.

    Args:
        matches: Of all visible targets of all frames; a frame is an index that increases by one every 1 / fps.
        unrecorded: Frames without an image, in which no target could be seen: nothing begins or ends there.

    Returns:
        JSON's types. `time_to_acquire_s` is the time for which a target was in view before the first frame with a pose
        of it; `time_to_reacquire_s` counts from the first frame without one, or from where it came into view again. A
        target that was never found counts as `never_acquired`, one that was not found again before it left as
        `never_reacquired`, and in no time.
    """
    by_target: dict[tuple[int, int], list[Match]] = {}
    for match in sorted(matches, key=lambda match: match.truth.frame):
        by_target.setdefault(match.truth.target, []).append(match)
    targets = [target_continuity(seen, fps, unrecorded) for seen in by_target.values()]
    acquired = [target["time_to_acquire_s"] for target in targets if target["time_to_acquire_s"] is not None]
    losses = [loss for target in targets for loss in target["losses"]]
    regained = [loss["lasted_s"] for loss in losses if loss["regained"]]
    return {
        "identity_switches": sum(target["identity_switches"] for target in targets),
        "fragments": sum(target["fragments"] for target in targets),
        "never_acquired": len(targets) - len(acquired),
        "time_to_acquire_s": _spread(acquired),
        "reacquired": len(regained),
        "never_reacquired": len(losses) - len(regained),
        "time_to_reacquire_s": _spread(regained),
        "targets": targets,
    }


def target_continuity(seen: Sequence[Match], fps: float, unrecorded: Collection[int] = ()) -> dict[str, Any]:
    """The same for one target, from its matches in the order of their frames."""
    tracks = [match.estimate.track for match in seen if match.estimate is not None]
    switches = sum(after != before for before, after in pairwise(tracks))
    frames = [match.truth.frame for match in seen]
    in_view = [k > 0 and follows(frames[k - 1], frames[k], unrecorded) for k in range(len(frames))]  # since the last
    runs = list(_missing(seen, in_view))
    first = next((k for k, match in enumerate(seen) if match.estimate is not None), None)
    losses = [(start, stop) for start, stop in runs if first is not None and start > first]
    told = []
    for start, stop in losses:
        regained = stop < len(seen) and in_view[stop]
        until = frames[stop] if regained else frames[stop - 1] + 1
        told.append(
            {
                "frame": frames[start],
                "lasted_s": round((until - frames[start]) / fps, 4),
                "regained": regained,
                "while_in_view": in_view[start],
            }
        )
    # Out of view it could not be found: of a view, the last frame lasts as long as any.
    lasted = [frames[k] - frames[k - 1] if in_view[k] else 1 for k in range(1, len(frames))]
    acquired = None if first is None else sum(lasted[:first]) / fps
    return {
        "target": seen[0].truth.airframe_label,
        "instance": seen[0].truth.instance,
        "frames": len(seen),
        "found": len(tracks),
        "tracks": list(dict.fromkeys(tracks)),
        "time_to_acquire_s": None if acquired is None else round(acquired, 4),
        "identity_switches": switches,
        "fragments": sum(loss["regained"] and loss["while_in_view"] for loss in told),
        "losses": told,
    }


def _missing(seen: Sequence[Match], in_view: Sequence[bool]) -> Iterator[tuple[int, int]]:
    """Runs [start, stop) of matches without a pose; split where the target is out of view in between."""
    start = None
    for k, match in enumerate(seen):
        if start is not None and (match.estimate is not None or not in_view[k]):
            yield start, k
            start = None
        if start is None and match.estimate is None:
            start = k
    if start is not None:
        yield start, len(seen)


def follows(before: int, after: int, unrecorded: Collection[int]) -> bool:
    """Whether a frame is the next after another that has an image."""
    return all(frame in unrecorded for frame in range(before + 1, after))


def _spread(seconds: Sequence[float]) -> dict[str, float | None]:
    if not seconds:
        return {"median": None, "max": None}
    return {"median": round(float(np.median(seconds)), 4), "max": round(float(np.max(seconds)), 4)}
