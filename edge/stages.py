"""Time that one frame spends in each stage, from its exposure to the links."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from edge import clock
from edge.types import FrameMeta

STAGES = {
    "capture": "exposure to pixels in memory",
    "wait": "pixels in memory to taken by the loop",
    "preprocess": "windows cut and scaled for the network",
    "inference": "the network itself, all its runs",
    "decode": "the network's answer to poses; between two runs also the next one's windows",
    "track": "association and filters",
    "publish": "handed to the links",
    "total": "exposure to handed to the links",
}


def table_markdown() -> str:
    """The table as shown in the documentation."""
    rows = [f"| {stage} | {text} |" for stage, text in STAGES.items()]
    return "\n".join(["| stage | from what to what |", "|---|---|", *rows]) + "\n"


class StageClock:
    """Stage times of one frame; each lap is added to a row of STAGES."""

    def __init__(self, meta: FrameMeta, now_ns: int) -> None:
        self._begin_ns = meta.capture_ns
        self._last_ns = now_ns
        self._stages_ns = Counter(capture=meta.arrival_ns - meta.capture_ns, wait=now_ns - meta.arrival_ns)

    def lap(self, stage: str) -> None:
        """Count the time since the last lap as `stage`."""
        self._until(clock.monotonic_ns(), stage)

    def estimated(self, runs_ns: Sequence[tuple[int, int]]) -> None:
        """Split the time since the last lap, all spent in the estimator, by its inferences `runs_ns` (begin, end)."""
        before = "preprocess"
        for begin_ns, end_ns in runs_ns:
            self._until(begin_ns, before)
            self._until(end_ns, "inference")
            before = "decode"
        self._until(clock.monotonic_ns(), before)

    def stages_ns(self) -> dict[str, int]:
        """Nanoseconds per stage; `total` is from exposure to the last lap."""
        return {**self._stages_ns, "total": self._last_ns - self._begin_ns}

    def _until(self, now_ns: int, stage: str) -> None:
        self._stages_ns[stage] += now_ns - self._last_ns
        self._last_ns = now_ns
