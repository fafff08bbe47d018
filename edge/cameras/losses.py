"""Pictures of a stream that are missing: lost on the way, told by the steps of its own times, or undecodable. Pure."""

from __future__ import annotations

from collections import deque

STEPS = 30
STEPS_MIN = 8
USUAL_SHARE = 0.85  # of the steps are no longer than a usual one: some encoders leave out every fifth picture
LOST_STEP = 1.5  # usual steps
HEALED_MS = 2000.0  # without a key frame for so long, the encoder refreshes its pictures bit by bit


class Losses:
    """Says which pictures are damaged: those after a missing one are predicted from it, up to the next key frame."""

    def __init__(self, lossy: bool) -> None:
        """lossy: of a longer step of the times, the link lost a picture; otherwise the camera took none."""
        self._lossy = lossy
        self._steps_ms: deque[float] = deque(maxlen=STEPS)
        self._last_ms: float | None = None
        self._since_ms: float | None = None  # of the latest loss that no key frame has followed yet

    def damaged(self, position_ms: float, key: bool, after_undecodable: bool = False) -> bool:
        """Whether the picture at this time of the stream is; `key`: it was coded without others. Call it for each that
        can be decoded."""
        step_ms = 0.0 if self._last_ms is None else position_ms - self._last_ms
        self._last_ms = position_ms
        usual_ms = sorted(self._steps_ms)[int(USUAL_SHARE * len(self._steps_ms))] if self._steps_ms else 0.0
        longer = len(self._steps_ms) >= STEPS_MIN and step_ms > LOST_STEP * usual_ms
        lost = after_undecodable or (self._lossy and longer)
        if step_ms > 0.0:
            self._steps_ms.append(step_ms)
        if key or (self._since_ms is not None and not lost and position_ms - self._since_ms >= HEALED_MS):
            self._since_ms = None
        elif lost:
            self._since_ms = position_ms
        return self._since_ms is not None
