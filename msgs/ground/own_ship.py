"""Attitude of the own ship's camera, and position of the own ship, at any time within the last seconds. Pure."""

from __future__ import annotations

from bisect import bisect_left, insort
from dataclasses import dataclass, replace
from operator import attrgetter

import numpy as np

from msgs import topics
from msgs.cdr import TFMessage
from msgs.geometry import R_from_q_wxyz, slerp
from msgs.wire import Array

GAP_NS = 500_000_000  # longest gap to interpolate over; at five messages a second, one may be lost
# Longest time to predict over. Where transforms are cut to five a second, up to 300 ms lie between two, as only whole
# frames pass, and that of a frame arrives after its poses.
NEAR_NS = 350_000_000
HELD_NS = 100_000_000  # longest time over which it counts as unchanged, where it cannot be predicted
KEPT_NS = 2_000_000_000
KEPT_MAX = 512
_stamp_ns = attrgetter("stamp_ns")


@dataclass(frozen=True, eq=False)
class OwnShip:
    """The own ship at one instant."""

    stamp_ns: int  # UTC; if it is predicted, of the message that it is predicted from
    root: str  # reference frame: NED axes at a fixed origin or at the own ship
    R_ned_cam: Array
    t_ned_own_m: Array
    t_ned_cam_m: Array  # beside it by the mount's lever arm


class OwnShipHistory:
    """Recent own-ship states from a vehicle's transforms."""

    def __init__(self) -> None:
        self._told: list[OwnShip] = []

    def take(self, message: TFMessage) -> OwnShip | None:
        """Store and return the state; None if the transforms do not connect the camera to NED axes."""
        own = own_ship(message)
        if own is None:
            return None
        newest = self._told[-1] if self._told else own
        # With another origin, or after a clock was set back, older states cannot be used for interpolation.
        if own.root != newest.root or own.stamp_ns < newest.stamp_ns - KEPT_NS:
            self._told.clear()
        insort(self._told, own, key=_stamp_ns)
        while len(self._told) > KEPT_MAX or self._told[0].stamp_ns < self._told[-1].stamp_ns - KEPT_NS:
            del self._told[0]
        return own

    def at(self, stamp_ns: int) -> OwnShip | None:
        """The state at a time, interpolated between its neighbours; None without both, or if too far apart."""
        index = bisect_left(self._told, stamp_ns, key=_stamp_ns)
        if index < len(self._told) and self._told[index].stamp_ns == stamp_ns:
            return self._told[index]
        if not 0 < index < len(self._told):
            return None
        before, after = self._told[index - 1], self._told[index]
        if after.stamp_ns - before.stamp_ns > GAP_NS:
            return None
        return _between(before, after, stamp_ns)

    def near(self, stamp_ns: int) -> OwnShip | None:
        """The state at a time or, if it cannot be interpolated, the one predicted from the nearest within `NEAR_NS`:
        turned on as fast as before, by at most as much as between the last two. None if more than `HELD_NS` remain."""
        own = self.at(stamp_ns)
        if own is not None or not self._told:
            return own
        nearest = min(self._told, key=lambda one: abs(one.stamp_ns - stamp_ns))
        if abs(nearest.stamp_ns - stamp_ns) > NEAR_NS:
            return None
        index = bisect_left(self._told, nearest.stamp_ns, key=_stamp_ns)
        before = self._told[index - 1] if index else nearest
        step_ns = nearest.stamp_ns - before.stamp_ns
        predictable = stamp_ns > nearest.stamp_ns and 0 < step_ns <= GAP_NS
        reached_ns = min(stamp_ns, nearest.stamp_ns + step_ns) if predictable else nearest.stamp_ns
        if abs(stamp_ns - reached_ns) > HELD_NS:
            return None
        return replace(_between(before, nearest, reached_ns), stamp_ns=nearest.stamp_ns) if predictable else nearest


def _between(before: OwnShip, after: OwnShip, stamp_ns: int) -> OwnShip:
    """The state between two others of the same root, or beyond the second, at a constant turn rate and velocity."""
    share = (stamp_ns - before.stamp_ns) / (after.stamp_ns - before.stamp_ns)
    own_m = before.t_ned_own_m + share * (after.t_ned_own_m - before.t_ned_own_m)
    cam_m = before.t_ned_cam_m + share * (after.t_ned_cam_m - before.t_ned_cam_m)
    return OwnShip(stamp_ns, before.root, slerp(before.R_ned_cam, after.R_ned_cam, share), own_m, cam_m)


def own_ship(message: TFMessage) -> OwnShip | None:
    """Own-ship state from the chain of frames above the camera; None if it does not end at NED axes."""
    links = {one.child_frame_id: one for one in message.transforms}
    if topics.FRAME_CAMERA not in links:
        return None
    stamp_ns, place = links[topics.FRAME_CAMERA].stamp_ns, links.get(topics.FRAME_BODY_NED)
    R, t_m, frame = np.eye(3), np.zeros(3), topics.FRAME_CAMERA
    while frame in links:
        link = links.pop(frame)
        R_link = R_from_q_wxyz(np.roll(link.q_frame_child_xyzw, 1))
        R, t_m, frame = R_link @ R, link.t_frame_child_m + R_link @ t_m, link.frame_id
    if frame not in (topics.FRAME_NED, topics.FRAME_BODY_NED):
        return None
    return OwnShip(stamp_ns, frame, R, np.zeros(3) if place is None else place.t_frame_child_m, t_m)
