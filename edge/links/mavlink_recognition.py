"""Decides which messages are authentic, which autopilot is ours, and on which link it is received.

Every time is an argument (monotonic ns). Pure except for its counters and the state that signing saves.
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

# Why an autopilot that is heard is not believed, by the reason of refusal.
UNBELIEVED = {
    "unsigned": "an autopilot is heard that does not sign; nothing of it is used: give it the key of signing_key",
    "signature": "an autopilot is heard that signs with another key than signing_key; nothing of it is used",
    "replay": "an autopilot is heard that signs with a time of the past; nothing of it is used until it knows the time",
}
HEARD_OFTEN = 3  # its refused heartbeats until that is reported


class Recognition:
    """Links are numbered in order of preference."""

    def __init__(self, vehicle: Vehicle, system_id: int | None, signing: Signing | None, refused: Counter[str]) -> None:
        """`system_id`: our own as configured, or None; `signing` None: unsigned; `refused`: counts by reason."""
        self.home = Home()
        self._vehicle = vehicle
        self._named = system_id
        self._signing = signing
        self._refused = refused
        self._rivals = Rivals()
        self._left = Rivals()  # autopilots received while our own is silent
        self._changes: list[str] = []
        self._unbelieved: Counter[str] = Counter()  # an autopilot's heartbeats while none is received, by reason
        self._untold = dict(UNBELIEVED)

    def authentic(self, messages: Iterable[Any]) -> list[Any]:
        """The messages with a valid signature; all of them without signing."""
        if self._signing is None:
            return list(messages)
        believed = []
        for message in messages:
            reason = self._signing.refusal(message)
            if reason is None:
                believed.append(message)
            else:
                self._refused[reason] += 1
                autopilot = is_autopilot_heartbeat(message) and self._named in (None, message.get_srcSystem())
                self._unbelieved[reason] += autopilot and self._vehicle.contact is not Contact.HEARD
        return believed

    def introduces(self, message: Any, now_ns: int) -> bool:
        """Whether an authentic message is the heartbeat of an autopilot that may be ours. Another aircraft's is
        remembered."""
        if not is_autopilot_heartbeat(message):
            return False
        if not self._may_be_ours(message):
            self._notice(message.get_srcSystem(), now_ns)
            return False
        return True

    def is_stranger(self, message: Any) -> bool:
        """Whether a message is from a system known to be another aircraft."""
        return self._vehicle.is_stranger(message.get_srcSystem())

    def displaces(self, message: Any, now_ns: int) -> bool:
        """Whether a message from an address other than the accepted peer's is a heartbeat for which it replaces that
        peer: one of our own autopilot that the peer no longer brings, one of the system that was our own before, or,
        with signing, one whose signature proves that the peer delays messages. Another aircraft's is remembered as
        such."""
        if not is_autopilot_heartbeat(message):
            return False
        system = message.get_srcSystem()
        if self._signing is None or self._signing.unproven(message) is None:
            self._notice(system, now_ns)
        if not self._may_be_ours(message):
            return False
        if self._signing is not None:
            return self._signing.outruns(message, now_ns)
        lost = system == self._vehicle.system_id and self._vehicle.contact is Contact.LOST
        return lost or self._vehicle.was_own(system)

    def heard(self, message: Any, link: int, now_ns: int) -> None:
        """An authentic message received on a link; those of our autopilot show which links it is on."""
        if (message.get_srcSystem(), message.get_srcComponent()) == (self._vehicle.system_id, AUTOPILOT_COMPONENT):
            self._vehicle.spoke(now_ns)
            self.home.heard(link, now_ns)

    def meet(self, heartbeat: Any, link: int, now_ns: int) -> bool:
        """Process an autopilot's authentic heartbeat; whether it is our own's, possibly from now on."""
        vehicle, system = self._vehicle, heartbeat.get_srcSystem()
        before, back = vehicle.system_id, vehicle.was_own(system)
        # The kind of autopilot is taken from the home link only: PX4 is sent fewer messages than others.
        at_home = system != before or self.home.may_be(link, now_ns)
        if not vehicle.heartbeat(system, heartbeat.autopilot if at_home else None, now_ns):
            self._heard_other(system, now_ns)
            return False
        self._rivals.forget(system)
        self._left = Rivals()
        if before not in (None, system):
            self.home = Home()  # the previous autopilot's links say nothing about this one's
            since = f"autopilot {before} is silent; {system}, first heard since, is taken for our own: set system_id"
            again = f"autopilot {system} is heard again; it is our own, and {before} another's: set system_id"
            self._changes.append(again if back else since)
        if at_home and link != self.home.link:
            self.home.move(link, now_ns)
            vehicle.ask_anew()
        self.home.heard(link, now_ns)
        return True

    def news(self) -> list[str]:
        """Sentences, each once: why an autopilot is not believed while none is received; other candidates for our own,
        and, if it is not configured, changes of it."""
        often = [reason for reason in self._untold if self._unbelieved[reason] >= HEARD_OFTEN]
        return [*map(self._untold.pop, often), *self._candidates()]

    def _candidates(self) -> list[str]:
        if self._vehicle.contact is Contact.WAITING:
            others = [] if self._named is None else self._rivals.news()
            return [f"autopilot {system} is heard, but not {self._named}, which system_id names" for system in others]
        if self._named is not None:
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
        if self._vehicle.system_id not in (None, system_id):
            if self._named is None:
                self._vehicle.noticed(system_id, now_ns)
            self._heard_other(system_id, now_ns)

    def _heard_other(self, system_id: int, now_ns: int) -> None:
        (self._left if self._vehicle.contact is Contact.LOST else self._rivals).heard(system_id, now_ns)
