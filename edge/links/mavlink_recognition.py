"""Whom we believe: whose messages are authentic, which autopilot is ours, and by which link it is heard.

Every time comes in as an argument (monotonic ns). Pure but for its counters and what signing saves.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

from edge.links.mavlink_home import Home
from edge.links.mavlink_receive import AUTOPILOT_COMPONENT, is_autopilot_heartbeat
from edge.links.mavlink_rivals import Rivals
from edge.links.mavlink_vehicle import Contact, Vehicle
from edge.links.signing import Signing


class Recognition:
    """Links are numbers, in the order of preference."""

    def __init__(self, vehicle: Vehicle, system_id: int | None, signing: Signing | None, refused: Counter[str]) -> None:
        """`system_id` is what the settings name as our own, `signing` None: unsigned; `refused` counts by reason."""
        self.home = Home()
        self._vehicle = vehicle
        self._named = system_id
        self._signing = signing
        self._refused = refused
        self._rivals = Rivals()
        self._left = Rivals()  # who is heard while our own is not
        self._changes: list[str] = []

    def authentic(self, messages: Iterable[Any]) -> list[Any]:
        """Those that carry a valid signature; all of them where nothing is signed."""
        if self._signing is None:
            return list(messages)
        believed = []
        for message in messages:
            reason = self._signing.refusal(message)
            if reason is None:
                believed.append(message)
            else:
                self._refused[reason] += 1
        return believed

    def introduces(self, message: Any, now_ns: int) -> bool:
        """Whether an authentic message is the heartbeat of an autopilot that we would listen to. Another aircraft's is
        remembered."""
        if not is_autopilot_heartbeat(message):
            return False
        if not self._may_be_ours(message):
            self._notice(message.get_srcSystem(), now_ns)
            return False
        return True

    def is_stranger(self, message: Any) -> bool:
        """Whether a message is of what is known to be another aircraft."""
        return self._vehicle.is_stranger(message.get_srcSystem())

    def displaces(self, message: Any, now_ns: int) -> bool:
        """Whether a message from an address that is not heeded is a heartbeat by which it is, and who was is no more:
        that of the system that was our own before, or, where messages are signed, one whose signature proves that what
        is heard was held back. Another aircraft's is remembered as such."""
        if not is_autopilot_heartbeat(message):
            return False
        system = message.get_srcSystem()
        if self._signing is None or self._signing.unproven(message) is None:
            self._notice(system, now_ns)
        if not self._may_be_ours(message):
            return False
        return self._vehicle.was_own(system) if self._signing is None else self._signing.outruns(message, now_ns)

    def heard(self, message: Any, link: int, now_ns: int) -> None:
        """An authentic message that came by a link: our autopilot's show where it is."""
        if (message.get_srcSystem(), message.get_srcComponent()) == (self._vehicle.system_id, AUTOPILOT_COMPONENT):
            self._vehicle.spoke(now_ns)
            self.home.heard(link, now_ns)

    def meet(self, heartbeat: Any, link: int, now_ns: int) -> bool:
        """An autopilot's authentic heartbeat; whether it is our own's, if need be from now on."""
        vehicle, system = self._vehicle, heartbeat.get_srcSystem()
        before, back = vehicle.system_id, vehicle.was_own(system)
        # Not at another link's word: to PX4 goes less than to others.
        at_home = system != before or self.home.may_be(link, now_ns)
        if not vehicle.heartbeat(system, heartbeat.autopilot if at_home else None, now_ns):
            self._heard_other(system, now_ns)
            return False
        self._rivals.forget(system)
        self._left = Rivals()
        if before not in (None, system):
            self.home = Home()  # where the last one was heard says nothing of this one
            since = f"autopilot {before} is silent; {system}, first heard since, is taken for our own: set system_id"
            again = f"autopilot {system} is heard again; it is our own, and {before} another's: set system_id"
            self._changes.append(again if back else since)
        if at_home and link != self.home.link:
            self.home.move(link, now_ns)
            vehicle.ask_anew()
        self.home.heard(link, now_ns)
        return True

    def news(self) -> list[str]:
        """Sentences, each once: who else could be the own autopilot, and who is now, where the settings do not tell."""
        if self._named is not None or self._vehicle.contact is Contact.WAITING:
            return []
        if self._vehicle.contact is Contact.LOST:
            lost = self._vehicle.system_id
            return [
                f"autopilot {lost} is silent; {system}, heard, is held for another's: set system_id if it is not"
                for system in self._left.news()
            ]
        changes, self._changes = self._changes, []
        ours = self._vehicle.system_id
        return changes + [
            f"autopilots {ours} and {system} are heard; {ours}, the first, is taken for our own: set system_id"
            for system in self._rivals.news()
        ]

    def _may_be_ours(self, message: Any) -> bool:
        return self._named in (None, message.get_srcSystem()) and not self.is_stranger(message)

    def _notice(self, system_id: int, now_ns: int) -> None:
        if self._named is None and self._vehicle.system_id not in (None, system_id):
            self._vehicle.noticed(system_id, now_ns)
            self._heard_other(system_id, now_ns)

    def _heard_other(self, system_id: int, now_ns: int) -> None:
        (self._left if self._vehicle.contact is Contact.LOST else self._rivals).heard(system_id, now_ns)
