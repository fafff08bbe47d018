"""Invariants that must hold under any fault: no peer receives anything stale, invented or invalid. Pure.

All poses are checked, and all other messages about a target or the own attitude.
"""

from __future__ import annotations

import bisect
from collections.abc import Sequence

import numpy as np

from msgs.geometry import R_FORWARD_CAM, q_wxyz_from_R
from sim_replay.faults.messages import AUTOPILOT, SUBSCRIBER, ReceivedMessage
from sim_replay.faults.witness import ExposedFrame, ReceivedPose, Witness

# The daemon's own limits on a measurement's age, and what a loaded host may add from that check until it arrives.
AGE_MAX_NS = {AUTOPILOT: 200_000_000, SUBSCRIBER: 500_000_000}
TRANSIT_MAX_NS = 900_000_000
SAME_FRAME_NS = 30_000_000
# The rig's own ship hovers level, facing north, with a camera along its nose.
Q_NED_CAM_WXYZ = q_wxyz_from_R(R_FORWARD_CAM)
ATTITUDE_TOLERANCE = 1e-2
# These may be refused: packets that a relay corrupted, and messages under the system id of a replaced autopilot.
MAY_REFUSE = {
    AUTOPILOT: ("not MAVLink", "unknown message", "not from a component of this vehicle"),
}


def violations(witness: Witness) -> list[str]:
    """Violations over a run that has ended, as sentences; empty if there are none."""
    found = faults_since(witness)
    for name, summary in witness.summaries:
        refused = summary["refused"].items()
        found += [f"the {name} refused {n}: {why}" for why, n in refused if why not in MAY_REFUSE.get(name, ())]
    return found


def faults_since(witness: Witness, poses: int = 0, messages: int = 0) -> list[str]:
    """Violations among what the peers received after this many poses and messages, as sentences."""
    held_back = witness.held_back
    return pose_faults(witness.poses[poses:], witness.frames, held_back) + message_faults(
        witness.messages[messages:], witness.frames, held_back
    )


def pose_faults(
    poses: Sequence[ReceivedPose], frames: Sequence[ExposedFrame], held_back: Sequence[tuple[int, int]] = ()
) -> list[str]:
    """Violations among the poses, as sentences. Wrong stamps of the camera do not matter: ages count from the true
    exposure. In the intervals `held_back` (UTC ns) the link to the ground held data back, which may come late.
    """
    exposures = _Exposures(frames, held_back)
    return [text for pose in poses if (text := _fault_of(pose, exposures))]


def message_faults(
    messages: Sequence[ReceivedMessage], frames: Sequence[ExposedFrame], held_back: Sequence[tuple[int, int]] = ()
) -> list[str]:
    """The same for other messages. One without a stamp describes the present: a frame that is not frozen must have been
    exposed just before it arrived.
    """
    exposures = _Exposures(frames, held_back)
    return [text for message in messages if (text := _fault_of_message(message, exposures))]


def ages_ms(witness: Witness, peer: str) -> list[float]:
    """Age on arrival of each pose, by its own stamp, sorted."""
    return sorted((pose.arrival_ns - pose.capture_ns) / 1e6 for pose in witness.poses if pose.peer == peer)


class _Exposures:
    """Frames by the stamp that a pose carries, and when the link to the ground held data back."""

    def __init__(self, frames: Sequence[ExposedFrame], held_back: Sequence[tuple[int, int]]) -> None:
        self._held_back = held_back
        self._by_stamp = sorted(frames, key=lambda frame: frame.stamp_ns)
        self._stamps = [frame.stamp_ns for frame in self._by_stamp]
        self._wrong = sorted(
            (frame for frame in frames if frame.stamp_ns != frame.exposed_ns), key=lambda frame: frame.exposed_ns
        )
        self._wrong_exposed = [frame.exposed_ns for frame in self._wrong]
        self._living = sorted(frame.exposed_ns for frame in frames if not frame.frozen)

    def any_living(self, from_ns: int, to_ns: int) -> bool:
        """Whether an image that is not frozen was exposed in this interval."""
        return bisect.bisect_left(self._living, from_ns) < bisect.bisect_right(self._living, to_ns)

    def held_back(self, peer: str, capture_ns: int) -> bool:
        """Whether a message of this frame was sent to the ground while the link held data back."""
        limit_ns = AGE_MAX_NS[SUBSCRIBER] + TRANSIT_MAX_NS
        return peer == SUBSCRIBER and any(
            from_ns - limit_ns <= capture_ns <= to_ns for from_ns, to_ns in self._held_back
        )

    def of(self, capture_ns: int) -> list[ExposedFrame]:
        """Frames with this stamp, or else wrongly stamped ones whose arrival time may have replaced their stamp."""
        first = bisect.bisect_left(self._stamps, capture_ns - SAME_FRAME_NS)
        last = bisect.bisect_right(self._stamps, capture_ns + SAME_FRAME_NS)
        if first < last:
            return self._by_stamp[first:last]
        first = bisect.bisect_left(self._wrong_exposed, capture_ns - TRANSIT_MAX_NS)
        return self._wrong[first : bisect.bisect_right(self._wrong_exposed, capture_ns)]


def _fault_of(pose: ReceivedPose, exposures: _Exposures) -> str | None:
    told = f"the {pose.peer} received a pose"
    if not _attitude_holds(pose):
        return f"{told} with an own attitude that nobody flew: {pose.q_ned_cam_wxyz}"
    return _stamp_fault(told, pose.peer, pose.capture_ns, pose.arrival_ns, exposures)


def _fault_of_message(message: ReceivedMessage, exposures: _Exposures) -> str | None:
    told = f"the {message.peer} received {message.kind}"
    if message.fault is not None:
        return f"{told}: {message.fault}"
    if message.capture_ns is not None:
        return _stamp_fault(told, message.peer, message.capture_ns, message.arrival_ns, exposures)
    limit_ns = AGE_MAX_NS[message.peer] + TRANSIT_MAX_NS
    if exposures.any_living(message.arrival_ns - limit_ns, message.arrival_ns):
        return None
    return f"{told} at {message.arrival_ns}, when no frame had been exposed for {limit_ns / 1e6:.0f} ms"


def _stamp_fault(told: str, peer: str, capture_ns: int, arrival_ns: int, exposures: _Exposures) -> str | None:
    frames = exposures.of(capture_ns)
    if not frames:
        return f"{told} of a frame that the camera never exposed, stamped {capture_ns}"
    if all(frame.frozen for frame in frames):
        return f"{told} of a frozen picture, stamped {capture_ns}"
    age_ns = arrival_ns - max(frame.exposed_ns for frame in frames)
    if age_ns > AGE_MAX_NS[peer] + TRANSIT_MAX_NS and not exposures.held_back(peer, capture_ns):
        return f"{told} {age_ns / 1e6:.0f} ms after its frame was exposed"
    return None


def _attitude_holds(pose: ReceivedPose) -> bool:
    """Whether the own attitude is the true one, or marked as unknown."""
    q = pose.q_ned_cam_wxyz
    return q is None or not any(q) or bool(abs(np.dot(q, Q_NED_CAM_WXYZ)) >= 1.0 - ATTITUDE_TOLERANCE)
