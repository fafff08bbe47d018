"""A simulated autopilot: tells own-ship state over MAVLink on UDP, and takes what the daemon sends.

It sends a sequence's telemetry as ArduPilot or PX4 would on a plane, on a boot clock of its own: HEARTBEAT,
ATTITUDE_QUATERNION, LOCAL_POSITION_NED, GLOBAL_POSITION_INT, SYSTEM_TIME, SYS_STATUS, and
GIMBAL_DEVICE_ATTITUDE_STATUS of its own gimbal; it answers TIMESYNC and MAV_CMD_SET_MESSAGE_INTERVAL. Where telemetry
rows are missing, it sends no own-ship state. PX4 denies a command with unknown parameters, and sends TIMESYNC requests
itself, ten times per second, accepting answers within 10 ms.

    python -m sim_replay.autopilot --telemetry telemetry.csv --endpoint 127.0.0.1:14550 --start-at-ns 123456789

Prints one JSON object per line: `ready`, each `target_relative` with its arrival time, with --all each accepted
`message`, and a `summary` when it is told to stop (SIGTERM, SIGINT).
"""

from __future__ import annotations

import argparse
import json
import math
import socket
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from edge.errors import InputError
from edge.links.signing import Signing
from edge.links.signing_key import load_key
from msgs.command_line import exit_code
from msgs.geometry import R_from_q_wxyz, euler_from_R
from msgs.mavlink import MAVLink, dialect, pack
from msgs.signals import stop_on_signals
from sim_replay.bad_link import Lane, LinkFaults, add_options, link_faults
from sim_replay.gimbal import GimbalTrack, read_gimbal
from sim_replay.mavlink_record import message_record
from sim_replay.telemetry import Telemetry, TelemetryError, read_telemetry

SYSTEM_ID = 1
COMPONENT_ID = 1  # MAV_COMP_ID_AUTOPILOT1
TARGET_RELATIVE_ID = 511
TRAFFIC_IDS = (dialect.MAVLINK_MSG_ID_FOLLOW_TARGET, dialect.MAVLINK_MSG_ID_ADSB_VEHICLE)  # of systems of their own
# Rates without a request; MAV_CMD_SET_MESSAGE_INTERVAL changes them.
DEFAULT_RATES_HZ = {
    dialect.MAVLINK_MSG_ID_HEARTBEAT: 1.0,
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50.0,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 20.0,
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 10.0,
    dialect.MAVLINK_MSG_ID_SYSTEM_TIME: 1.0,
    dialect.MAVLINK_MSG_ID_SYS_STATUS: 1.0,
}
GIMBAL_RATE_HZ = 10.0  # without a request
FIRMWARES = {"ardupilot": dialect.MAV_AUTOPILOT_ARDUPILOTMEGA, "px4": dialect.MAV_AUTOPILOT_PX4}
PX4_TIMESYNC_HZ = 10.0
PX4_TIMESYNC_RTT_MAX_NS = 10_000_000
GIMBAL_FLAGS = (
    dialect.GIMBAL_DEVICE_FLAGS_ROLL_LOCK
    | dialect.GIMBAL_DEVICE_FLAGS_PITCH_LOCK
    | dialect.GIMBAL_DEVICE_FLAGS_YAW_LOCK
    | dialect.GIMBAL_DEVICE_FLAGS_YAW_IN_EARTH_FRAME
)
GIMBAL_UNKNOWN = ("angular_velocity_x", "angular_velocity_y", "angular_velocity_z", "delta_yaw", "delta_yaw_velocity")
# An arbitrary time before the first frame: a test that confuses boot time with host time must fail.
BOOT_BEFORE_START_NS = 734_567_891_234
INTERVAL_MIN_NS = 1_000_000
OWN_SHIP_IDS = (
    dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
)
SPEED_MAX_CMPS = 32767  # largest speed in GLOBAL_POSITION_INT
_POLL_S = 0.2
_DATAGRAM_BYTES = 65535


class Autopilot:
    """Bytes in, bytes out, on the host's monotonic clock; no sockets, no waiting.

    `received` counts valid messages by name, `refused` all others by reason.
    """

    def __init__(
        self,
        telemetry: Telemetry,
        start_at_ns: int,
        boot_at_ns: int,
        system_id: int = SYSTEM_ID,
        signing: Signing | None = None,
        gimbal: GimbalTrack | None = None,
        firmware: str = "ardupilot",
        on_message: Callable[[Any, int], None] = lambda _message, _now_ns: None,
    ) -> None:
        """`firmware` is one of FIRMWARES; `on_message` is called with each accepted message and its arrival time."""
        self._telemetry = telemetry
        self._gimbal = gimbal
        self._start_at_ns = start_at_ns
        self._boot_at_ns = boot_at_ns
        self._system_id = system_id
        self._signing = signing
        self._firmware = firmware
        self._on_message = on_message
        self._mav = MAVLink(None, srcSystem=system_id, srcComponent=COMPONENT_ID)
        self._rates_hz = dict(DEFAULT_RATES_HZ)
        if gimbal is not None:
            self._rates_hz[dialect.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS] = GIMBAL_RATE_HZ
        if firmware == "px4":
            self._rates_hz[dialect.MAVLINK_MSG_ID_TIMESYNC] = PX4_TIMESYNC_HZ
        self._interval_ns = {message_id: round(1e9 / rate_hz) for message_id, rate_hz in self._rates_hz.items()}
        self._next_ns = dict.fromkeys(self._rates_hz, boot_at_ns)
        self._last_target_us: dict[int, int] = {}
        self.received: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()

    def next_due_ns(self) -> int | None:
        """Monotonic time of the next telemetry message; None if all are switched off."""
        return min(self._next_ns.values(), default=None)

    def due(self, now_ns: int) -> list[bytes]:
        """Telemetry to be sent by `now_ns`, packed. Missed messages are skipped, not sent in a burst."""
        packed = []
        for message_id, next_ns in self._next_ns.items():
            if next_ns <= now_ns:
                if message_id not in OWN_SHIP_IDS or self._telemetry.tells_of(now_ns - self._start_at_ns):
                    packed.append(self._packed(self._telemetry_message(message_id, now_ns)))
                interval_ns = self._interval_ns[message_id]
                self._next_ns[message_id] = max(next_ns + interval_ns, now_ns + interval_ns // 2)
        return packed

    def take(self, datagram: bytes, now_ns: int) -> tuple[list[bytes], list[dict[str, Any]]]:
        """Process one received datagram; nothing in it is trusted.

        Returns:
            Packed replies, and a record of each valid TARGET_RELATIVE.
        """
        # One parser per datagram: a truncated frame must not swallow what follows.
        parser = MAVLink(None)
        parser.robust_parsing = True
        replies, records = [], []
        for message in parser.parse_buffer(datagram) or []:
            reason = self._refusal(message, now_ns)
            if reason is not None:
                self.refused[reason] += 1
                continue
            self.received[message.get_type()] += 1
            self._on_message(message, now_ns)
            reply = self._reply(message, now_ns)
            if reply is not None:
                replies.append(self._packed(reply))
            if message.get_msgId() == TARGET_RELATIVE_ID:
                records.append(_target_record(message, now_ns))
        return replies, records

    def _packed(self, message: Any) -> bytes:
        if self._signing is not None:
            self._signing.prepare(self._mav)
        return pack(self._mav, message, unknown=GIMBAL_UNKNOWN)

    def _boot_ms(self, now_ns: int) -> int:
        return (now_ns - self._boot_at_ns) // 1_000_000 % 2**32

    def _telemetry_message(self, message_id: int, now_ns: int) -> Any:
        if message_id == dialect.MAVLINK_MSG_ID_HEARTBEAT:
            kind, autopilot = dialect.MAV_TYPE_FIXED_WING, FIRMWARES[self._firmware]
            armed = dialect.MAV_MODE_FLAG_SAFETY_ARMED | dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            return dialect.MAVLink_heartbeat_message(kind, autopilot, armed, 0, dialect.MAV_STATE_ACTIVE, 3)
        if message_id == dialect.MAVLINK_MSG_ID_TIMESYNC:
            return dialect.MAVLink_timesync_message(0, now_ns - self._boot_at_ns)
        if message_id == dialect.MAVLINK_MSG_ID_SYS_STATUS:
            return dialect.MAVLink_sys_status_message(*[dialect.MAV_SYS_STATUS_AHRS] * 3, 0, 0, -1, -1, *[0] * 6)
        boot_ms = self._boot_ms(now_ns)
        if message_id == dialect.MAVLINK_MSG_ID_SYSTEM_TIME:
            return dialect.MAVLink_system_time_message(time.time_ns() // 1000, boot_ms)
        if self._gimbal is not None and message_id == dialect.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS:
            q_wxyz = self._gimbal.at(now_ns - self._start_at_ns).tolist()
            nan = math.nan
            return dialect.MAVLink_gimbal_device_attitude_status_message(
                0, 0, boot_ms, GIMBAL_FLAGS, q_wxyz, nan, nan, nan, 0, nan, nan, 1
            )
        state = self._telemetry.at(now_ns - self._start_at_ns)
        if message_id == dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION:
            q_and_rates = (*state.q_ned_body_wxyz.tolist(), *state.rates_body_radps.tolist())
            return dialect.MAVLink_attitude_quaternion_message(boot_ms, *q_and_rates)
        if message_id == dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED:
            position_and_velocity = (*state.t_ned_body_m.tolist(), *state.v_ned_body_mps.tolist())
            return dialect.MAVLink_local_position_ned_message(boot_ms, *position_and_velocity)
        _, _, yaw_rad = euler_from_R(R_from_q_wxyz(state.q_ned_body_wxyz))
        return dialect.MAVLink_global_position_int_message(
            boot_ms,
            round(state.lat_deg * 1e7),
            round(state.lon_deg * 1e7),
            round(state.alt_m * 1e3),
            round(-state.t_ned_body_m[2] * 1e3),
            *(max(-SPEED_MAX_CMPS, min(SPEED_MAX_CMPS, round(v * 100.0))) for v in state.v_ned_body_mps.tolist()),
            round(math.degrees(float(yaw_rad)) * 100.0) % 36000,
        )

    def _timesync_refusal(self, answer: Any, now_ns: int) -> str | None:
        """Refusal of the answer to this autopilot's own request, if it took too long."""
        if self._firmware != "px4":
            return None
        round_trip_ns = now_ns - self._boot_at_ns - answer.ts1
        return None if 0 <= round_trip_ns <= PX4_TIMESYNC_RTT_MAX_NS else "TIMESYNC took too long"

    def _refusal(self, message: Any, now_ns: int) -> str | None:
        """Why a parsed message is not accepted, or None."""
        kind = message.get_type()
        if kind == "BAD_DATA":
            return "not MAVLink"
        if kind.startswith("UNKNOWN"):
            return "unknown message"
        traffic = message.get_msgId() in TRAFFIC_IDS
        if (message.get_srcSystem() == self._system_id) is traffic or message.get_srcComponent() == COMPONENT_ID:
            return "not from a component of this vehicle"
        if self._signing is not None and (unproven := self._signing.refusal(message)) is not None:
            return f"signing: {unproven}"
        if message.get_msgId() == dialect.MAVLINK_MSG_ID_TIMESYNC and message.tc1 != 0:
            return self._timesync_refusal(message, now_ns)
        if message.get_msgId() != TARGET_RELATIVE_ID:
            return None
        numbers = (message.x, message.y, message.z, *message.pos_std, message.yaw_std, *message.q_target)
        if not all(math.isfinite(value) for value in (*numbers, *message.q_sensor)):
            return "TARGET_RELATIVE is not finite"
        if any(message.q_target) and not abs(math.hypot(*message.q_target) - 1.0) <= 1e-3:
            return "TARGET_RELATIVE holds no rotation"
        if message.timestamp <= self._last_target_us.get(message.id, -1):
            return "TARGET_RELATIVE is not newer than the last"
        self._last_target_us[message.id] = message.timestamp
        return None

    def _reply(self, message: Any, now_ns: int) -> Any | None:
        if message.get_msgId() == dialect.MAVLINK_MSG_ID_TIMESYNC and message.tc1 == 0:
            return dialect.MAVLink_timesync_message(now_ns - self._boot_at_ns, message.ts1)
        if message.get_msgId() == dialect.MAVLINK_MSG_ID_COMMAND_LONG:
            if message.target_system != self._system_id or message.target_component not in (0, COMPONENT_ID):
                return None
            result = self._command(message, now_ns)
            asker = (message.get_srcSystem(), message.get_srcComponent())
            return dialect.MAVLink_command_ack_message(message.command, result, 0, 0, *asker)
        return None

    def _command(self, message: Any, now_ns: int) -> int:
        """Carry out a COMMAND_LONG; returns its MAV_RESULT."""
        numbers = (message.param1, message.param2)
        if message.command != dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            return int(dialect.MAV_RESULT_UNSUPPORTED)
        if self._firmware == "px4" and any((message.param3, message.param4, message.param7)):
            return int(dialect.MAV_RESULT_DENIED)
        if not all(math.isfinite(value) for value in numbers) or int(message.param1) not in self._rates_hz:
            return int(dialect.MAV_RESULT_DENIED)
        message_id, interval_us = int(message.param1), message.param2
        if interval_us < 0:
            self._next_ns.pop(message_id, None)
            return int(dialect.MAV_RESULT_ACCEPTED)
        default_ns = round(1e9 / self._rates_hz[message_id])
        self._interval_ns[message_id] = max(round(interval_us * 1e3), INTERVAL_MIN_NS) if interval_us else default_ns
        self._next_ns[message_id] = now_ns
        return int(dialect.MAV_RESULT_ACCEPTED)


def _target_record(message: Any, now_ns: int) -> dict[str, Any]:
    known = any(message.q_target)
    return {
        "event": "target_relative",
        "target": message.id,
        "capture_utc_us": message.timestamp,
        "received_ns": now_ns,
        "t_cam_target_m": [message.x, message.y, message.z],
        "rotation_known": known,
        "q_cam_target_wxyz": list(message.q_target) if known else [1.0, 0.0, 0.0, 0.0],
        "q_ned_cam_wxyz": list(message.q_sensor),
    }


def _emit(record: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(record) + "\n")
    sys.stdout.flush()


def _fly(autopilot: Autopilot, address: tuple[str, int], faults: LinkFaults, stop: threading.Event) -> None:
    """Exchange datagrams with the daemon at `address` until `stop` is set."""
    outward, inward = Lane(faults), Lane(faults, seed=1)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind((address[0] if address[0].startswith("127.") else "0.0.0.0", 0))
        _emit({"event": "ready", "port": link.getsockname()[1]})
        while not stop.is_set():
            times_ns = (autopilot.next_due_ns(), outward.next_due_ns(), inward.next_due_ns())
            next_ns = min((t_ns for t_ns in times_ns if t_ns is not None), default=None)
            wait_s = _POLL_S if next_ns is None else min((next_ns - time.monotonic_ns()) * 1e-9, _POLL_S)
            link.settimeout(max(wait_s, 1e-4))
            try:
                datagram, sender = link.recvfrom(_DATAGRAM_BYTES)
            except TimeoutError:
                pass
            else:
                if sender == address:
                    inward.put(datagram, time.monotonic_ns())
                else:
                    autopilot.refused["sender is not the daemon"] += 1
            for arrived in inward.due(time.monotonic_ns()):
                replies, records = autopilot.take(arrived, time.monotonic_ns())
                for record in records:
                    _emit(record)
                for packed in replies:
                    outward.put(packed, time.monotonic_ns())
            for packed in autopilot.due(time.monotonic_ns()):
                outward.put(packed, time.monotonic_ns())
            for packed in outward.due(time.monotonic_ns()):
                link.sendto(packed, address)


def _tell(message: Any, now_ns: int) -> None:
    _emit({"event": "message", **message_record(message, now_ns)})


def _writer(args: argparse.Namespace, stack: ExitStack) -> Callable[[Any, int], None]:
    """Writes each message to --messages; `t_ns` is on the telemetry's clock. Raises InputError, as on a full disk."""
    file = stack.enter_context(args.messages.open("wb", buffering=0))  # nothing is left to be written when it is closed

    def write(message: Any, now_ns: int) -> None:
        try:
            file.write(json.dumps(message_record(message, now_ns - args.start_at_ns)).encode() + b"\n")
        except OSError as error:
            raise InputError(f"{args.messages}: cannot be written: {error.strerror}") from error

    return write


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not host or not port.isdigit() or not 0 < int(port) < 65536:
        raise argparse.ArgumentTypeError(f"'{text}' is not HOST:PORT")
    try:
        return socket.gethostbyname(host), int(port)
    except OSError as error:
        raise argparse.ArgumentTypeError(f"'{host}' is no known host") from error


def _system_id(text: str) -> int:
    if not (text.isdecimal() and 1 <= int(text) <= 255):
        raise argparse.ArgumentTypeError(f"'{text}' is not a system id, 1 to 255")
    return int(text)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim_replay.autopilot", description=__doc__.splitlines()[0])
    parser.add_argument("--telemetry", type=Path, required=True, help="telemetry.csv of the sequence")
    parser.add_argument("--endpoint", type=_address, required=True, help="HOST:PORT the daemon listens on (udpin)")
    parser.add_argument(
        "--start-at-ns", type=int, required=True, help="monotonic ns at which the telemetry's t_ns is 0"
    )
    parser.add_argument("--boot-at-ns", type=int, help="monotonic ns of its boot (default: long before)")
    parser.add_argument("--system-id", type=_system_id, metavar="ID", default=SYSTEM_ID, help="its own (1)")
    parser.add_argument("--gimbal", type=Path, metavar="CSV", help="gimbal.csv: how its gimbal turns, same clock")
    parser.add_argument("--signing-key", type=Path, metavar="FILE", help="sign all, and believe nothing unsigned")
    parser.add_argument(
        "--firmware", choices=FIRMWARES, default="ardupilot", help="whose peculiarities it has (ardupilot)"
    )
    taken = parser.add_mutually_exclusive_group()
    taken.add_argument("--messages", type=Path, metavar="FILE", help="write each message that it takes, JSON lines")
    taken.add_argument("--all", action="store_true", help="print each message that it takes, with its receive time")
    add_options(parser)
    args = parser.parse_args(argv)
    try:
        telemetry = read_telemetry(args.telemetry)
        gimbal = None if args.gimbal is None else read_gimbal(args.gimbal)
        key = None if args.signing_key is None else load_key(args.signing_key)
    except (TelemetryError, InputError) as error:
        print(error, file=sys.stderr)
        return 2
    stop = stop_on_signals()
    boot_at_ns = args.start_at_ns - BOOT_BEFORE_START_NS if args.boot_at_ns is None else args.boot_at_ns
    signing = None if key is None else Signing(key, 0, lambda _: None, time.time_ns)
    try:
        with ExitStack() as stack:
            write = _writer(args, stack) if args.messages else _tell if args.all else (lambda _message, _now_ns: None)
            autopilot = Autopilot(
                telemetry, args.start_at_ns, boot_at_ns, args.system_id, signing, gimbal, args.firmware, write
            )
            _fly(autopilot, args.endpoint, link_faults(args), stop)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    _emit({"event": "summary", "received": dict(autopilot.received), "refused": dict(autopilot.refused)})
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, InputError))
