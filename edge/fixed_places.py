"""Finds what keeps its place in the picture while the camera turns: dirt, parts of the own aircraft, overlays.

Another aircraft does not: seen from a camera that is fixed to a turning vehicle, it moves through the picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.health import Reason
from edge.tracking.boxes import iou
from edge.tracking.view import View
from edge.types import Array, Estimate, Frame

FIXED = "camera_fixed_places"
# A box is at a place if its centre and its sides differ by no more: a share of the place's diagonal, or pixels. The
# network's boxes of one fixed thing scatter by 1 to 2 %.
OFF_SHARE, OFF_LEAST_PX = 0.05, 3.0
# How far the line of sight must have swung in ned with the box at its place, and in how many frames at least.
SWING_RAD = float(np.deg2rad(15.0))
SIGHTS_LEAST = 10
SWING_WITHIN_NS = 30_000_000_000  # slower, it may be the compass of a vehicle that stands still
SAME_THING_IOU = 0.5
UNSEEN_NS = 1_000_000_000  # a place is forgotten
FIXED_UNSEEN_NS = 60_000_000_000  # a fixed thing is: it may have been wiped off


@dataclass
class Place:
    """A box that has stayed where it was since it was first seen."""

    box_xyxy_px: Array  # [4], the first
    sight_ned: Array  # [3], unit vector of its first line of sight
    axes_epoch: int  # of that vector, see OwnShip
    sighted_ns: int  # time of that line of sight
    seen_ns: int
    sights: int = 1
    fixed: bool = False

    def holds(self, box_xyxy_px: Array) -> bool:
        ours, other = _centre_and_sides(self.box_xyxy_px), _centre_and_sides(box_xyxy_px)
        off_max_px = max(OFF_LEAST_PX, OFF_SHARE * float(np.hypot(*ours[2:])))
        return bool(np.all(np.abs(ours - other) <= off_max_px))


class FixedPlaces:
    """Fed by the loop with the estimates of each frame. `gimballed`: nothing is judged; what a gimbal follows stays."""

    def __init__(self, gimballed: bool = False) -> None:
        self._gimballed = gimballed
        self.refused = 0  # estimates of fixed things so far
        self._places: list[Place] = []

    def without(self, frame: Frame, estimates: Sequence[Estimate], view: View) -> list[Estimate]:
        """The estimates that are of no fixed thing, in their order; `view`: the camera of the frame."""
        now_ns = frame.meta.capture_ns
        self._forget(now_ns)
        others = []
        for estimate in estimates:
            box = estimate.box_xyxy_px
            if view.kind != "cam" and not self._gimballed:
                self._seen(box, _sight_ned(box, frame.K, view), view.axes_epoch, now_ns)
            place = self._at(box)
            if place is not None and place.fixed:
                place.seen_ns = now_ns
            else:
                others.append(estimate)
        self.refused += len(estimates) - len(others)
        return others

    def reasons(self, now_ns: int) -> tuple[Reason, ...]:
        """One while there are fixed things."""
        self._forget(now_ns)
        where = [
            "({:.0f}, {:.0f})".format(*_centre_and_sides(one.box_xyxy_px)[:2]) for one in self._places if one.fixed
        ]
        if not where:
            return ()
        keeps = "keeps its place in the picture while the camera turns, and is ignored"
        return (Reason(FIXED, f"what is seen at {', '.join(where)} px {keeps}"),)

    def _seen(self, box_xyxy_px: Array, sight_ned: Array, axes_epoch: int, now_ns: int) -> None:
        place = next((one for one in self._places if one.holds(box_xyxy_px)), None)
        if place is None:
            moved_on = self._at(box_xyxy_px)
            if moved_on is None or not moved_on.fixed:
                self._places = [one for one in self._places if one is not moved_on]
                self._places.append(Place(box_xyxy_px, sight_ned, axes_epoch, now_ns, now_ns))
            return
        if place.axes_epoch != axes_epoch or now_ns - place.sighted_ns > SWING_WITHIN_NS:
            place.sight_ned, place.axes_epoch, place.sighted_ns, place.sights = sight_ned, axes_epoch, now_ns, 0
        place.seen_ns = now_ns
        place.sights += 1
        swung = float(place.sight_ned @ sight_ned) <= np.cos(SWING_RAD)
        place.fixed = place.fixed or (swung and place.sights >= SIGHTS_LEAST)

    def _at(self, box_xyxy_px: Array) -> Place | None:
        return max(
            (one for one in self._places if iou(one.box_xyxy_px, box_xyxy_px) >= SAME_THING_IOU),
            key=lambda one: one.fixed,
            default=None,
        )

    def _forget(self, now_ns: int) -> None:
        self._places = [
            one for one in self._places if now_ns - one.seen_ns <= (FIXED_UNSEEN_NS if one.fixed else UNSEEN_NS)
        ]


def _sight_ned(box_xyxy_px: Array, K: Array, view: View) -> Array:
    x, y = _centre_and_sides(box_xyxy_px)[:2]
    ray = np.linalg.solve(K, np.array([x, y, 1.0]))
    return np.asarray(view.R_frame_cam @ (ray / np.linalg.norm(ray)))


def _centre_and_sides(box_xyxy_px: Array) -> Array:
    low, high = box_xyxy_px[:2], box_xyxy_px[2:]
    return np.concatenate([0.5 * (low + high), high - low])
