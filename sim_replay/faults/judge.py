"""What must hold all the time, whatever breaks: no peer is given anything stale, invented or invalid. Pure."""

from __future__ import annotations

import bisect
from collections.abc import Sequence

from sim_replay.faults.witness import AUTOPILOT, SUBSCRIBER, ExposedFrame, ReceivedPose, Witness

# The daemon's own limits on a measurement's age, and what a loaded host may add between its look and the peer's.
AGE_MAX_NS = {AUTOPILOT: 200_000_000, SUBSCRIBER: 500_000_000}
TRANSIT_MAX_NS = 700_000_000
SAME_FRAME_NS = 30_000_000


def violations(witness: Witness) -> list[str]:
    """Sentences, none if all is well. A camera's wrong stamps are seen through: ages count from the true exposure."""
    stamps = _Stamps(witness.frames)
    found = [text for pose in witness.poses if (text := _fault_of(pose, stamps))]
    for name, summary in witness.summaries:
        # A subscriber that was away finds old ones in its queue, and refuses them: that is as it should be.
        refused = {reason: count for reason, count in summary["refused"].items() if reason not in ALLOWED.get(name, ())}
        found += [f"the {name} refused {count}: {reason}" for reason, count in refused.items()]
    return found


# Held back by a cut link, or read late by a peer that stood still.
ALLOWED = {SUBSCRIBER: ("STALE", "SEQUENCE")}


class _Stamps:
    """Frames by the times that a pose may be known by: the stamp that was told, or the true one in its place."""

    def __init__(self, frames: Sequence[ExposedFrame]) -> None:
        pairs = [(frame.stamp_ns, frame) for frame in frames]
        pairs += [(frame.exposed_ns, frame) for frame in frames if frame.stamp_ns != frame.exposed_ns]
        self._pairs = sorted(pairs, key=lambda pair: pair[0])
        self._times = [time_ns for time_ns, _ in self._pairs]

    def near(self, time_ns: int) -> list[ExposedFrame]:
        """Frames whose time is within SAME_FRAME_NS."""
        first = bisect.bisect_left(self._times, time_ns - SAME_FRAME_NS)
        last = bisect.bisect_right(self._times, time_ns + SAME_FRAME_NS)
        return [frame for _, frame in self._pairs[first:last]]


def _fault_of(pose: ReceivedPose, stamps: _Stamps) -> str | None:
    frames = stamps.near(pose.capture_ns)
    told = f"the {pose.peer} received a pose"
    if not frames:
        return f"{told} of a frame that the camera never exposed, stamped {pose.capture_ns}"
    if all(frame.frozen for frame in frames):
        return f"{told} of a frozen picture, stamped {pose.capture_ns}"
    age_ns = pose.arrival_ns - max(frame.exposed_ns for frame in frames)
    if age_ns > AGE_MAX_NS[pose.peer] + TRANSIT_MAX_NS:
        return f"{told} {age_ns / 1e6:.0f} ms after its frame was exposed"
    return None


def ages_ms(witness: Witness, peer: str) -> list[float]:
    """Age on receipt of each pose, by its own stamp, sorted."""
    return sorted((pose.arrival_ns - pose.capture_ns) / 1e6 for pose in witness.poses if pose.peer == peer)
