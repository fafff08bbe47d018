"""All messages that are sent or read: the table that the link uses and docs/mavlink.md is generated from.

python -m edge.links.mavlink_table    # prints the tables as Markdown
"""

from __future__ import annotations

from dataclasses import dataclass

from msgs.mavlink import MAVLink_target_relative_message, dialect

HEARTBEAT = dialect.MAVLINK_MSG_ID_HEARTBEAT
SYS_STATUS = dialect.MAVLINK_MSG_ID_SYS_STATUS
SYSTEM_TIME = dialect.MAVLINK_MSG_ID_SYSTEM_TIME
ATTITUDE = dialect.MAVLINK_MSG_ID_ATTITUDE
ATTITUDE_QUATERNION = dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
LOCAL_POSITION_NED = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED
GLOBAL_POSITION_INT = dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT
COMMAND_INT = dialect.MAVLINK_MSG_ID_COMMAND_INT
COMMAND_LONG = dialect.MAVLINK_MSG_ID_COMMAND_LONG
COMMAND_ACK = dialect.MAVLINK_MSG_ID_COMMAND_ACK
TIMESYNC = dialect.MAVLINK_MSG_ID_TIMESYNC
FOLLOW_TARGET = dialect.MAVLINK_MSG_ID_FOLLOW_TARGET
ADSB_VEHICLE = dialect.MAVLINK_MSG_ID_ADSB_VEHICLE
STATUSTEXT = dialect.MAVLINK_MSG_ID_STATUSTEXT
CAMERA_INFORMATION = dialect.MAVLINK_MSG_ID_CAMERA_INFORMATION
IMAGE_STATUS = dialect.MAVLINK_MSG_ID_CAMERA_TRACKING_IMAGE_STATUS
GEO_STATUS = dialect.MAVLINK_MSG_ID_CAMERA_TRACKING_GEO_STATUS
GIMBAL_ATTITUDE = dialect.MAVLINK_MSG_ID_GIMBAL_DEVICE_ATTITUDE_STATUS
COMPUTER_STATUS = dialect.MAVLINK_MSG_ID_ONBOARD_COMPUTER_STATUS
TARGET_RELATIVE = MAVLink_target_relative_message.id


@dataclass(frozen=True)
class Sent:
    """A message that is sent. `limits_hz`: bounds for SET_MESSAGE_INTERVAL; None: its rate cannot be set."""

    message_id: int
    name: str
    sender: str
    default: str
    rate: str
    limits_hz: tuple[float, float] | None
    says: str


@dataclass(frozen=True)
class Read:
    message_id: int
    name: str
    rate: str
    used_for: str


COMPUTER, CAMERA, VIRTUAL = "onboard computer", "camera", "virtual system"

SENT = (
    Sent(HEARTBEAT, "HEARTBEAT", f"{COMPUTER}, {CAMERA}", "on", "1 Hz", None, "health; stops if the main loop stalls"),
    Sent(TARGET_RELATIVE, "TARGET_RELATIVE", COMPUTER, "on, off to PX4", "each frame, at most 50 Hz", (0.1, 50.0),
         "full pose of each target in the camera frame"),
    Sent(IMAGE_STATUS, "CAMERA_TRACKING_IMAGE_STATUS", CAMERA, "on", "10 Hz", (1.0, 20.0), "bounding box in the image"),
    Sent(GEO_STATUS, "CAMERA_TRACKING_GEO_STATUS", CAMERA, "on", "10 Hz", (1.0, 20.0), "global position of the target"),
    Sent(CAMERA_INFORMATION, "CAMERA_INFORMATION", CAMERA, "on request", "on request", None, "camera properties"),
    Sent(FOLLOW_TARGET, "FOLLOW_TARGET", VIRTUAL, "off", "10 Hz", (1.0, 10.0), "the target as a vehicle to follow"),
    Sent(ADSB_VEHICLE, "ADSB_VEHICLE", VIRTUAL, "off", "2 Hz", (1.0, 5.0),
         "each target as traffic; may trigger avoidance manoeuvres"),
    Sent(TIMESYNC, "TIMESYNC", COMPUTER, "on", "5 Hz", None, "asks for the autopilot's clock, answers with ours"),
    Sent(STATUSTEXT, "STATUSTEXT", COMPUTER, "on", "on change", None, "target acquired or lost, degraded, fault"),
    Sent(COMPUTER_STATUS, "ONBOARD_COMPUTER_STATUS", COMPUTER, "off", "1 Hz", (0.1, 1.0), "load, memory, temperature"),
    Sent(COMMAND_LONG, "COMMAND_LONG", COMPUTER, "on", "until the rate is met", None,
         "SET_MESSAGE_INTERVAL for what is received"),
    Sent(COMMAND_ACK, "COMMAND_ACK", f"{COMPUTER}, {CAMERA}", "on", "per command", None, "answer to a command to us"),
)  # fmt: skip

READ = (
    Read(HEARTBEAT, "HEARTBEAT", "1 Hz", "the vehicle's system id, the autopilot's type, whether it is alive"),
    Read(ATTITUDE_QUATERNION, "ATTITUDE_QUATERNION", "50 Hz requested", "own attitude at the exposure time"),
    Read(ATTITUDE, "ATTITUDE", "50 Hz requested if needed", "own attitude where ATTITUDE_QUATERNION does not arrive"),
    Read(LOCAL_POSITION_NED, "LOCAL_POSITION_NED", "20 Hz requested", "own position and velocity"),
    Read(GLOBAL_POSITION_INT, "GLOBAL_POSITION_INT", "5 Hz requested", "global position of the local frame"),
    Read(GIMBAL_ATTITUDE, "GIMBAL_DEVICE_ATTITUDE_STATUS", "50 Hz requested with a gimbal", "attitude of the camera"),
    Read(SYSTEM_TIME, "SYSTEM_TIME", "1 Hz requested", "boot time: a decrease means a reboot; UTC, compared with ours"),
    Read(SYS_STATUS, "SYS_STATUS", "1 Hz requested", "whether the autopilot holds its attitude to be healthy"),
    Read(TIMESYNC, "TIMESYNC", "answers to ours", "the autopilot's clock"),
    Read(COMMAND_ACK, "COMMAND_ACK", "answers to ours", "whether a rate was granted"),
    Read(COMMAND_LONG, "COMMAND_LONG", "as received", "commands to us"),
    Read(COMMAND_INT, "COMMAND_INT", "as received", "commands to us"),
)

RATE_LIMITS_HZ = {sent.message_id: sent.limits_hz for sent in SENT if sent.limits_hz is not None}
READ_IDS = frozenset(read.message_id for read in READ)


def tables() -> str:
    """Both tables as Markdown."""
    lines = ["| sent | id | component | default | rate | content |", "|---|---|---|---|---|---|"]
    lines += [f"| {s.name} | {s.message_id} | {s.sender} | {s.default} | {_rate(s)} | {s.says} |" for s in SENT]
    lines += ["", "| received | id | rate | used for |", "|---|---|---|---|"]
    lines += [f"| {r.name} | {r.message_id} | {r.rate} | {r.used_for} |" for r in READ]
    return "\n".join(lines)


def _rate(sent: Sent) -> str:
    return sent.rate if sent.limits_hz is None else "{}, bounds {:g} to {:g} Hz".format(sent.rate, *sent.limits_hz)


if __name__ == "__main__":
    print(tables())
