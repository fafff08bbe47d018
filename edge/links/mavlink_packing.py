"""Outgoing messages, and how each endpoint packs them.

Receivers count losses by the sequence numbers of a component's messages, and reject signed ones that are not newer than
the last with the same link id. Endpoints send different messages with different delays, so each has its own sequence
numbers and link id.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from edge.links.signing import Signing
from msgs.mavlink import MAVLink, pack

LINK_IDS = 256


@dataclass(frozen=True)
class Letter:
    """A message and its sender; in the fields `unknown`, NaN means "not known"."""

    message: Any
    system_id: int
    component_id: int
    unknown: tuple[str, ...] = ()


class Packer:
    """For one endpoint: `link` is its number, `signing` None: unsigned."""

    def __init__(self, link: int, signing: Signing | None) -> None:
        self._link_id = link % LINK_IDS
        self._signing = signing
        self._senders: dict[tuple[int, int], MAVLink] = {}

    def packed(self, letter: Letter) -> bytes:
        """The frame for this endpoint, with the next sequence number. Raises ValueError if a value does not fit."""
        sender = (letter.system_id, letter.component_id)
        mav = self._senders.get(sender)
        if mav is None:
            mav = self._senders[sender] = MAVLink(None, *sender)
        if self._signing is not None:
            self._signing.prepare(mav, self._link_id)
        return pack(mav, letter.message, unknown=letter.unknown)
