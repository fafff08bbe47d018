"""Configured rates of the messages that are requested and of those that may be sent. Pure."""

from __future__ import annotations

from edge.config import MavlinkSettings
from edge.links.mavlink_table import (
    ADSB_VEHICLE,
    ATTITUDE,
    ATTITUDE_QUATERNION,
    COMPUTER_STATUS,
    FOLLOW_TARGET,
    GEO_STATUS,
    GIMBAL_ATTITUDE,
    GLOBAL_POSITION_INT,
    IMAGE_STATUS,
    LOCAL_POSITION_NED,
    SYS_STATUS,
    SYSTEM_TIME,
    TARGET_RELATIVE,
)
from edge.tracking.own_ship import OwnShipBuffer

GLOBAL_POSITION_HZ = 5.0
SYSTEM_TIME_HZ = SYS_STATUS_HZ = 1.0
GIMBAL_HZ = 50.0
FOLLOW_TARGET_HZ = 10.0
ADSB_VEHICLE_HZ = 2.0
COMPUTER_STATUS_HZ = 1.0


def wanted_rates_hz(settings: MavlinkSettings, own_ship: OwnShipBuffer) -> dict[int, float]:
    """Rates of the messages that are requested from the autopilot, by id."""
    gimbal = {GIMBAL_ATTITUDE: GIMBAL_HZ} if own_ship.gimballed else {}
    return {
        ATTITUDE_QUATERNION: settings.attitude_rate_hz,
        ATTITUDE: settings.attitude_rate_hz,
        LOCAL_POSITION_NED: settings.position_rate_hz,
        GLOBAL_POSITION_INT: GLOBAL_POSITION_HZ,
        SYSTEM_TIME: SYSTEM_TIME_HZ,
        SYS_STATUS: SYS_STATUS_HZ,
        **gimbal,
    }


def sent_rates_hz(settings: MavlinkSettings) -> dict[int, float]:
    """Rates of the messages that may be sent, by id."""
    optional = {
        TARGET_RELATIVE: (settings.target_relative, settings.target_relative_rate_hz),
        FOLLOW_TARGET: (settings.follow_target, FOLLOW_TARGET_HZ),
        ADSB_VEHICLE: (settings.adsb_icao_address is not None, ADSB_VEHICLE_HZ),
        COMPUTER_STATUS: (settings.onboard_computer_status, COMPUTER_STATUS_HZ),
    }
    always = {IMAGE_STATUS: settings.tracking_rate_hz, GEO_STATUS: settings.tracking_rate_hz}
    return always | {message_id: hz for message_id, (enabled, hz) in optional.items() if enabled}
