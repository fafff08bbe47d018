"""Search of the frame parallel to the loop, so that looking for more targets does not delay the tracked ones.

It only proposes places. The loop evaluates each in a window of the next frame, as it does for a place that the operator
selects; only what is detected there counts as a target.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from edge import clock
from edge.estimator.decode import lies_on
from edge.estimator.estimator import Estimator
from edge.estimator.regions import Region, Sweep
from edge.threads import yield_to_the_loop
from edge.types import Array, Estimate, Frame

log = logging.getLogger(__name__)

STOP_TIMEOUT_S = 5.0  # exiting during an inference aborts the process; on a busy machine an inference takes long
PLACE_AGE_MAX_NS = 500_000_000  # after that a target has left its window
# At low frame rates a place is at least one frame interval old; where processing limits the frame rate, the search, at
# a lower priority, takes longer than one interval. A place that is too old costs a useless window.
PLACE_AGE_MAX_FRAMES = 2.5
INTERVAL_MAX_NS = 2_000_000_000  # a longer interval is a gap: there are no tracks at such a rate


@dataclass(frozen=True)
class _Asked:
    estimator: Estimator
    frame: Frame
    known_boxes: tuple[Array, ...]
    region: Region


class Search:
    """One search at a time, in its own thread; in lock-step mode in the caller's. Used by the loop."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._asked: _Asked | None = None
        self._busy = False
        self._sweep = Sweep()
        self._places: list[Estimate] = []
        self._seen_ns = 0  # exposure time of the frame that the places were found in
        self._asked_for_ns = 0  # exposure time of the last frame that the places were requested for
        self._counts: Counter[str] = Counter(searches=0)
        self._stopping = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        if not clock.stepped():
            self._thread = threading.Thread(target=self._run, name="search", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End the thread after the search in progress. May be called without start."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(STOP_TIMEOUT_S)

    def begin(self, estimator: Estimator, frame: Frame, known_boxes: Sequence[Array]) -> bool:
        """Search the frame's next region for targets that overlap none of `known_boxes` [4] px; False while another
        search is in progress."""
        with self._changed:
            if self._busy:
                return False
            self._busy = True
            (region,) = self._sweep.next(estimator.regions(frame))
            self._asked = _Asked(estimator, frame, tuple(known_boxes), region)
            self._changed.notify()
        if self._thread is None:
            self._look()
        return True

    def places(self, capture_ns: int, known_boxes: Sequence[Array], at_most: int) -> list[Estimate]:
        """Places found since the last call, best first, that may still be valid at `capture_ns` (monotonic) and overlap
        none of `known_boxes`. To be called for every frame, in order."""
        interval_ns = min(capture_ns - self._asked_for_ns, INTERVAL_MAX_NS)
        self._asked_for_ns = capture_ns
        with self._changed:
            found, self._places = self._places, []
            if capture_ns - self._seen_ns > max(PLACE_AGE_MAX_NS, PLACE_AGE_MAX_FRAMES * interval_ns):
                return []
        return [place for place in found if not lies_on(place.box_xyxy_px, known_boxes)][: max(at_most, 0)]

    def counters(self) -> dict[str, int]:
        """Counters `searches`, `search_failed`, and `refused_REASON` of rejected detections."""
        with self._changed:
            return dict(self._counts)

    def _run(self) -> None:
        yield_to_the_loop()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._asked is not None or self._stopping)
                if self._stopping:
                    return
            self._look()

    def _look(self) -> None:
        with self._changed:
            asked, self._asked = self._asked, None
        assert asked is not None
        refused: Counter[str] = Counter()
        places: list[Estimate] = []
        failed = False
        try:
            places = asked.estimator.anywhere(asked.frame, asked.known_boxes, refused, asked.region)
        except Exception:
            if clock.stepped():  # a replay is judged by what it finds
                raise
            # Only this search is lost: tracking continues, and the next search may succeed.
            failed = True
            log.exception("a search of the frame failed")
        with self._changed:
            self._counts.update(searches=1, search_failed=int(failed))
            self._counts.update({f"refused_{reason}": n for reason, n in refused.items()})
            self._places, self._seen_ns = places, asked.frame.meta.capture_ns
            self._busy = False
