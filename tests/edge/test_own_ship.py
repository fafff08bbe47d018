"""Own-ship state at a frame's exposure, and the clocks that stamps pass through."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from edge.tracking.clock import JUMP_AGREEING, STEPS_MAX, BootClock, RebootDetector, StepDetector, TimesyncEstimator
from edge.tracking.own_ship import GimbalFrame, OwnShipBuffer
from edge.tracking.view import View
from edge.types import Mount
from msgs.geometry import rotation_angle

MS = 1_000_000


def q_wxyz(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1)


@given(share=st.floats(0.0, 1.0), seed=st.integers(0, 2**32 - 1))
def test_attitude_between_samples_is_their_slerp(share: float, seed: int) -> None:
    rotations = Rotation.random(2, rng=np.random.default_rng(seed))
    buffer = OwnShipBuffer()
    for time_ns, rotation in zip((0, 20 * MS), rotations, strict=True):
        assert buffer.add_attitude(time_ns, q_wxyz(rotation), np.zeros(3))
    time_ns = round(share * 20 * MS)
    own_ship = buffer.at(time_ns)
    assert own_ship is not None
    expected = Slerp([0, 20 * MS], rotations)(time_ns).as_matrix()
    assert rotation_angle(own_ship.R_ned_body, expected) < 1e-6


@pytest.mark.parametrize("gap_ms", [10, 50, 100, 150])
def test_attitude_goes_on_by_body_rates_until_150_milliseconds_after_the_next_was_due(gap_ms: int) -> None:
    start = Rotation.from_euler("ZYX", [1.0, 0.2, -0.4])
    rates_radps = np.array([0.5, -0.3, 0.2])
    buffer = OwnShipBuffer()
    for k in range(3):
        buffer.add_attitude((1_000 + (k - 2) * gap_ms) * MS, q_wxyz(start), rates_radps)
    own_ship = buffer.at((1_150 + gap_ms) * MS)
    assert own_ship is not None
    # Body rates turn the vehicle about its own axes: they stand on the right.
    expected = (start * Rotation.from_rotvec((0.15 + gap_ms / 1e3) * rates_radps)).as_matrix()
    np.testing.assert_allclose(own_ship.R_ned_body, expected, atol=1e-12)
    assert buffer.at((1_151 + gap_ms) * MS) is None
    assert buffer.at((1_000 - 2 * gap_ms - 1) * MS) is None


def known(attitudes_ms: list[int], late_ms: int = 10) -> list[bool]:
    """Whether each picture has an attitude: 30 a second, looked up 33 ms after exposure; attitudes come so late."""
    buffer, waiting, answers = OwnShipBuffer(), list(attitudes_ms), []
    for frame in range(150):
        exposed_ms = 1_000 + round(frame * 1000 / 30)
        while waiting and waiting[0] + late_ms <= exposed_ms + 33:
            buffer.add_attitude(waiting.pop(0) * MS, [1, 0, 0, 0], np.zeros(3))
        answers.append(buffer.at(exposed_ms * MS) is not None)
    return answers


@pytest.mark.parametrize("late_ms", [10, 60, 80, 90, 120, 150])
def test_a_link_that_delays_attitudes_serves_every_picture(late_ms: int) -> None:
    assert all(known(list(range(0, 6_000, 20)), late_ms))


def test_a_stream_of_attitudes_serves_every_picture_or_none() -> None:
    """A track changes its frame with each picture that has one and the next that has none."""
    ten_a_second = list(range(0, 6_000, 100))
    assert all(known(ten_a_second))
    jitter_ms = np.random.default_rng(5).integers(-20, 21, len(ten_a_second))
    assert all(known([t + int(j) for t, j in zip(ten_a_second, jitter_ms, strict=True)]))
    assert not any(known(list(range(0, 6_000, 200))))
    assert all(known([t for t in ten_a_second if t != 3_000])), "one lost"
    two_lost = known([t for t in ten_a_second if t not in (3_000, 3_100)])
    assert two_lost.count(False) in (1, 2)
    after_an_outage = known([t for t in range(0, 6_000, 20) if not 3_000 < t < 4_000])
    assert after_an_outage.index(True, after_an_outage.index(False)) - 1 <= (4_010 - 33 - 1_000) * 30 / 1000


def test_the_longer_an_attitude_is_gone_on_from_the_less_sure_the_view_is() -> None:
    buffer = OwnShipBuffer()
    for k in range(3):
        buffer.add_attitude((1_000 + k * 100) * MS, [1, 0, 0, 0], np.zeros(3))
    mount = Mount(np.eye(3), np.zeros(3))
    stds_rad = []
    for time_ms in (1_150, 1_200, 1_300, 1_350):
        own_ship = buffer.at(time_ms * MS)
        assert own_ship is not None
        stds_rad.append(View.of(time_ms * MS, own_ship, mount).attitude_variance ** 0.5)
    # At a sample there is only jitter; 1.5 rad/s^2 for 0.1 s and 0.15 s turn by 7.5 and 17 mrad, in the middle of 0.1 s
    # otherwise than evenly by 1.9.
    np.testing.assert_allclose(stds_rad, np.hypot(1e-3, [1.875e-3, 0.0, 7.5e-3, 16.875e-3]))


def test_a_hole_in_the_attitudes_leaves_doubt_where_it_is_bridged() -> None:
    """Against a turn that begins and ends in the hole, at 1.5 rad/s^2."""
    buffer = OwnShipBuffer()
    for time_ms in [*range(0, 1_001, 20), *range(1_480, 2_001, 20)]:
        since_s = min(max(time_ms - 1_000, 0), 480) / 1e3
        turned_rad = 0.75 * since_s**2 if since_s <= 0.24 else 0.75 * (0.48**2 / 2 - (0.48 - since_s) ** 2)
        buffer.add_attitude(time_ms * MS, q_wxyz(Rotation.from_euler("z", turned_rad)), np.zeros(3))
    own_ship = buffer.at(1_120 * MS)
    assert own_ship is not None
    off_rad = rotation_angle(own_ship.R_ned_body, Rotation.from_euler("z", 0.75 * 0.12**2).as_matrix())
    assert off_rad > 10e-3
    assert off_rad < own_ship.attitude_std_rad < 5 * off_rad


@pytest.mark.parametrize(
    ("frame", "expected_s"), [(GimbalFrame.EARTH, 0.02), (GimbalFrame.HEADING, np.hypot(0.02, 0.001))]
)
def test_the_doubt_about_a_gimbals_clock_is_told(frame: GimbalFrame, expected_s: float) -> None:
    buffer = OwnShipBuffer(gimballed=True)
    for k in range(3):
        buffer.add_attitude(k * 20 * MS, [1, 0, 0, 0], np.zeros(3), clock_std_s=0.001)
        buffer.add_gimbal(k * 20 * MS, [1, 0, 0, 0], frame, clock_std_s=0.02)
    own_ship = buffer.at(30 * MS)
    assert own_ship is not None
    assert own_ship.clock_std_s == pytest.approx(expected_s)


@pytest.mark.parametrize(
    ("frame", "body_ms", "gimbal_ms", "doubts_rad"),
    [
        # 5 rad/s^2 for 0.1 s turn by 25 mrad, and as much again because the rate is that of 0.05 s before.
        (GimbalFrame.EARTH, range(0, 1_101, 10), range(0, 1_001, 100), [0.05]),
        (GimbalFrame.EARTH, range(0, 1_001, 100), range(0, 1_101, 10), [0.0]),
        (GimbalFrame.HEADING, range(0, 1_001, 100), range(0, 1_001, 100), [0.0075, 0.05]),
    ],
)
def test_the_age_of_a_gimbal_s_attitude_counts(
    frame: GimbalFrame, body_ms: range, gimbal_ms: range, doubts_rad: list[float]
) -> None:
    """Against the earth it is the camera's whole attitude; against the heading the body's comes on top."""
    buffer = OwnShipBuffer(gimballed=True)
    for time_ms in body_ms:
        buffer.add_attitude(time_ms * MS, [1, 0, 0, 0], np.zeros(3))
    for time_ms in gimbal_ms:
        buffer.add_gimbal(time_ms * MS, [1, 0, 0, 0], frame)
    own_ship = buffer.at(1_100 * MS)
    assert own_ship is not None
    assert own_ship.attitude_std_rad == pytest.approx(np.linalg.norm(doubts_rad))


def test_attitude_is_not_invented_across_a_long_gap() -> None:
    buffer = OwnShipBuffer()
    for time_ms in (0, 20, 40, 60, 80, 2_080):
        buffer.add_attitude(time_ms * MS, [1, 0, 0, 0], np.zeros(3))
    assert buffer.at(1_000 * MS) is None
    assert buffer.at(2_080 * MS) is not None


def test_samples_out_of_order_are_refused() -> None:
    buffer = OwnShipBuffer()
    assert buffer.add_attitude(20 * MS, [1, 0, 0, 0], np.zeros(3))
    assert not buffer.add_attitude(20 * MS, [0, 1, 0, 0], np.zeros(3))
    assert not buffer.add_attitude(10 * MS, [0, 1, 0, 0], np.zeros(3))
    own_ship = buffer.at(20 * MS)
    assert own_ship is not None
    np.testing.assert_allclose(own_ship.R_ned_body, np.eye(3))


@pytest.mark.parametrize("same_axes", [True, False])
def test_of_what_came_before_a_reset_only_that_which_still_holds_is_used(same_axes: bool) -> None:
    """Where north may be another, so may the gimbal's zero; the origin is another in either case."""
    buffer = OwnShipBuffer(gimballed=True)

    def tell_attitude_and_position(time_ns: int) -> None:
        buffer.add_attitude(time_ns, [1, 0, 0, 0], np.zeros(3))
        buffer.add_position(time_ns, np.zeros(3), np.zeros(3))
        buffer.add_global(time_ns, (47.0, 8.0, 400.0), (0.0, 0.0, 0.0))

    tell_attitude_and_position(0)
    buffer.add_gimbal(0, [1, 0, 0, 0], GimbalFrame.EARTH)
    before = buffer.at(10 * MS)
    assert before is not None
    assert before.t_ned_body_m is not None
    assert before.lat_lon_alt is not None
    buffer.clear(same_axes=same_axes)
    after = buffer.at(10 * MS)
    assert (after is not None) == same_axes
    if after is not None:
        assert after.t_ned_body_m is after.lat_lon_alt is None
    tell_attitude_and_position(20 * MS)
    assert (buffer.at(30 * MS) is not None) == same_axes
    buffer.add_gimbal(20 * MS, [1, 0, 0, 0], GimbalFrame.EARTH)
    again = buffer.at(30 * MS)
    assert again is not None
    assert again.origin_epoch != before.origin_epoch
    assert (again.axes_epoch == before.axes_epoch) == same_axes


def test_a_writer_and_a_reader_do_not_disturb_each_other() -> None:
    buffer = OwnShipBuffer()
    failures: list[BaseException] = []
    done = threading.Event()

    def read() -> None:
        try:
            while not done.is_set():
                own_ship = buffer.at(10_000 * MS)
                assert own_ship is None or np.isfinite(own_ship.R_ned_body).all()
        except BaseException as error:
            failures.append(error)

    reader = threading.Thread(target=read)
    reader.start()
    try:
        for k in range(3000):
            buffer.add_attitude(k * 10 * MS, [1, 0, 0, 0], np.zeros(3))
            buffer.add_position(k * 10 * MS, np.zeros(3), np.zeros(3))
    finally:
        done.set()
        reader.join()
    assert not failures


def exchange(sync: TimesyncEstimator, now_ns: int, offset_ns: int, out_ns: int, back_ns: int) -> bool:
    """One request and its reply over a link with these delays."""
    ts1 = sync.request(now_ns)
    return sync.reply(now_ns + out_ns + offset_ns, ts1, now_ns + out_ns + back_ns)


@given(
    offset_ns=st.integers(-(10**15), 10**15),
    delays=st.lists(st.tuples(st.integers(0, 50 * MS), st.integers(0, 50 * MS)), min_size=1, max_size=40),
)
def test_the_clock_offset_is_within_its_uncertainty(offset_ns: int, delays: list[tuple[int, int]]) -> None:
    sync = TimesyncEstimator()
    for k, (out_ns, back_ns) in enumerate(delays):
        assert exchange(sync, k * 200 * MS, offset_ns, out_ns, back_ns)
    assert sync.offset_ns is not None
    assert sync.uncertainty_ns is not None
    assert abs(sync.offset_ns - offset_ns) <= sync.uncertainty_ns + 1
    assert sync.uncertainty_ns == min(sum(pair) for pair in delays[-32:]) // 2


def test_replies_we_did_not_ask_for_are_refused() -> None:
    sync = TimesyncEstimator()
    ts1 = sync.request(1_000)
    assert not sync.reply(5_000, ts1 + 1, 2_000)
    assert sync.reply(5_000, ts1, 2_000)
    assert not sync.reply(9_000, ts1, 2_000), "an answer counts once"
    late = sync.request(10_000)
    assert not sync.reply(5_000, late, 10_000 + 300 * MS)


def test_one_odd_reply_is_an_outlier_and_several_are_a_jump() -> None:
    sync = TimesyncEstimator()
    for k in range(10):
        exchange(sync, k * 200 * MS, 5_000 * MS, MS, MS)
    assert not exchange(sync, 2_000 * MS, 9_000 * MS, MS, MS)
    assert sync.offset_ns == 5_000 * MS
    exchange(sync, 2_200 * MS, 5_000 * MS, MS, MS)
    for k in range(JUMP_AGREEING):
        exchange(sync, (2_400 + 200 * k) * MS, 9_000 * MS, MS, MS)
    assert sync.offset_ns == 9_000 * MS
    assert sync.jumps == 1


def test_odd_replies_between_right_ones_are_no_jump_however_many_and_leave_no_doubt() -> None:
    sync = TimesyncEstimator()
    exchange(sync, 0, 5_000 * MS, MS, MS)
    for k in range(1, 4 * JUMP_AGREEING):
        assert not exchange(sync, k * 400 * MS, 9_000 * MS, MS, MS)
        assert (sync.std_s(k * 400 * MS) or 0.0) > 1.0, "who knows which is right"
        assert exchange(sync, (k * 400 + 200) * MS, 5_000 * MS, MS, MS)
        assert (sync.std_s((k * 400 + 200) * MS) or 1.0) < 0.01
    assert (sync.offset_ns, sync.jumps) == (5_000 * MS, 0)


def test_stamps_become_monotonic_time_by_timesync() -> None:
    sync = TimesyncEstimator()
    clock = BootClock(sync)
    offset_ns = -7_000 * MS  # booted seven seconds after our clock began
    exchange(sync, 10_000 * MS, offset_ns, MS, MS)
    sampled_ns = 12_000 * MS
    assert clock.monotonic_ns(sampled_ns + offset_ns, sampled_ns + 15 * MS) == sampled_ns


def test_a_stamp_that_timesync_puts_ahead_of_its_arrival_is_of_its_arrival() -> None:
    sync = TimesyncEstimator()
    clock = BootClock(sync)
    exchange(sync, 10_000 * MS, 0, MS, MS)
    assert clock.monotonic_ns(12_010 * MS, 12_000 * MS) == 12_000 * MS


def test_a_crystal_that_runs_slow_makes_no_stamp_old_where_timesync_is_not_answered() -> None:
    """100 parts in a million are 60 ms after ten minutes, and 3 ms after half a minute."""
    clock = BootClock(TimesyncEstimator())
    for now_ms in range(0, 600_000, 1_000):
        time_ns = clock.monotonic_ns(round(now_ms * MS * (1.0 - 100e-6)), (now_ms + 5) * MS)
        assert abs(time_ns - now_ms * MS) < 10 * MS


def test_a_clock_is_known_less_the_longer_it_was_not_asked_and_least_when_never() -> None:
    sync = TimesyncEstimator()
    clock = BootClock(sync)
    clock.monotonic_ns(0, 5_000 * MS)
    unsynced_s = clock.std_s
    exchange(sync, 6_000 * MS, -7_000 * MS, MS, 3 * MS)
    told_s = []
    for sampled_ms in (6_010, 36_010):
        clock.monotonic_ns((sampled_ms - 7_000) * MS, (sampled_ms + 2) * MS)
        told_s.append(clock.std_s)
    assert told_s[0] == pytest.approx(0.002 / np.sqrt(3), rel=0.01)  # the reply is anywhere within 2 ms
    assert told_s[1] - told_s[0] == pytest.approx(30 * 50e-6)  # 50 parts in a million for half a minute
    assert unsynced_s > told_s[1]
    sync.clear()  # the autopilot has rebooted
    assert sync.offset_ns is None
    clock.monotonic_ns(0, 40_000 * MS)
    assert clock.std_s == unsynced_s


def test_a_camera_that_turns_by_a_clock_hardly_known_has_an_attitude_hardly_known() -> None:
    def variance(clock_std_s: float, turn_rad: float) -> float:
        buffer = OwnShipBuffer()
        views: list[View] = []
        for k in range(2):
            q = q_wxyz(Rotation.from_euler("z", k * turn_rad))
            buffer.add_attitude(k * 100 * MS, q, np.zeros(3), clock_std_s)
            own_ship = buffer.at(k * 100 * MS)
            views.append(View.of(k * 100 * MS, own_ship, Mount(np.eye(3), np.zeros(3)), views[-1] if views else None))
        return views[-1].attitude_variance

    assert variance(0.02, 0.0) == variance(0.0, 0.0)
    turning_radps = 1.0
    more = variance(0.02, 0.1) - variance(0.0, 0.1)
    assert more == pytest.approx((0.02 * turning_radps) ** 2)


def test_stamps_from_another_clock_than_timesyncs_fall_back_to_the_quickest_arrival() -> None:
    sync = TimesyncEstimator()
    clock = BootClock(sync)
    exchange(sync, 0, 1_700_000_000_000 * MS, MS, MS)  # a peer that answers with UTC
    for k, delay_ms in enumerate((9, 3, 30, 12)):
        time_ns = clock.monotonic_ns(k * 20 * MS, (5_000 + k * 20 + delay_ms) * MS)
    assert time_ns == (5_000 + 3 * 20 + 3) * MS


@given(synced=st.booleans(), backlog_ms=st.integers(1_100, 20_000), rate_hz=st.sampled_from([4, 20, 120]))
def test_an_attitude_that_the_link_held_back_is_never_told_as_that_of_now(
    synced: bool, backlog_ms: int, rate_hz: int
) -> None:
    """A line that is too slow or was cut for a while delivers all of it late: answers to TIMESYNC come too late too."""
    sync = TimesyncEstimator()
    clock = BootClock(sync)
    if synced:
        exchange(sync, 0, 5_000 * MS, MS, MS)
    for k in range(12 * rate_hz):
        sampled_ns = 1_000 * MS + k * 1_000 * MS // rate_hz
        held_back_ns = backlog_ms * MS if k >= 2 * rate_hz else 0
        time_ns = clock.monotonic_ns(sampled_ns + 5_000 * MS, sampled_ns + 3 * MS + held_back_ns)
        assert abs(time_ns - sampled_ns) <= (0 if synced else 3 * MS)


@pytest.mark.parametrize(
    ("stamps_ms", "reboots"),
    [([100_000, 100_020, 100_010, 100_040], 0), ([100_000, 500, 520], 1), ([3_000, 2_990, 3_020], 0)],
)
def test_a_boot_time_that_falls_is_a_reboot_and_a_late_datagram_is_not(stamps_ms: list[int], reboots: int) -> None:
    detector = RebootDetector()
    assert sum(detector.rebooted(stamp_ms) for stamp_ms in stamps_ms) == reboots


@pytest.mark.parametrize(
    ("numbers_and_stamps_ms", "steps"),
    [
        ([(254, 1_000), (1, 1_020), (255, 1_010), (4, 1_040)], 0),  # a late datagram
        ([(254, 1_000), (254, 1_000), (1, 1_018), (3, 1_015)], 0),  # one that comes twice, and a rounding
        ([(254, 1_000), (1, 990), (4, 1_010), (7, 1_030)], 1),
        ([(5, 1_000), (5, 900), (5, 1_020)], 0),  # a sender that does not number its messages
        # One whose messages come by two ways.
        ([(k + 90 * late, 1_000 + 20 * k - 8 * late) for k in range(60) for late in (0, 1)], STEPS_MAX),
    ],
)
def test_a_clock_is_set_back_if_what_was_sent_later_is_stamped_earlier(
    numbers_and_stamps_ms: list[tuple[int, int]], steps: int
) -> None:
    detector = StepDetector()
    assert sum(detector.set_back(31, *message) for message in numbers_and_stamps_ms) == steps


def test_a_clock_that_is_set_back_is_told_once_though_all_kinds_of_messages_show_it() -> None:
    detector = StepDetector()
    messages = [(30, 1, 1_000), (31, 2, 1_010), (30, 3, 500), (31, 4, 510), (30, 5, 520), (31, 6, 300), (30, 7, 310)]
    steps = [detector.set_back(*message) for message in messages]
    assert steps == [False, False, True, False, False, True, False]
