"""The autopilot's clock is set while it flies: its attitude is not taken for that of another time."""

from __future__ import annotations

import numpy as np
import pytest

from .test_own_ship_jumps import BEGIN_NS, EVERY, MS, V_NED_MPS, Autopilot

RATE_RADPS = 0.5
EXPOSURE_STD_S = 0.005  # of frames, which the tracker assumes


@pytest.mark.parametrize("step_ms", [-20, -30, -60, -150, -400, -1900, 10, 60, 150])
@pytest.mark.parametrize(("numbers", "answers"), [(True, True), (True, False), (False, True)])
def test_a_clock_that_is_set_makes_no_attitude_older_than_told(step_ms: int, numbers: bool, answers: bool) -> None:
    autopilot, unknown_ms = Autopilot(), 0
    autopilot.numbers, autopilot.answers = numbers, answers
    for k_ms in range(5000):
        autopilot.ahead_ms = step_ms * (k_ms >= 2000)
        autopilot.turn(k_ms, V_NED_MPS * k_ms / 1000, V_NED_MPS, RATE_RADPS * k_ms / 1000, RATE_RADPS)
        # Without numbers, only the next answer to TIMESYNC tells.
        if k_ms % EVERY or k_ms < 500 or (not numbers and 2000 <= k_ms < 2250):
            continue
        own = autopilot.own_ship.at(BEGIN_NS + (k_ms - 15) * MS)
        if own is None:
            unknown_ms += EVERY
            continue
        off_rad = np.arctan2(own.R_ned_body[1, 0], own.R_ned_body[0, 0]) - RATE_RADPS * (k_ms - 15) / 1000
        off_s = abs(np.arctan2(np.sin(off_rad), np.cos(off_rad))) / RATE_RADPS
        assert off_s < 3.0 * np.hypot(EXPOSURE_STD_S, own.clock_std_s), f"{off_s * 1000:.0f} ms off at {k_ms} ms"
    assert unknown_ms < (50 if numbers else 800)
    assert autopilot.station.timesync.jumps == (answers or step_ms <= -30)
    assert autopilot.station.vehicle.reboots == 0
