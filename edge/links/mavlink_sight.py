"""Targets in the last frame, to answer requests for a single message. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from edge.links import mavlink_messages as words
from edge.links.mavlink_table import ADSB_VEHICLE, FOLLOW_TARGET, GEO_STATUS, TARGET_RELATIVE
from edge.links.mavlink_traffic import adsb_vehicle, follow_target
from edge.types import Report, Track


@dataclass(frozen=True)
class Sight:
    """`tracks`: those that may be sent; `first`: the one for messages with room for one; `seen_ns`: monotonic."""

    report: Report
    tracks: list[Track]
    first: Track | None
    seen_ns: int

    def tells(self, message_id: int) -> bool:
        """Whether a target message with this id can be sent."""
        if message_id == TARGET_RELATIVE:
            return bool(self.tracks)
        if message_id == ADSB_VEHICLE:
            return any(adsb_vehicle(self.report, track, 1, self.seen_ns) is not None for track in self.tracks)
        if self.first is None:
            return False
        made = {GEO_STATUS: words.geo_status, FOLLOW_TARGET: follow_target}[message_id]
        return made(self.report, self.first) is not None
