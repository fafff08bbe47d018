"""Where in each frame the estimator looks: windows around what is expected, found or pointed at, else regions.

The daemon's loop uses it, and evaluation, which so judges what flies.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from edge.config_estimator import EstimatorSettings
from edge.estimator.decode import lies_on
from edge.estimator.estimator import PLACES_MOST, Estimator
from edge.estimator.pace import Pace, looked_at_twice
from edge.estimator.regions import Sweep
from edge.search import Search
from edge.stages import StageClock
from edge.types import Array, Estimate, Frame, Track


@dataclass(frozen=True)
class Looked:
    """What was found in a frame."""

    estimates: list[Estimate]
    there: Estimate | None = None  # of these, the one in the box that was pointed at

    def each(self, change: Callable[[Estimate], Estimate]) -> Looked:
        """The same with each estimate changed."""
        changed = [(one, change(one)) for one in self.estimates]
        return Looked([new for _, new in changed], next((new for old, new in changed if old is self.there), None))


class Attention:
    """Looks at one frame after the other. `search` is the caller's to start and to stop; see there."""

    def __init__(self, settings: EstimatorSettings) -> None:
        self.search = Search()
        self.acquire_every_n = settings.acquire_every_n
        self._max_targets = settings.max_targets
        self._pace = Pace()
        self._sweep = Sweep()
        self._since_acquire = 0

    def look(
        self,
        estimator: Estimator,
        frame: Frame,
        expected: Sequence[Track],
        clock: StageClock,
        *,
        searches: bool = True,
        pointed_at: Array | None = None,
    ) -> Looked:
        """`expected` as predicted for the frame. `searches`: whether to look for other targets; `pointed_at`: a box [4]
        px to look into."""
        unhurried = self._pace.unhurried(frame.meta)
        held = [track.box_xyxy_px for track in expected]
        twice = [looked_at_twice(track.state, unhurried) for track in expected]
        probable = sum(track.score >= estimator.model.doubtful_below for track in expected)
        room = searches and probable < self._max_targets  # the others give way
        places = self.search.places(frame.meta.capture_ns, held, max(PLACES_MOST - len(held), 1) if room else 0)
        looked = _look_into(estimator, frame, held, twice, places, pointed_at, clock)
        self._since_acquire += 1
        if not searches:
            return looked
        if not looked.estimates:
            # Unsuccessful track windows plus a search leave no time for finer ones; the next frame makes them.
            # A target that has just left its window is most likely to be found in the whole frame.
            regions = () if expected else self._sweep.next(estimator.regions(frame), self._pace.regions())
            looked = Looked(estimator.acquire(frame, thrice=unhurried and not expected, regions=regions))
            self._since_acquire = 0
            clock.estimated(estimator.model.take_runs_ns())
        elif (
            self._since_acquire >= self.acquire_every_n
            and probable < self._max_targets
            and self.search.begin(estimator, frame, [*held, *(place.box_xyxy_px for place in places)])
        ):
            self._since_acquire = 0
        return looked


def _look_into(
    estimator: Estimator,
    frame: Frame,
    held: list[Array],
    twice: list[bool],
    places: list[Estimate],
    pointed_at: Array | None,
    clock: StageClock,
) -> Looked:
    boxes = [*held, *(place.box_xyxy_px for place in places)]
    if pointed_at is not None:
        boxes.append(pointed_at)
    if not boxes or not estimator.has_track_stage:
        return Looked([])
    seen = estimator.track(frame, boxes, twice)
    clock.estimated(estimator.model.take_runs_ns())
    there = None if pointed_at is None else seen[-1]
    for i, place in enumerate(places, start=len(held)):
        look = seen[i]
        if look is None or lies_on(look.box_xyxy_px, held):
            continue  # a tracked target, seen more clearly than in its own window, needs no confirmation
        if not estimator.confirms(place, [look]):
            seen[i] = None
    return Looked([estimate for estimate in seen if estimate is not None], there)
