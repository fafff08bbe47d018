"""Telemetry of autopilot and gimbal to the own-ship buffer, on the monotonic clock. Pure except for that and UTC."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from edge import clock
from edge.clock import UtcClock
from edge.links.mavlink_daytime import Daytime
from edge.links.mavlink_jumps import Jumps
from edge.links.mavlink_receive import AUTOPILOT_COMPONENT
from edge.links.mavlink_standstill import Standstill
from edge.links.mavlink_table import (
    ATTITUDE,
    ATTITUDE_QUATERNION,
    GIMBAL_ATTITUDE,
    GLOBAL_POSITION_INT,
    LOCAL_POSITION_NED,
    SYSTEM_TIME,
)
from edge.tracking.clock import BootClock, RebootDetector, StepDetector, TimesyncEstimator
from edge.tracking.own_ship import GimbalFrame, OwnShipBuffer
from msgs.geometry import R_from_euler, R_from_q_wxyz, q_wxyz_from_R
from msgs.mavlink import dialect

BOOT_WRAP_MS = 2**32
SAME_CLOCK_MS = 2000
HELD_BACK_MAX_MS = 30_000  # longer than any backlog of a link lasts
# After a jump, data of that kind are ignored for this long, so that frames without them carry the tracks over.
JUMP_REST_NS = 300_000_000
# How far quaternions may lie apart before Euler angles, the same attitude less well rounded, fill the gaps: somebody
# else on the link may have asked for them at a low rate.
QUATERNION_GAP_MAX_NS = 60_000_000
FALLBACK_NS = 1_000_000_000  # silence of the better source after which the other one is used
# Failures that make a gimbal's attitude doubtful; being at an end stop does not.
GIMBAL_FAILURES = (
    dialect.GIMBAL_DEVICE_ERROR_FLAGS_ENCODER_ERROR
    | dialect.GIMBAL_DEVICE_ERROR_FLAGS_POWER_ERROR
    | dialect.GIMBAL_DEVICE_ERROR_FLAGS_SOFTWARE_ERROR
    | dialect.GIMBAL_DEVICE_ERROR_FLAGS_COMMS_ERROR
    | dialect.GIMBAL_DEVICE_ERROR_FLAGS_CALIBRATION_RUNNING
)
# What counts as the same value, but for rounding, in a rotation matrix, a local position (m) and a global one (degrees
# and m); and how far the vehicle has moved meanwhile by its own account: more than the errors that the tracker assumes.
SAME_R, SAME_M, SAME_DEG_M = 1e-5, 1e-3, 5e-8
TURNED_RAD, FLOWN_M = 0.05, 3.0
STANDS = {
    kind: f"the autopilot's {kind} stands still while its {rate} says that it moves: it is not used"
    for kind, rate in {"attitude": "turn rate", "position": "velocity", "global position": "velocity"}.items()
}
UNHEALTHY = "the autopilot says that its attitude is not healthy: it is not used"
SERVO_GIMBAL = "PX4 tells what it steers the gimbal's servos by, not where the camera looks: it is not used"


def gimbal_frame(flags: int) -> GimbalFrame | None:
    """What the quaternion of GIMBAL_DEVICE_ATTITUDE_STATUS is relative to; None if its flags contradict each other.

    Flag 64 means earth, 32 the vehicle's heading; if neither is set, 16 (yaw lock) means earth.
    """
    earth = flags & dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
    heading = flags & dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
    if earth and heading:
        return None
    if not earth and not heading:
        earth = flags & dialect.GIMBAL_DEVICE_FLAGS_YAW_LOCK
    return GimbalFrame.EARTH if earth else GimbalFrame.HEADING


def steers_servos(message: Any, autopilot: int | None) -> bool:
    """Whether a gimbal's attitude is PX4's servo command. That is not a measurement, is in body axes, level or not, and
    its yaw lock flag is that of the request; for gimbals that measure, PX4 sets the frame flags."""
    framed = dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME | dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_VEHICLE_FRAME
    by_px4 = autopilot == dialect.MAV_AUTOPILOT_PX4 and message.get_srcComponent() == AUTOPILOT_COMPONENT
    return by_px4 and not message.flags & framed


def uptime_ms(boot_ms: int, offset_ns: int | None, now_ns: int) -> int:
    """time_boot_ms without its wrap after 49.7 days, if TIMESYNC (autopilot's ns since boot minus ours) gives the
    autopilot's uptime; otherwise unchanged."""
    if offset_ns is None:
        return boot_ms
    up_ms = (now_ns + offset_ns) // 1_000_000
    unwrapped_ms = boot_ms + round((up_ms - boot_ms) / BOOT_WRAP_MS) * BOOT_WRAP_MS
    # Some peers answer TIMESYNC from a clock other than that of their timestamps: it says nothing about the wrap. A
    # message that a link held back is stamped earlier.
    same_clock = -SAME_CLOCK_MS <= up_ms - unwrapped_ms <= HELD_BACK_MAX_MS
    return unwrapped_ms if unwrapped_ms >= 0 and same_clock else boot_ms


class Telemetry:
    """`gimbal_id`: a component, or 1 to 6 for one that the autopilot represents; None: the first one, until silent."""

    def __init__(
        self, own_ship: OwnShipBuffer, timesync: TimesyncEstimator, utc: UtcClock, gimbal_id: int | None
    ) -> None:
        self._own_ship = own_ship
        self._timesync = timesync
        self._utc = utc
        self._gimbal_id = gimbal_id
        self.attitude_jumps = self.position_jumps = self.gimbal_jumps = 0
        self._servos_heard = self._servos_told = self._unhealthy_told = False
        self._forget()
        self._attitudes_from_ns = self._positions_from_ns = self._gimbals_from_ns = 0

    @property
    def gimbal_id(self) -> int | None:
        """Of the gimbal that the camera is on; None: it is on none, or that one is not known yet."""
        if not self._own_ship.gimballed or self._gimbal_id is not None:
            return self._gimbal_id
        return None if self._gimbal is None else self._gimbal[0]

    def forget(self, now_ns: int) -> None:
        """Discard all state: the autopilot has rebooted, or it is another one."""
        self._forget()
        self._positions_from_ns = now_ns + JUMP_REST_NS

    def clock_set_back(self) -> None:
        """The autopilot's clock was set back: what was received before keeps its time on our clock."""
        self._boot_clock = BootClock(self._timesync)

    def _forget(self) -> None:
        self._own_ship.clear()
        self._unhealthy = False
        self._jumps = Jumps()
        self._attitude_stands = Standstill(SAME_R, TURNED_RAD, STANDS["attitude"])
        self._position_stands = Standstill(SAME_M, FLOWN_M, STANDS["position"])
        self._global_stands = Standstill(SAME_DEG_M, FLOWN_M, STANDS["global position"])
        self.daytime = Daytime()
        self._boot_clock = BootClock(self._timesync)
        self._forget_gimbal_clock()
        self._quaternion_ns: int | None = None
        self._gimbal: tuple[int, int] | None = None  # its id, ns of its last message

    def news(self, now_ns: int) -> list[str]:
        """Sentences, each once: problems that a person has to fix."""
        untold, self._servos_told = self._servos_heard and not self._servos_told, self._servos_heard
        kinds = (self._attitude_stands, self._position_stands, self._global_stands)
        stood = [sentence for kind in kinds for sentence in kind.news(now_ns)]
        unhealthy, self._unhealthy_told = self._unhealthy and not self._unhealthy_told, self._unhealthy
        return self.daytime.news(now_ns) + stood + [UNHEALTHY] * unhealthy + [SERVO_GIMBAL] * untold

    def take(self, message: Any, now_ns: int, autopilot: int | None = None) -> str | None:
        """Process a valid message of a MAV_AUTOPILOT or its gimbal; returns why it was rejected, or None."""
        message_id = message.get_msgId()
        if message_id == GIMBAL_ATTITUDE:
            return self._take_gimbal(message, now_ns, autopilot)
        time_ns = self._boot_clock.monotonic_ns(self._uptime_ns(message, now_ns), now_ns)
        reason = None
        if message_id == ATTITUDE_QUATERNION:
            self._quaternion_ns = time_ns
            q_wxyz = (message.q1, message.q2, message.q3, message.q4)
            reason = self._add_attitude(time_ns, q_wxyz, message, now_ns)
        elif message_id == ATTITUDE:
            if self._quaternion_ns is None or abs(time_ns - self._quaternion_ns) > QUATERNION_GAP_MAX_NS:
                R_ned_body = R_from_euler(message.roll, message.pitch, message.yaw)
                reason = self._add_attitude(time_ns, q_wxyz_from_R(R_ned_body), message, now_ns)
        elif message_id == LOCAL_POSITION_NED:
            reason = self._add_position(time_ns, message, now_ns)
        elif message_id == SYSTEM_TIME and not clock.stepped():  # in lock-step mode nothing gives the date
            self.daytime.compare(message.time_unix_usec, self._utc.utc_ns(time_ns))
        # 0, 0 means that the autopilot has no fix.
        elif message_id == GLOBAL_POSITION_INT and (message.lat, message.lon) != (0, 0):
            reason = self._add_global(time_ns, message)
        return reason

    def take_health(self, message: Any) -> None:
        """Process the autopilot's SYS_STATUS: while it holds its attitude to be unhealthy, that is not used."""
        used = message.onboard_control_sensors_present & message.onboard_control_sensors_enabled
        unhealthy = bool(used & ~message.onboard_control_sensors_health & dialect.MAV_SYS_STATUS_AHRS)
        if unhealthy != self._unhealthy:
            self._unhealthy = unhealthy
            self._own_ship.clear(same_autopilot=True)

    def _add_attitude(self, time_ns: int, q_ned_body_wxyz: ArrayLike, message: Any, now_ns: int) -> str | None:
        if self._unhealthy:
            return "unhealthy"
        rates_radps = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
        R_ned_body, stood = R_from_q_wxyz(q_ned_body_wxyz), self._attitude_stands.times
        if self._attitude_stands.stands(time_ns, R_ned_body, rates_radps):
            if self._attitude_stands.times != stood:
                self._own_ship.clear(same_autopilot=True)
            return "standstill"
        # Some autopilots report zeros instead of rates; measured ones are never exactly zero.
        turning_radps = rates_radps if rates_radps.any() else self._jumps.turning_radps(time_ns, R_ned_body)
        if self._jumps.attitude(time_ns, R_ned_body, rates_radps):
            self.attitude_jumps += 1
            self._own_ship.clear(same_autopilot=True)
            self._attitudes_from_ns = now_ns + JUMP_REST_NS
        if now_ns < self._attitudes_from_ns:
            return None
        added = self._own_ship.add_attitude(time_ns, q_ned_body_wxyz, turning_radps, self._boot_clock.std_s)
        return None if added else "late"

    def _add_position(self, time_ns: int, message: Any, now_ns: int) -> str | None:
        t_ned_m, v_ned_mps = np.array([message.x, message.y, message.z]), np.array([message.vx, message.vy, message.vz])
        stood = self._position_stands.times
        if self._position_stands.stands(time_ns, t_ned_m, v_ned_mps):
            if self._position_stands.times != stood:
                self._own_ship.clear(same_axes=True, same_autopilot=True)
            return "standstill"
        if self._jumps.position(time_ns, t_ned_m, v_ned_mps):
            self.position_jumps += 1
            self._own_ship.clear(same_axes=True, same_autopilot=True)
            self._positions_from_ns = now_ns + JUMP_REST_NS
        if now_ns < self._positions_from_ns:
            return None
        return None if self._own_ship.add_position(time_ns, t_ned_m, v_ned_mps) else "late"

    def _add_global(self, time_ns: int, message: Any) -> str | None:
        place = (message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3)
        v_ned_mps = (message.vx * 1e-2, message.vy * 1e-2, message.vz * 1e-2)
        if self._global_stands.stands(time_ns, np.array(place), np.array(v_ned_mps)):
            return "standstill"
        return None if self._own_ship.add_global(time_ns, place, v_ned_mps) else "late"

    def _take_gimbal(self, message: Any, now_ns: int, autopilot: int | None) -> str | None:
        # A gimbal that the autopilot represents is identified by a number from 1 to 6.
        component = message.get_srcComponent()
        gimbal_id = message.gimbal_device_id or component if component == AUTOPILOT_COMPONENT else component
        if not self._heeds(gimbal_id, now_ns):
            return "other_gimbal"
        if steers_servos(message, autopilot):
            self._servos_heard = self._own_ship.gimballed
            return "servo_gimbal"
        if message.failure_flags & GIMBAL_FAILURES:
            return "gimbal_failure"
        frame = gimbal_frame(message.flags)
        if frame is None:
            return "gimbal_frame"
        if component != AUTOPILOT_COMPONENT:
            back = self._gimbal_steps.set_back(GIMBAL_ATTITUDE, message.get_seq(), message.time_boot_ms)
            if self._gimbal_boot.rebooted(message.time_boot_ms) or back:
                self._forget_gimbal_clock()
        if self._gimbal is not None and self._gimbal[0] != gimbal_id:
            self._forget_gimbal_clock()
        self._gimbal = (gimbal_id, now_ns)
        if component == AUTOPILOT_COMPONENT:
            clock, up_ns = self._boot_clock, self._uptime_ns(message, now_ns)
        else:
            clock, up_ns = self._gimbal_clock, message.time_boot_ms * 1_000_000
        time_ns = clock.monotonic_ns(up_ns, now_ns)
        if self._jumps.gimbal(time_ns, R_from_q_wxyz(message.q), frame):
            self.gimbal_jumps += 1
            self._own_ship.clear(same_autopilot=True)
            self._gimbals_from_ns = now_ns + JUMP_REST_NS
        if now_ns < self._gimbals_from_ns:
            return None
        return None if self._own_ship.add_gimbal(time_ns, message.q, frame, clock.std_s) else "late"

    def _uptime_ns(self, message: Any, now_ns: int) -> int:
        return uptime_ms(message.time_boot_ms, self._timesync.offset_ns, now_ns) * 1_000_000

    def _forget_gimbal_clock(self) -> None:
        # A gimbal that is a separate device has its own boot time.
        self._gimbal_clock = BootClock(TimesyncEstimator())
        self._gimbal_boot, self._gimbal_steps = RebootDetector(), StepDetector()

    def _heeds(self, gimbal_id: int, now_ns: int) -> bool:
        if self._gimbal_id is not None:
            return gimbal_id == self._gimbal_id
        return self._gimbal is None or gimbal_id == self._gimbal[0] or now_ns - self._gimbal[1] > FALLBACK_NS
