"""Our two MAVLink components, onboard computer and camera: messages in, messages out, no sockets.

Every time is an argument (monotonic ns). Used by one thread. Links are numbered in order of preference; telemetry is
accepted on only one of them, the home link.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

from edge.clock import UtcClock
from edge.config import MavlinkSettings
from edge.health import Condition
from edge.links import mavlink_messages as words
from edge.links.allowance import Allowance
from edge.links.computer_status import ComputerReader, onboard_computer_status
from edge.links.mavlink_commands import answer
from edge.links.mavlink_namesakes import Namesakes
from edge.links.mavlink_packing import Letter
from edge.links.mavlink_primary import Primary
from edge.links.mavlink_rates import sent_rates_hz, wanted_rates_hz
from edge.links.mavlink_receive import AUTOPILOT_COMPONENT, COMMANDS, is_autopilot_heartbeat, misaddressed
from edge.links.mavlink_recognition import Recognition
from edge.links.mavlink_schedule import Schedule
from edge.links.mavlink_sight import Sight
from edge.links.mavlink_table import (
    ADSB_VEHICLE,
    ATTITUDE,
    ATTITUDE_QUATERNION,
    CAMERA_INFORMATION,
    COMMAND_ACK,
    COMPUTER_STATUS,
    FOLLOW_TARGET,
    GEO_STATUS,
    HEARTBEAT,
    IMAGE_STATUS,
    SYS_STATUS,
    TARGET_RELATIVE,
    TIMESYNC,
)
from edge.links.mavlink_telemetry import Telemetry, uptime_ms
from edge.links.mavlink_traffic import adsb_vehicle, follow_target
from edge.links.mavlink_vehicle import Contact, Vehicle
from edge.links.outgoing import rangeless, sendable
from edge.links.signing import Signing
from edge.requests import RequestQueue
from edge.tracking.clock import TimesyncEstimator
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import CameraInfo, Report, Track
from msgs.mavlink import dialect

SYSTEM_ID_UNTIL_HEARD = 1  # MAVLink's default vehicle, so that a peer that waits for us receives our heartbeat
HEARTBEAT_NS, TIMESYNC_NS = 1_000_000_000, 200_000_000
HEALTH_AGE_MAX_NS = 3_000_000_000  # older: the loop is stuck, which no heartbeat may hide
FRAMELESS_NS = 1_000_000_000  # no report for longer: the image status becomes idle, so that displays clear the box
TEXTS_HELD = 4
NEWS_AT_ONCE, NEWS_NS = 32, 500_000_000
STANDS_IN = {ATTITUDE: ATTITUDE_QUATERNION}


@dataclass
class Outgoing:
    """Messages for all links, and for the home link only."""

    everywhere: list[Letter] = field(default_factory=list)
    home: list[Letter] = field(default_factory=list)


class Station:
    """`own_ship` is filled from the autopilot's telemetry, `requests` from commands; `signing` None: unsigned."""

    def __init__(
        self,
        settings: MavlinkSettings,
        own_ship: OwnShipBuffer,
        camera: CameraInfo,
        requests: RequestQueue,
        signing: Signing | None = None,
    ) -> None:
        self.counters: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.timesync = TimesyncEstimator()
        self.vehicle = Vehicle(settings.system_id, wanted_rates_hz(settings, own_ship), STANDS_IN)
        self.recognition = Recognition(self.vehicle, settings.system_id, signing, self.refused)
        self._settings = settings
        self._camera = camera
        self._requests = requests
        self._utc = UtcClock()
        self._telemetry = Telemetry(own_ship, self.timesync, self._utc, settings.gimbal_component_id)
        self._components = (settings.component_id, settings.camera_component_id)
        self._namesakes = Namesakes(dict(zip(self._components, ("component_id", "camera_component_id"), strict=True)))
        self._schedule = Schedule(sent_rates_hz(settings))
        self._computer = ComputerReader()
        self._heartbeat_due_ns = self._timesync_due_ns = 0
        self._health: tuple[Condition, int] | None = None
        self._sight: Sight | None = None
        self._text_id = 0
        # Held until the autopilot is received: the last warnings, and the daemon's state.
        self._held_texts: deque[tuple[int, str]] = deque(maxlen=TEXTS_HELD)
        self._held_state: tuple[int, str] | None = None
        self._news = Allowance(NEWS_AT_ONCE, NEWS_NS)
        self._primary = Primary()

    @property
    def home(self) -> int | None:
        """The link on which telemetry is requested and accepted."""
        return self.recognition.home.link

    def take(self, messages: Iterable[Any], link: int, now_ns: int) -> list[Letter]:
        """Process authentic messages from a trusted address of a link; returns replies to it."""
        replies: list[Letter] = []
        for message in messages:
            self.recognition.heard(message, link, now_ns)
            if is_autopilot_heartbeat(message):
                self._count(message, None if self._meet(message, link, now_ns) else "not_our_autopilot")
                continue
            self._namesakes.heard(message, self.vehicle.system_id)
            reason = self._misdirected(message, link)
            self._count(message, reason)
            if reason is None:
                replies += self._believe(message, now_ns)
        return replies

    def health(self, condition: Condition, now_ns: int) -> None:
        """The loop's state, to be called regularly; HEARTBEAT reports it and stops without it."""
        self._health = (condition, now_ns)

    def tick(self, now_ns: int) -> Outgoing:
        """What is due: heartbeats, computer status, time synchronisation, requests for rates."""
        self.vehicle.tick(now_ns)
        out = Outgoing()
        if now_ns >= self._heartbeat_due_ns and (condition := self._condition(now_ns)) is not None:
            self._heartbeat_due_ns = now_ns + HEARTBEAT_NS
            out.everywhere.append(self._letter(words.heartbeat(dialect.MAV_TYPE_ONBOARD_CONTROLLER, condition)))
            out.everywhere.append(self._letter(words.heartbeat(dialect.MAV_TYPE_CAMERA, condition), camera=True))
            self._namesakes.sent(out.everywhere)
        if self.vehicle.contact is not Contact.WAITING:
            out.everywhere += self._held()
        frameless = self._sight is not None and not self._in_sight(now_ns)
        if frameless and self._schedule.due(IMAGE_STATUS, 0, now_ns):
            out.everywhere.append(self._image_status(words.idle_image_status()))
        if self.vehicle.contact is not Contact.HEARD:
            return out
        if self._schedule.due(COMPUTER_STATUS, 0, now_ns):
            out.everywhere += self._computer_status(now_ns)
        if now_ns >= self._timesync_due_ns:
            self._timesync_due_ns = now_ns + TIMESYNC_NS
            out.home.append(self._letter(dialect.MAVLink_timesync_message(0, self.timesync.request(now_ns))))
        wanted = self.vehicle.request(now_ns)
        if wanted is not None:
            out.home.append(self._letter(words.interval_request(self._system_id, *wanted)))
        return out

    def report(self, report: Report, now_ns: int) -> list[Letter]:
        """Messages for one frame, as far as each message's rate allows.

        Nothing before the vehicle is known. While its autopilot is silent, only the image status: otherwise a display
        on another link would keep drawing the last box.
        """
        # The true size and K: of a camera that was absent at the start, only the calibration was known.
        self._camera = replace(self._camera, image_size_wh=report.image_size_wh, K=report.K)
        if self.vehicle.contact is Contact.WAITING:
            return []
        tracks = sendable(report, now_ns, self._settings.max_age_ms)
        self.counters["tracks_withheld"] += len(report.tracks) - len(tracks)
        first = self._primary.of(report.tracks, tracks, report.chosen_id, now_ns)
        self._sight = Sight(report, tracks, first, now_ns)
        shown = first or self._primary.in_image(
            report.tracks, rangeless(report, now_ns, self._settings.max_age_ms), report.chosen_id, now_ns
        )
        seen = words.image_status(report, shown) if self._schedule.due(IMAGE_STATUS, 0, now_ns) else None
        if self.vehicle.contact is not Contact.HEARD:
            return [self._image_status(seen)] if seen is not None else []
        out = [self._target_relative(report, track) for track in tracks if self._wants_target_relative(track, now_ns)]
        if seen is not None:
            out.append(self._image_status(seen))
        geo_due = first is not None and self._schedule.due(GEO_STATUS, 0, now_ns)
        place = words.geo_status(report, first) if first is not None and geo_due else None
        if place is not None:
            out.append(self._letter(place, camera=True, unknown=words.GEO_STATUS_UNKNOWN))
        return out + self._traffic(report, tracks, first, now_ns)

    def event(self, severity: int, text: str, now_ns: int, of_state: bool = False) -> list[Letter]:
        """STATUSTEXT for the operator; `severity` is a MAV_SEVERITY. Warnings and errors are always sent; lesser ones
        (an operator who drags a point over the image causes many) are rate-limited, for the sake of radios.

        Nothing is sent before the vehicle's id is known. Once the autopilot is received, the last warnings are sent,
        and of the reports on the daemon's state (`of_state`) the latest, if it is a warning: even with a configured id,
        as nobody may have been there to receive them before."""
        wrong = severity <= dialect.MAV_SEVERITY_WARNING
        if self.vehicle.contact is Contact.WAITING:
            if of_state:
                self._held_state = (severity, text) if wrong else None
            elif wrong:
                self._held_texts.append((severity, text))
        if self.vehicle.system_id is None:
            return []
        if not wrong and not self._news.take(now_ns):
            self.counters["news_left_out"] += 1
            return []
        return self._texts(severity, text)

    def _held(self) -> list[Letter]:
        held = [*self._held_texts, *([] if self._held_state is None else [self._held_state])]
        self._held_texts.clear()
        self._held_state = None
        return [letter for text in held for letter in self._texts(*text)]

    def news(self, now_ns: int) -> list[str]:
        """Sentences, each once: problems that a person has to fix."""
        return self.recognition.news() + self._telemetry.news(now_ns) + self._namesakes.news()

    def withheld(self) -> list[str]:
        """Sentences: messages that are configured but not sent to this vehicle."""
        settings, found = self._settings, []
        if settings.target_relative and TARGET_RELATIVE not in self._enabled():
            found.append("TARGET_RELATIVE is not sent to PX4; target_relative_to_px4 = true sends it")
        if self._traffic_ids and self._virtual_id_taken:
            found.append(f"neither FOLLOW_TARGET nor ADSB_VEHICLE is sent: this vehicle too is {self._system_id}")
        return found

    def _meet(self, heartbeat: Any, link: int, now_ns: int) -> bool:
        before = self.vehicle.system_id
        ours = self.recognition.meet(heartbeat, link, now_ns)
        if before not in (None, self.vehicle.system_id):
            self._telemetry.forget(now_ns)  # another vehicle's clock, attitude and origin
            self.timesync.clear()
        return ours

    def _misdirected(self, message: Any, link: int) -> str | None:
        vehicle_id = self.vehicle.system_id
        if vehicle_id is None:
            return "before_heartbeat"
        reason = misaddressed(message, vehicle_id, self._components.__contains__, self._enabled())
        if reason is not None:
            return reason
        if message.get_msgId() in COMMANDS:
            allowed = self._settings.commanders
            return None if not allowed or message.get_srcSystem() in allowed else "not_a_commander"
        # TIMESYNC requests are answered on any link; replies to ours are accepted on the home link only.
        asks_time = message.get_msgId() == TIMESYNC and message.tc1 == 0
        return None if link == self.home or asks_time else "other_link"

    def _believe(self, message: Any, now_ns: int) -> list[Letter]:
        message_id = message.get_msgId()
        self.vehicle.arrived(message_id, now_ns)
        if message_id == TIMESYNC:
            if message.tc1 == 0:
                # UTC, the clock of our timestamps: PX4 adds the offset measured here to that of TARGET_RELATIVE.
                return [self._letter(dialect.MAVLink_timesync_message(self._utc.utc_ns(now_ns), message.ts1))]
            self.counters["timesync_refused"] += not self.timesync.reply(message.tc1, message.ts1, now_ns)
        elif message_id == COMMAND_ACK:
            if message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
                self.vehicle.acknowledged(message.result == dialect.MAV_RESULT_ACCEPTED)
        elif message_id in COMMANDS:
            return self._obey(message, now_ns)
        elif message_id == SYS_STATUS:
            self._telemetry.take_health(message)
        elif message_id != HEARTBEAT:
            self.recognition.home.carries()
            by_autopilot = message.get_srcComponent() == AUTOPILOT_COMPONENT
            up_ms = uptime_ms(message.time_boot_ms, self.timesync.offset_ns, now_ns)
            if by_autopilot and self.vehicle.boot_time(up_ms):
                self._telemetry.forget(now_ns)
                self.timesync.clear()
            elif by_autopilot and self.vehicle.clock_set_back(message_id, message.get_seq(), up_ms):
                self._telemetry.clock_set_back()
                self.timesync.jumped()
            reason = self._telemetry.take(message, now_ns, self.vehicle.autopilot)
            for kind in ("position_jumps", "attitude_jumps", "gimbal_jumps"):
                self.counters[kind] = getattr(self._telemetry, kind)
            if (ahead_ns := self._telemetry.daytime.ahead_ns) is not None:
                self.counters["utc_ahead_ms"] = ahead_ns // 1_000_000
            else:
                del self.counters["utc_ahead_ms"]  # of the autopilot before its reboot
            if reason is not None:
                self.refused[reason] += 1
        return []

    def _obey(self, command: Any, now_ns: int) -> list[Letter]:
        width_px, height_px = self._camera.image_size_wh
        camera = command.target_component in (0, self._settings.camera_component_id)
        reply = answer(command, self._enabled(), width_px / height_px, camera)
        result = reply.result
        refused = reply.request is not None and not self._requests.put(reply.request)
        if refused or (reply.send_once is not None and not self._tells(reply.send_once, now_ns)):
            result = dialect.MAV_RESULT_TEMPORARILY_REJECTED
        asker = (command.get_srcSystem(), command.get_srcComponent())
        ack = dialect.MAVLink_command_ack_message(command.command, result, 0, 0, *asker)
        out = [self._letter(ack, camera=camera)]
        if result != reply.result:
            return out
        if reply.interval is not None:
            self._schedule.set_rate(*reply.interval)
        return out if reply.send_once is None else out + self._once(reply.send_once, now_ns)

    def _tells(self, message_id: int, now_ns: int) -> bool:
        """Whether there is content for a message now."""
        if message_id == CAMERA_INFORMATION:
            return True
        if message_id == IMAGE_STATUS:  # before the autopilot is received no target is told, so nor that there is none
            return self.vehicle.contact is not Contact.WAITING
        if message_id == HEARTBEAT:
            return self._condition(now_ns) is not None
        if self.vehicle.contact is not Contact.HEARD:
            return False
        seen = self._sight if self._in_sight(now_ns) else None
        return message_id == COMPUTER_STATUS or (seen is not None and seen.tells(message_id))

    def _once(self, message_id: int, now_ns: int) -> list[Letter]:
        """The message at once if nothing else is needed for it; otherwise it is sent as soon as possible."""
        if message_id == CAMERA_INFORMATION:
            of_it = (self._settings.sensor_width_mm, self._telemetry.gimbal_id, now_ns // 1_000_000 % 2**32)
            information = words.camera_information(self._camera, *of_it)
            return [self._letter(information, camera=True, unknown=words.CAMERA_INFORMATION_UNKNOWN)]
        if message_id == IMAGE_STATUS and not self._in_sight(now_ns):
            return [self._image_status(words.idle_image_status())]
        if message_id == HEARTBEAT:
            self._heartbeat_due_ns = 0
        else:
            self._schedule.ask_once(message_id, now_ns)
        return []

    def _condition(self, now_ns: int) -> Condition | None:
        """As the loop reported it; None: it is stuck."""
        return self._health[0] if self._health and now_ns - self._health[1] <= HEALTH_AGE_MAX_NS else None

    def _in_sight(self, now_ns: int) -> bool:
        """Whether frames are arriving."""
        return self._sight is not None and now_ns - self._sight.seen_ns <= FRAMELESS_NS

    def _enabled(self) -> set[int]:
        """Message ids that may be sent to this autopilot."""
        to_px4 = self.vehicle.autopilot == dialect.MAV_AUTOPILOT_PX4
        withheld = {TARGET_RELATIVE} if to_px4 and not self._settings.target_relative_to_px4 else set()
        return self._schedule.message_ids - withheld - (self._traffic_ids if self._virtual_id_taken else set())

    @property
    def _traffic_ids(self) -> set[int]:
        return self._schedule.message_ids & {FOLLOW_TARGET, ADSB_VEHICLE}

    def _wants_target_relative(self, track: Track, now_ns: int) -> bool:
        return TARGET_RELATIVE in self._enabled() and self._schedule.due(TARGET_RELATIVE, track.track_id, now_ns)

    @property
    def _virtual_id_taken(self) -> bool:
        return self._settings.virtual_system_id == self.vehicle.system_id

    def _target_relative(self, report: Report, track: Track) -> Letter:
        return self._letter(words.target_relative(track, self._utc.utc_ns(report.meta.capture_ns) // 1000))

    def _traffic(self, report: Report, tracks: list[Track], first: Track | None, now_ns: int) -> list[Letter]:
        if self._virtual_id_taken:
            self.counters["virtual_system_id_taken"] += bool(self._traffic_ids)
            return []
        messages = []
        if first is not None and self._schedule.due(FOLLOW_TARGET, 0, now_ns):
            messages.append(follow_target(report, first))
        address = self._settings.adsb_icao_address
        if address is not None:
            due = [track for track in tracks if self._schedule.due(ADSB_VEHICLE, track.track_id, now_ns)]
            messages += [adsb_vehicle(report, track, address, now_ns) for track in due]
        return [self._letter(message, virtual=True) for message in messages if message is not None]

    def _image_status(self, status: Any) -> Letter:
        return self._letter(status, camera=True, unknown=words.IMAGE_STATUS_UNKNOWN)

    def _texts(self, severity: int, text: str) -> list[Letter]:
        self._text_id = self._text_id % 65535 + 1
        return [self._letter(message) for message in words.statustexts(severity, text, self._text_id)]

    def _computer_status(self, now_ns: int) -> list[Letter]:
        try:
            status = self._computer.read()
        except (OSError, ValueError, LookupError):
            self.counters["computer_unread"] += 1
            return []
        return [self._letter(onboard_computer_status(status, self._utc.utc_ns(now_ns) // 1000))]

    @property
    def _system_id(self) -> int:
        return self.vehicle.system_id or SYSTEM_ID_UNTIL_HEARD

    def _letter(
        self, message: Any, *, camera: bool = False, virtual: bool = False, unknown: tuple[str, ...] = ()
    ) -> Letter:
        """From the onboard computer, or the camera, or the virtual system."""
        self.counters[f"sent_{message.get_type()}"] += 1
        settings = self._settings
        system_id = settings.virtual_system_id if virtual else self._system_id
        return Letter(message, system_id, settings.camera_component_id if camera else settings.component_id, unknown)

    def _count(self, message: Any, refusal: str | None) -> None:
        if refusal is None:
            self.counters[f"received_{message.get_type()}"] += 1
        else:
            self.refused[refusal] += 1
