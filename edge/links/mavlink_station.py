"""Both components we are on MAVLink, onboard computer and camera: datagrams in, datagrams out, no socket.

Every time comes in as an argument (monotonic ns). Used by one thread.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from edge.config import MavlinkSettings
from edge.health import HealthState
from edge.links import mavlink_messages as words
from edge.links.mavlink_commands import GEO_STATUS, IMAGE_STATUS, TARGET_RELATIVE, answer
from edge.links.mavlink_receive import COMMANDS, Receiver, is_autopilot_heartbeat, misaddressed
from edge.links.mavlink_vehicle import Contact, Vehicle
from edge.links.outgoing import UtcClock, sendable
from edge.tracking.clock import BootClock, TimesyncEstimator
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import CameraInfo, Report, Track
from msgs.geometry import R_from_euler, q_wxyz_from_R
from msgs.mavlink import MAVLink, dialect, pack

AUTOPILOT_COMPONENT = 1
SYSTEM_ID_UNTIL_HEARD = 1  # MAVLink's default vehicle, to make ourselves known to a peer that waits for us
HEARTBEAT_NS = 1_000_000_000
HEALTH_AGE_MAX_NS = 3_000_000_000  # no word from the loop for longer: it is stuck, and no heartbeat may hide that
TIMESYNC_NS = 200_000_000
GLOBAL_POSITION_HZ = 5.0
SYSTEM_TIME_HZ = 1.0
ATTITUDE_FALLBACK_NS = 1_000_000_000
EARLY_SHARE = 0.1  # a message may come this share of its interval early: frames jitter


class Station:
    """`own_ship` is filled from the autopilot's telemetry."""

    def __init__(self, settings: MavlinkSettings, own_ship: OwnShipBuffer, camera: CameraInfo) -> None:
        self.counters: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.timesync = TimesyncEstimator()
        rates_hz = {
            dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: settings.attitude_rate_hz,
            dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: settings.position_rate_hz,
            dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: GLOBAL_POSITION_HZ,
            dialect.MAVLINK_MSG_ID_SYSTEM_TIME: SYSTEM_TIME_HZ,
        }
        self.vehicle = Vehicle(settings.system_id, rates_hz)
        self._settings = settings
        self._own_ship = own_ship
        self._camera = camera
        self._receiver = Receiver(self.refused)
        # Strangers have a rate limit of their own: their flood must not use up the autopilot's.
        self._stranger_receiver = Receiver(self.refused)
        self._boot_clock = BootClock(self.timesync)
        self._utc = UtcClock()
        components = (settings.component_id, settings.camera_component_id)
        self._packers = {component: MAVLink(None, srcComponent=component) for component in components}
        self._default_hz = {
            TARGET_RELATIVE: settings.target_relative_rate_hz,
            IMAGE_STATUS: settings.tracking_rate_hz,
            GEO_STATUS: settings.tracking_rate_hz,
        }
        self._hz = dict(self._default_hz)
        self._due_ns: dict[tuple[int, int], int] = {}
        self._heartbeat_due_ns = self._timesync_due_ns = 0
        self._health: tuple[HealthState, int] | None = None
        self._quaternion_ns: int | None = None
        self._text_id = 0

    def introduces(self, datagram: bytes, now_ns: int) -> bool:
        """Whether a stranger's datagram holds the heartbeat of an autopilot that we would listen to."""
        fixed = self._settings.system_id
        return any(
            is_autopilot_heartbeat(message) and fixed in (None, message.get_srcSystem())
            for message in self._stranger_receiver.take(datagram, now_ns)
        )

    def take(self, datagram: bytes, now_ns: int) -> list[bytes]:
        """Take a datagram from a trusted address; returns replies."""
        replies: list[bytes] = []
        for message in self._receiver.take(datagram, now_ns):
            if is_autopilot_heartbeat(message):
                before = self.vehicle.system_id
                known = self.vehicle.heartbeat(message.get_srcSystem(), message.autopilot, now_ns)
                if before not in (None, self.vehicle.system_id):
                    self._forget()  # another vehicle's clock, attitude and origin
                self._count(message, None if known else "not_our_autopilot")
                continue
            vehicle_id = self.vehicle.system_id
            reason: str | None = "before_heartbeat"
            if vehicle_id is not None:
                reason = misaddressed(message, vehicle_id, self._packers.__contains__)
            self._count(message, reason)
            if reason is None:
                replies += self._believe(message, now_ns)
        return replies

    def health(self, state: HealthState, now_ns: int) -> None:
        """A word from the loop; HEARTBEAT follows it and stops without it."""
        self._health = (state, now_ns)

    def tick(self, now_ns: int) -> list[bytes]:
        """Let time pass: heartbeats, time synchronisation, requests for rates."""
        self.vehicle.tick(now_ns)
        out: list[bytes] = []
        if now_ns >= self._heartbeat_due_ns and self._health and now_ns - self._health[1] <= HEALTH_AGE_MAX_NS:
            self._heartbeat_due_ns = now_ns + HEARTBEAT_NS
            state = self._health[0]
            out.append(self._packed(words.heartbeat(dialect.MAV_TYPE_ONBOARD_CONTROLLER, state)))
            out.append(self._packed(words.heartbeat(dialect.MAV_TYPE_CAMERA, state), camera=True))
        if self.vehicle.contact is not Contact.HEARD:
            return out
        if now_ns >= self._timesync_due_ns:
            self._timesync_due_ns = now_ns + TIMESYNC_NS
            out.append(self._packed(dialect.MAVLink_timesync_message(0, self.timesync.request(now_ns))))
        wanted = self.vehicle.request(now_ns)
        if wanted is not None:
            out.append(self._packed(self._interval_request(*wanted)))
        return out

    def report(self, report: Report, now_ns: int) -> list[bytes]:
        """What goes out for one frame, as far as each message's rate allows."""
        if self.vehicle.contact is not Contact.HEARD:
            return []
        tracks = sendable(report, now_ns, self._settings.max_age_ms)
        self.counters["tracks_withheld"] += len(report.tracks) - len(tracks)
        out = [self._target_relative(report, track) for track in tracks if self._wants_target_relative(track, now_ns)]
        first = words.primary(tracks)
        if self._due(IMAGE_STATUS, 0, now_ns):
            status = words.image_status(report, first)
            out.append(self._packed(status, camera=True, unknown=words.IMAGE_STATUS_UNKNOWN))
        if first is not None:
            place = words.geo_status(report, first)
            if place is not None and self._due(GEO_STATUS, 0, now_ns):
                out.append(self._packed(place, camera=True, unknown=words.GEO_STATUS_UNKNOWN))
        return out

    def event(self, severity: int, text: str) -> list[bytes]:
        """STATUSTEXT for the operator; `severity` is a MAV_SEVERITY."""
        self._text_id = self._text_id % 65535 + 1
        return [self._packed(message) for message in words.statustexts(severity, text, self._text_id)]

    def _believe(self, message: Any, now_ns: int) -> list[bytes]:
        message_id = message.get_msgId()
        self.vehicle.arrived(message_id, now_ns)
        if message_id == dialect.MAVLINK_MSG_ID_TIMESYNC:
            if message.tc1 == 0:
                return [self._packed(dialect.MAVLink_timesync_message(now_ns, message.ts1))]
            self.counters["timesync_refused"] += not self.timesync.reply(message.tc1, message.ts1, now_ns)
        elif message_id == dialect.MAVLINK_MSG_ID_COMMAND_ACK:
            if message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
                self.vehicle.acknowledged(message.result == dialect.MAV_RESULT_ACCEPTED)
        elif message_id in COMMANDS:
            return self._obey(message, now_ns)
        elif message_id != dialect.MAVLINK_MSG_ID_HEARTBEAT:
            self._telemetry(message, now_ns)
        return []

    def _telemetry(self, message: Any, now_ns: int) -> None:
        if self.vehicle.boot_time(message.time_boot_ms):
            self._forget()
        time_ns = self._boot_clock.monotonic_ns(message.time_boot_ms * 1_000_000, now_ns)
        message_id = message.get_msgId()
        taken = True
        if message_id == dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
            self._quaternion_ns = now_ns
            q = (message.q1, message.q2, message.q3, message.q4)
            taken = self._own_ship.add_attitude(time_ns, q, _rates(message))
        elif message_id == dialect.MAVLINK_MSG_ID_ATTITUDE:
            if self._quaternion_ns is None or now_ns - self._quaternion_ns > ATTITUDE_FALLBACK_NS:
                q_wxyz = q_wxyz_from_R(R_from_euler(message.roll, message.pitch, message.yaw))
                taken = self._own_ship.add_attitude(time_ns, q_wxyz, _rates(message))
        elif message_id == dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            t_ned_m, v_ned_mps = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
            taken = self._own_ship.add_position(time_ns, t_ned_m, v_ned_mps)
        # 0, 0 is how an autopilot without a fix says so.
        elif message_id == dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT and (message.lat, message.lon) != (0, 0):
            place = (message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3)
            v_ned_mps = (message.vx * 1e-2, message.vy * 1e-2, message.vz * 1e-2)
            taken = self._own_ship.add_global(time_ns, place, v_ned_mps)
        self.refused["late"] += not taken

    def _forget(self) -> None:
        """What was heard holds no more: the autopilot has started again, or it is another."""
        self._own_ship.clear()
        self._boot_clock.clear()
        self.timesync.clear()
        self._quaternion_ns = None

    def _obey(self, command: Any, now_ns: int) -> list[bytes]:
        reply = answer(command)
        camera = command.target_component == self._settings.camera_component_id
        asker = (command.get_srcSystem(), command.get_srcComponent())
        ack = dialect.MAVLink_command_ack_message(command.command, reply.result, 0, 0, *asker)
        out = [self._packed(ack, camera=camera)]
        if reply.interval is not None:
            message_id, hz = reply.interval
            self._hz[message_id] = self._default_hz[message_id] if hz is None else hz
        if reply.send_camera_information:
            boot_ms = now_ns // 1_000_000 % 2**32
            information = words.camera_information(self._camera, boot_ms)
            out.append(self._packed(information, camera=True, unknown=words.CAMERA_INFORMATION_UNKNOWN))
        return out

    def _interval_request(self, message_id: int, rate_hz: float) -> Any:
        # PX4 refuses the command unless the parameters it does not know are zero.
        return dialect.MAVLink_command_long_message(
            self._system_id, AUTOPILOT_COMPONENT, dialect.MAV_CMD_SET_MESSAGE_INTERVAL, 0,
            message_id, 1e6 / rate_hz, 0, 0, 0, 0, 0,
        )  # fmt: skip

    def _wants_target_relative(self, track: Track, now_ns: int) -> bool:
        if not self._settings.target_relative:
            return False
        if self.vehicle.autopilot == dialect.MAV_AUTOPILOT_PX4 and not self._settings.target_relative_to_px4:
            return False
        return self._due(TARGET_RELATIVE, track.track_id, now_ns)

    def _target_relative(self, report: Report, track: Track) -> bytes:
        self.counters["sent_TARGET_RELATIVE"] += 1
        utc_us = self._utc.utc_ns(report.meta.capture_ns) // 1000
        return words.target_relative(self._packer(camera=False), track, utc_us)

    def _due(self, message_id: int, instance: int, now_ns: int) -> bool:
        hz = self._hz[message_id]
        if hz == 0.0:
            return False
        interval_ns = round(1e9 / hz)
        due_ns = self._due_ns.get((message_id, instance), now_ns)
        if now_ns < due_ns - EARLY_SHARE * interval_ns:
            return False
        self._due_ns[message_id, instance] = max(due_ns, now_ns - interval_ns) + interval_ns
        return True

    @property
    def _system_id(self) -> int:
        return self.vehicle.system_id or SYSTEM_ID_UNTIL_HEARD

    def _packer(self, camera: bool) -> Any:
        settings = self._settings
        packer = self._packers[settings.camera_component_id if camera else settings.component_id]
        packer.srcSystem = self._system_id
        return packer

    def _packed(self, message: Any, *, camera: bool = False, unknown: tuple[str, ...] = ()) -> bytes:
        self.counters[f"sent_{message.get_type()}"] += 1
        return pack(self._packer(camera), message, unknown=unknown)

    def _count(self, message: Any, refusal: str | None) -> None:
        if refusal is None:
            self.counters[f"received_{message.get_type()}"] += 1
        else:
            self.refused[refusal] += 1


def _rates(message: Any) -> tuple[float, float, float]:
    return message.rollspeed, message.pitchspeed, message.yawspeed
