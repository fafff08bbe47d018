"""The whole frame looked over beside the loop: a search for more targets must not make the poses of those held late.

What it finds is only a place. The loop looks into it through a window of the next frame, as it does where a person
points, and only what is seen there is a target.
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
from edge.threads import yield_to_the_loop
from edge.types import Array, Estimate, Frame

log = logging.getLogger(__name__)

STOP_TIMEOUT_S = 5.0  # a process that ends during an inference is aborted; on a busy machine one takes long
PLACE_AGE_MAX_NS = 500_000_000  # a target has left its window by then
# At few frames a second no place is younger than the frame before; where the machine sets the pace, the search, at a
# lower priority, lasts longer than from one frame to the next. A place that is too old costs a window in vain.
PLACE_AGE_MAX_FRAMES = 2.5
INTERVAL_MAX_NS = 2_000_000_000  # a longer one is a gap: there are no tracks at such a rate


@dataclass(frozen=True)
class _Asked:
    estimator: Estimator
    frame: Frame
    known_boxes: tuple[Array, ...]


class Search:
    """One search at a time, in a thread of its own; in lock-step on the caller's. Used by the loop."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._asked: _Asked | None = None
        self._busy = False
        self._places: list[Estimate] = []
        self._seen_ns = 0  # exposure of the frame that they were seen in
        self._asked_for_ns = 0  # exposure of the last frame that they were asked for
        self._counts: Counter[str] = Counter(searches=0)
        self._stopping = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        if not clock.stepped():
            self._thread = threading.Thread(target=self._run, name="search", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End the thread, after the search under way. May be called without start."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join(STOP_TIMEOUT_S)

    def begin(self, estimator: Estimator, frame: Frame, known_boxes: Sequence[Array]) -> bool:
        """Look for targets that lie on none of `known_boxes` [4] px; False while another search is under way."""
        with self._changed:
            if self._busy:
                return False
            self._busy = True
            self._asked = _Asked(estimator, frame, tuple(known_boxes))
            self._changed.notify()
        if self._thread is None:
            self._look()
        return True

    def places(self, capture_ns: int, known_boxes: Sequence[Array], at_most: int) -> list[Estimate]:
        """What was found since the last call, best first, and may still be there at `capture_ns` (monotonic), off
        `known_boxes`; asked of every frame, in their order."""
        interval_ns = min(capture_ns - self._asked_for_ns, INTERVAL_MAX_NS)
        self._asked_for_ns = capture_ns
        with self._changed:
            found, self._places = self._places, []
            if capture_ns - self._seen_ns > max(PLACE_AGE_MAX_NS, PLACE_AGE_MAX_FRAMES * interval_ns):
                return []
        return [place for place in found if not lies_on(place.box_xyxy_px, known_boxes)][: max(at_most, 0)]

    def counters(self) -> dict[str, int]:
        """searches made, search_failed, and refused_REASON of what they saw."""
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
            places = asked.estimator.anywhere(asked.frame, asked.known_boxes, refused)
        except Exception:
            # One search is lost; tracking goes on, and the next may do.
            failed = True
            log.exception("a search of the whole frame failed")
        with self._changed:
            self._counts.update(searches=1, search_failed=int(failed))
            self._counts.update({f"refused_{reason}": n for reason, n in refused.items()})
            self._places, self._seen_ns = places, asked.frame.meta.capture_ns
            self._busy = False
