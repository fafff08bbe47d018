"""Targets of which a tracker tells the direction alone, because their range is not known. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sim_replay.evaluation.judge import JudgedFrame
from sim_replay.score import direction_statistics


def directions(judged: Sequence[JudgedFrame]) -> dict[str, Any] | None:
    """`direction_statistics` of many images; None without any direction, and thus without a tracker."""
    told = [frame for frame in judged if frame.directions]
    return direction_statistics(
        [seen for frame in told for seen in frame.directions],
        [match for frame in told for match in frame.matches],
        sum(len(frame.false_directions) for frame in judged),
    )
