"""When a frame was exposed: an old one must never be told as a new one, whatever held it up."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from edge.cameras.device import DeviceSource
from edge.cameras.source import SourceLost
from edge.cameras.stamps import BACKLOG_MAX_NS, DOUBTED_FRAMES, StampCheck, StreamClock
from edge.cameras.stream import BEHIND_MAX_NS, StreamSource
from edge.config_camera import DeviceCamera, IntrinsicsSettings, StreamCamera

S = 1_000_000_000
PERIOD_NS = S // 30
AGE_MAX_NS = 1 * S
INTRINSICS = IntrinsicsSettings(fx=300, fy=300, cx=159.5, cy=89.5, width=320, height=180)


@given(
    st.lists(st.integers(0, 400_000_000), min_size=2, max_size=80),
    st.integers(0, 10**15),
    st.integers(-(10**12), 10**12),
    st.floats(-100, 100),
)
def test_a_streams_stamps_are_its_exposures_and_the_least_delay(
    delays_ns: list[int], boot_ns: int, origin_ns: int, drift_ppm: float
) -> None:
    clock = StreamClock()
    for k, delay_ns in enumerate(delays_ns):
        exposed_ns = boot_ns + PERIOD_NS * k
        drifted_ns = round(PERIOD_NS * k * (1 + drift_ppm * 1e-6))
        stamp_ns = clock.monotonic_ns(drifted_ns + origin_ns, exposed_ns + delay_ns)
        assert stamp_ns is not None
        assert stamp_ns <= exposed_ns + delay_ns
        drift_max_ns = 600e-6 * (PERIOD_NS * k + 400_000_000)
        assert abs(stamp_ns - (exposed_ns + min(delays_ns[: k + 1]))) <= drift_max_ns + 1


def test_a_stream_that_starts_over_is_laid_on_our_clock_anew() -> None:
    clock, step_ns = StreamClock(), 40_000_000
    assert clock.monotonic_ns(0, 10**12) == 10**12
    late = clock.monotonic_ns(step_ns, 10**12 + step_ns + 7_000_000)
    assert late == pytest.approx(10**12 + step_ns, abs=100_000)
    assert clock.monotonic_ns(0, 2 * 10**12) is None  # back to its beginning
    assert clock.monotonic_ns(step_ns, 2 * 10**12 + step_ns) == 2 * 10**12 + step_ns
    ahead_ns = 3 * 10**12  # a gap in its clock that ours does not have
    assert clock.monotonic_ns(ahead_ns, 2 * 10**12 + 2 * step_ns) == 2 * 10**12 + 2 * step_ns


@given(st.floats(0.3, 2.9), st.floats(0.001, 0.02))
def test_what_a_stalled_stream_held_back_keeps_its_age(stall_s: float, drain_s: float) -> None:
    clock = StreamClock()
    held_from, now_ns = 200, 0
    for k in range(400):
        exposed_ns = 10 * S + k * PERIOD_NS
        release_ns = 10 * S + held_from * PERIOD_NS + round(stall_s * S)
        now_ns = max(exposed_ns, now_ns + round(drain_s * S), release_ns if k >= held_from else 0)
        stamp_ns = clock.monotonic_ns(k * PERIOD_NS, now_ns)
        assert stamp_ns is not None
        assert abs(stamp_ns - exposed_ns) < 10_000_000


@pytest.mark.parametrize("glitch_ns", [0, -1, -PERIOD_NS // 2, -5 * S])
def test_one_stamp_that_does_not_increase_leaves_those_after_it_their_age(glitch_ns: int) -> None:
    """As cheap cameras send them now and then; here while a stall's frames are read."""
    clock, held_from, wrong = StreamClock(), 200, 230
    for k in range(400):
        exposed_ns = 10 * S + k * PERIOD_NS
        arrival_ns = max(exposed_ns, 10 * S + held_from * PERIOD_NS + 2 * S if k >= held_from else 0)
        stamp_ns = clock.monotonic_ns((wrong - 1) * PERIOD_NS + glitch_ns if k == wrong else k * PERIOD_NS, arrival_ns)
        if k == wrong:
            assert stamp_ns is None
        else:
            assert stamp_ns is not None
            assert abs(stamp_ns - exposed_ns) < 10_000_000


@example(waited_s=0.109375, fps=5, speed=2.0, jitter_s=0.03, seed=14550)
@given(
    waited_s=st.floats(0.1, 4.0),
    fps=st.sampled_from([5, 30, 60]),
    speed=st.floats(1.3, 8.0),
    jitter_s=st.sampled_from([0.0, 0.005, 0.03]),
    seed=st.integers(0, 2**32 - 1),
)
def test_what_waited_in_a_stream_before_it_was_read_is_not_told_as_that_of_now(
    waited_s: float, fps: int, speed: float, jitter_s: float, seed: int
) -> None:
    """Opened, and read first when the model was loaded: the frames of that time come at the decoder's speed."""
    rng, clock, now_ns, told = np.random.default_rng(seed), StreamClock(), 0, 0
    jitters_ns: list[int] = []  # of frames that neither waited nor stood behind one that did
    for k in range(12 * fps):
        exposed_ns = 10 * S + k * S // fps
        sent_ns = exposed_ns + round(jitter_s * S * rng.exponential())
        now_ns = max(10 * S + round(waited_s * S), sent_ns, now_ns + round(S / fps / speed))
        if now_ns == sent_ns:
            jitters_ns.append(sent_ns - exposed_ns)
        stamp_ns = clock.monotonic_ns(k * S // fps, now_ns)
        assert stamp_ns is not None
        if clock.caught_up and now_ns < (14.9 + waited_s) * S:
            told += 1
            # That a frame is late shows only beside one that is less so.
            assert stamp_ns - exposed_ns < 0.1 * S + min(jitters_ns, default=0)
    assert clock.caught_up
    assert told > 0 or waited_s / (speed - 1) > 3.0


def test_a_stream_whose_clock_is_fast_for_good_is_told_all_the_same() -> None:
    clock = StreamClock()
    for k in range(6 * 30):
        clock.monotonic_ns(round(k * PERIOD_NS * 1.2), k * PERIOD_NS)
    assert clock.caught_up


def test_a_stream_that_stays_behind_says_so_and_one_that_jitters_or_drifts_does_not() -> None:
    rng = np.random.default_rng(3)
    clock, behind_s = StreamClock(), []
    for k in range(3000):
        exposed_ns = 10 * S + k * PERIOD_NS
        backlog_ns = 400_000_000 if k >= 2000 else 0
        arrival_ns = exposed_ns + backlog_ns + int(rng.exponential(40e6))
        clock.monotonic_ns(round(k * PERIOD_NS * (1 - 100e-6)), arrival_ns)
        behind_s.append(clock.behind_ns() / S)
    assert max(behind_s[:2000]) < 0.05
    assert behind_s[-1] == pytest.approx(0.4, abs=0.05)


@pytest.mark.parametrize("ppm", [-1_900, -1_000, -600, 0])
def test_a_stream_clock_that_runs_slow_is_followed_and_what_was_held_back_keeps_its_age(ppm: int) -> None:
    rng, clock, now_ns = np.random.default_rng(1), StreamClock(), 0
    errors_ns, behind_ns = [], []
    for k in range(90 * 30):
        exposed_ns = 10 * S + k * PERIOD_NS
        released_ns = 72 * S if exposed_ns >= 70 * S else 0
        late_ns = int(rng.uniform(0, 30e6)) + (200_000_000 if rng.random() < 0.02 else 0)
        now_ns = max(exposed_ns + late_ns, released_ns, now_ns + PERIOD_NS // 2)
        stamp_ns = clock.monotonic_ns(round(k * PERIOD_NS * (1 + ppm * 1e-6)), now_ns)
        assert stamp_ns is not None
        assert stamp_ns <= now_ns
        errors_ns.append(abs(stamp_ns - exposed_ns))
        behind_ns.append(clock.behind_ns())
    assert max(errors_ns[30 * 30 :]) < 15_000_000
    assert max(behind_ns) < BEHIND_MAX_NS  # it is not opened again


def test_a_stream_clock_that_runs_fast_is_followed() -> None:
    rng, clock = np.random.default_rng(1), StreamClock()
    for k in range(90 * 30):
        exposed_ns = 10 * S + k * PERIOD_NS
        arrival_ns = exposed_ns + int(rng.uniform(0, 30e6))
        stamp_ns = clock.monotonic_ns(round(k * PERIOD_NS * 1.01), arrival_ns)
        assert stamp_ns is not None
        assert k < 30 * 30 or abs(stamp_ns - exposed_ns) < 15_000_000


def test_a_stream_that_falls_behind_evenly_is_not_taken_for_one_with_a_slow_clock() -> None:
    rng, clock, behind_s = np.random.default_rng(3), StreamClock(), []
    for k in range(60 * 30):
        arrival_ns = 10 * S + round(k * PERIOD_NS * 1.01) + int(rng.uniform(0, 5e6))
        clock.monotonic_ns(k * PERIOD_NS, arrival_ns)
        behind_s.append(clock.behind_ns() / S)
    assert behind_s[-1] > 0.4


@pytest.mark.parametrize("ppm", [0, -1_000])
def test_a_backlog_is_told_whether_or_not_the_streams_clock_runs_slow(ppm: int) -> None:
    rng, clock, behind_s = np.random.default_rng(2), StreamClock(), []
    for k in range(60 * 30):
        arrival_ns = 10 * S + k * PERIOD_NS + (400_000_000 if k >= 40 * 30 else 0) + int(rng.uniform(0, 30e6))
        clock.monotonic_ns(round(k * PERIOD_NS * (1 + ppm * 1e-6)), arrival_ns)
        behind_s.append(clock.behind_ns() / S)
    assert max(behind_s[20 * 30 : 40 * 30]) < 0.05
    assert behind_s[46 * 30] == pytest.approx(0.4, abs=0.05)
    assert behind_s[-1] == pytest.approx(0.4, abs=0.05)


@settings(max_examples=40, deadline=None)
@example([(at_s, 0.016) for at_s in (10.0, 18.0, 26.0, 34.0)], 0)
@given(
    st.lists(st.tuples(st.floats(3.0, 40.0), st.floats(0.02, 0.2)), min_size=1, max_size=3),
    st.integers(0, 2**32 - 1),
)
def test_a_backlog_that_grows_step_by_step_is_not_taken_for_a_slow_clock(
    steps_s: list[tuple[float, float]], seed: int
) -> None:
    rng, clock = np.random.default_rng(seed), StreamClock()
    for k in range(45 * 30):
        backlog_s = sum(size_s for at_s, size_s in steps_s if k >= at_s * 30)
        exposed_ns = 10 * S + k * PERIOD_NS
        jitter_ns = int(rng.uniform(0, 5e6)) if k else 0
        stamp_ns = clock.monotonic_ns(k * PERIOD_NS, exposed_ns + round(backlog_s * S) + jitter_ns)
        assert stamp_ns is not None
        assert abs(stamp_ns - exposed_ns) < 32_000_000  # 45 s of drift, and the jitter


@given(st.integers(0, 10**15), st.integers(0, AGE_MAX_NS), st.integers(AGE_MAX_NS + 1, 10**12))
def test_once_a_drivers_stamp_has_fitted_an_old_one_is_an_old_frame(boot_ns: int, fresh_ns: int, old_ns: int) -> None:
    stamps = StampCheck(AGE_MAX_NS)
    assert stamps.believes(boot_ns - fresh_ns, boot_ns)
    assert stamps.believes(boot_ns - old_ns, boot_ns)
    assert not stamps.believes(boot_ns + 1, boot_ns)  # of the future
    believed = [stamps.believes(boot_ns - old_ns, boot_ns) for _ in range(DOUBTED_FRAMES + 1)]
    assert believed[0]
    assert not believed[-1]  # no backlog is that long
    assert stamps.believes(boot_ns - fresh_ns, boot_ns)


@given(st.integers(AGE_MAX_NS + 1, 10**12), st.integers(0, 4_000_000))
def test_stamps_of_a_clock_that_never_fitted_are_replaced_once_they_cannot_be_a_backlog(
    old_ns: int, jitter_ns: int
) -> None:
    stamps = StampCheck(AGE_MAX_NS)
    believed = [stamps.believes(k * PERIOD_NS - old_ns - k % 2 * jitter_ns, k * PERIOD_NS) for k in range(40)]
    begins = believed.index(False)
    too_old = [age_ns > BACKLOG_MAX_NS for age_ns in (old_ns, old_ns + jitter_ns)]
    assert begins == (too_old.index(True) if any(too_old) else 16)
    assert set(believed[:begins]) <= {None}
    assert set(believed[begins:]) == {False}


@given(st.booleans(), st.floats(2.0, 9.0), st.integers(5, 240), st.floats(0.001, 0.9))
def test_what_was_held_back_is_never_told_as_new(fitted: bool, stall_s: float, fps: int, drain_share: float) -> None:
    """Whether the stall came before the first frame, and however many frames it held."""
    stamps, period_ns, now_ns = StampCheck(AGE_MAX_NS), S // fps, 0
    if fitted:
        assert stamps.believes(0, 0)
    for k in range(1, round(10 * stall_s * fps)):
        exposed_ns = k * period_ns
        now_ns = max(exposed_ns, round(stall_s * S), now_ns + round(drain_share * period_ns))
        believed = stamps.believes(exposed_ns, now_ns)
        assert believed is not False
        assert fitted <= (believed is True)
        if now_ns == exposed_ns:
            assert believed
            break


class Fed:
    """In place of cv2.VideoCapture: frames with given stamps."""

    def __init__(self, stamps_ms: list[float], shapes: list[tuple[int, int]] | None = None) -> None:
        self._stamps_ms, self._shapes = stamps_ms, shapes or [(180, 320)] * len(stamps_ms)
        self._at = -1

    def isOpened(self) -> bool:
        return True

    def grab(self) -> bool:
        self._at += 1
        return self._at < len(self._stamps_ms)

    def get(self, prop: int) -> float:
        known = {cv2.CAP_PROP_FRAME_WIDTH: 320.0, cv2.CAP_PROP_FRAME_HEIGHT: 180.0, cv2.CAP_PROP_FPS: 30.0}
        return known[prop] if prop in known else self._stamps_ms[self._at]

    def retrieve(self) -> tuple[bool, np.ndarray]:
        return True, np.zeros((*self._shapes[self._at], 3), np.uint8)


def test_a_picture_of_another_shape_in_flight_is_a_camera_to_be_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    shapes = [(180, 320)] * 31 + [(360, 640), (1, 4711)]  # as many as it takes to show that nothing waits there
    times_ns = iter([k * PERIOD_NS for k in range(len(shapes))])
    monkeypatch.setattr("edge.cameras.live.time", SimpleNamespace(monotonic_ns=lambda: next(times_ns)))
    source = StreamSource(StreamCamera(type="stream", url="udp://127.0.0.1:9", intrinsics=INTRINSICS))
    monkeypatch.setattr(source, "_connect", lambda: Fed([k * PERIOD_NS / 1e6 for k in range(len(shapes))], shapes))
    source.open()
    while (frame := source.read(threading.Event())).meta.sequence < 30:
        pass
    assert frame.K[0, 0] == 300
    assert source.read(threading.Event()).K[0, 0] == 600  # the same picture, larger
    with pytest.raises(SourceLost, match="another shape"):
        source.read(threading.Event())


def test_a_device_s_frame_from_before_a_stall_keeps_the_driver_s_stamp(monkeypatch: pytest.MonkeyPatch) -> None:
    times_ns = iter([100 * S, 104 * S, 104 * S + PERIOD_NS])
    monkeypatch.setattr("edge.cameras.live.time", SimpleNamespace(monotonic_ns=lambda: next(times_ns)))
    source = DeviceSource(DeviceCamera(type="device", width=320, height=180, latency_ms=5, intrinsics=INTRINSICS))
    monkeypatch.setattr(source, "_connect", lambda: Fed([99_990, 100_023, 104_030]))
    source.open()
    exposed_ms = [source.read(threading.Event()).meta.capture_ns / 1e6 for _ in range(3)]
    np.testing.assert_allclose(exposed_ms, [99_985, 100_018, 104_025])
    assert source.counts["unstamped"] == 0


def test_a_stream_that_stays_behind_is_opened_again(monkeypatch: pytest.MonkeyPatch) -> None:
    frames = 600
    late_ns = BEHIND_MAX_NS + 50_000_000
    times_ns = iter([k * PERIOD_NS + (late_ns if k >= 200 else 0) for k in range(frames)])
    monkeypatch.setattr("edge.cameras.live.time", SimpleNamespace(monotonic_ns=lambda: next(times_ns)))
    source = StreamSource(StreamCamera(type="stream", url="udp://127.0.0.1:9", intrinsics=INTRINSICS))
    monkeypatch.setattr(source, "_connect", lambda: Fed([k * PERIOD_NS / 1e6 for k in range(frames)]))
    source.open()
    stop = threading.Event()
    for _ in range(200 + 4 * 30):
        source.read(stop)
    with pytest.raises(SourceLost, match="behind itself"):  # after five seconds of it, not after one late burst
        [source.read(stop) for _ in range(2 * 30)]
