"""Operator requests to the tracker. Pure: every time is an argument.

A requested box is examined in every frame for up to LOOK_NS until a target is found there; that is then the chosen
target while its track exists, and if the track ends before it was confirmed the examination continues. The same box
again within REPEATED_NS keeps it. "Stop" drops all targets and suspends the search for REST_NS or until the next
selection.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from edge.requests import Request, SelectTarget, TrackBox
from edge.tracking.boxes import SAME_BOX_IOU, iou
from edge.types import Array, Estimate, Track, TrackState

LOOK_NS = 1_000_000_000
REST_NS = 10_000_000_000
# A sender whose acknowledgement was lost repeats the request, with nothing that tells it from a new one: MAVSDK (every
# 0.5 s, three times) and old QGroundControl (after 3 s) leave `confirmation` at 0. By then the target may have left the
# box.
REPEATED_NS = 4_000_000_000


class ByHand:
    def __init__(self) -> None:
        self._chosen: tuple[int, int] | None = None  # track_id and born_ns
        self._box_share: Array | None = None
        self._pointed: tuple[Request, int] | None = None  # the last request, if it was a box, and when it came first
        self._wanted_id: int | None = None  # of a target that was selected by its number
        self._look_until_ns = 0
        self._rest_until_ns = 0
        self._found: Array | None = None  # [4] box_xyxy_px of the estimate that is to become the chosen track
        self._news: list[str] = []

    @property
    def chosen_id(self) -> int | None:
        """Of the target that is chosen, or is to be after this frame; None: of neither."""
        return self._wanted_id if self._chosen is None else self._chosen[0]

    def take(self, request: Request, now_ns: int) -> None:
        """Process a request that arrived before the frame of `now_ns`."""
        if self._chosen is not None and self._repeats(request, now_ns):
            return
        self._chosen = self._wanted_id = self._pointed = None
        if isinstance(request, SelectTarget):
            self._box_share, self._wanted_id, self._rest_until_ns = None, request.track_id, now_ns
        elif isinstance(request, TrackBox):
            self._box_share = np.array(request.box_xyxy_share)
            self._look_until_ns, self._rest_until_ns = now_ns + LOOK_NS, now_ns
            self._pointed = request, now_ns
        else:
            self._box_share, self._rest_until_ns = None, now_ns + REST_NS

    def box_xyxy_px(self, now_ns: int, image_size_wh: tuple[int, int], expected: Iterable[Track]) -> Array | None:
        """The box [4] to examine, or None; if a target is `expected` there already, it is chosen instead."""
        if self._box_share is None or self._chosen is not None:
            return None
        if now_ns > self._look_until_ns:
            self._box_share = None
            self._news.append("no target found where pointed")
            return None
        box: Array = self._box_share * np.tile(image_size_wh, 2) - 0.5
        there = [t for t in expected if _holds(box, _center(t.box_xyxy_px)) or _holds(t.box_xyxy_px, _center(box))]
        if not there:
            return box
        self._choose(max(there, key=lambda track: _fit(track.box_xyxy_px, box)))
        return None

    def searches(self, now_ns: int) -> bool:
        """Whether to search for targets that were not requested."""
        return now_ns >= self._rest_until_ns

    def found(self, estimate: Estimate) -> None:
        """A target was detected in the requested box: its track is to become the chosen one."""
        self._found = estimate.box_xyxy_px

    def settle(self, tracks: Iterable[Track]) -> None:
        """After the tracker's update: determine which track is the chosen one, if it still exists."""
        tracks = list(tracks)
        if self._wanted_id is not None:
            self._choose_by_id(tracks, self._wanted_id)
            self._wanted_id = None
        if self._found is not None:
            self._choose_where(tracks, self._found)
            self._found = None
        chosen = next((track for track in tracks if (track.track_id, track.born_ns) == self._chosen), None)
        if chosen is None:
            self._chosen = None
        elif chosen.state is not TrackState.TENTATIVE:
            self._box_share = None

    def news(self) -> list[str]:
        """Messages for the operator since the last call."""
        told, self._news = self._news, []
        return told

    def _repeats(self, request: Request, now_ns: int) -> bool:
        """Whether it is the same box as in the last request, not long ago."""
        return self._pointed is not None and self._pointed[0] == request and now_ns - self._pointed[1] <= REPEATED_NS

    def _choose_by_id(self, tracks: Iterable[Track], track_id: int) -> None:
        for track in tracks:
            if track.track_id == track_id and track.born_ns < track.time_ns:  # a newborn was not meant
                return self._choose(track)
        self._news.append(f"target {track_id} is gone: not chosen")
        return None

    def _choose_where(self, tracks: Iterable[Track], found_xyxy_px: Array) -> None:
        """Choose the track updated with the estimate. Another one nearby is not what was requested: keep examining."""
        seen = [track for track in tracks if track.measured_ns == track.time_ns]
        best = max(seen, key=lambda track: iou(track.box_xyxy_px, found_xyxy_px), default=None)
        if best is not None and iou(best.box_xyxy_px, found_xyxy_px) > SAME_BOX_IOU:
            self._choose(best)

    def _choose(self, track: Track) -> None:
        self._chosen = track.track_id, track.born_ns
        self._news.append(f"target {track.track_id} chosen")


def _holds(box_xyxy_px: Array, point_px: Array) -> bool:
    return bool(np.all(point_px >= box_xyxy_px[:2]) and np.all(point_px <= box_xyxy_px[2:]))


def _fit(box_xyxy_px: Array, pointed_xyxy_px: Array) -> tuple[float, float]:
    """Sort key, greatest first, for which of several targets was meant: the one whose box fits the requested box, else
    the one with the nearest centre; a near target's box may contain a far one's."""
    drawn = iou(box_xyxy_px, pointed_xyxy_px)
    away_px = float(np.linalg.norm(_center(box_xyxy_px) - _center(pointed_xyxy_px)))
    return drawn if drawn > SAME_BOX_IOU else 0.0, -away_px


def _center(box_xyxy_px: Array) -> Array:
    return 0.5 * (box_xyxy_px[:2] + box_xyxy_px[2:])
