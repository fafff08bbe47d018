"""What a bad link does to datagrams, and what PX4 does that ArduPilot does not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from msgs.mavlink import MAVLink, dialect, pack
from sim_replay.autopilot import SYSTEM_ID, Autopilot
from sim_replay.bad_link import Lane, LinkFaults
from sim_replay.cli import main

from .test_autopilot import turning_flight

MS = 1_000_000
SENT = [k.to_bytes(2, "big") for k in range(2000)]


def through(faults: LinkFaults, every_ms: float = 10.0) -> list[tuple[bytes, float]]:
    """All of SENT, one each few milliseconds: what came out, and how late, ms."""
    lane, came = Lane(faults), list[tuple[bytes, float]]()
    went_ns = {one: round(k * every_ms * MS) for k, one in enumerate(SENT)}
    for now_ns in range(0, round(len(SENT) * every_ms + 6000) * MS, MS):
        for one in SENT[(now_ns - 1) // round(every_ms * MS) + 1 : now_ns // round(every_ms * MS) + 1]:
            lane.put(one, now_ns)
        came += [(one, (now_ns - went_ns[one]) / MS) for one in lane.due(now_ns)]
    return came


def test_a_good_link_hands_over_at_once_and_in_order() -> None:
    assert through(LinkFaults()) == [(one, 0.0) for one in SENT]


@given(st.floats(0.0, 200.0), st.floats(0.0, 100.0))
def test_delay_and_jitter_keep_order_and_their_bounds(delay_ms: float, jitter_ms: float) -> None:
    lane = Lane(LinkFaults(delay_ms=delay_ms, jitter_ms=jitter_ms))
    for k, one in enumerate(SENT[:50]):
        lane.put(one, k * 20 * MS)
    came = list[bytes]()
    while (due_ns := lane.next_due_ns()) is not None:
        for one in lane.due(due_ns):
            late_ms = due_ns / MS - 20 * SENT.index(one)
            # Behind one that was later still it waits for that.
            assert delay_ms - 0.01 <= late_ms <= delay_ms + jitter_ms + 0.01
            came.append(one)
    assert came == SENT[:50]


def test_the_share_that_was_asked_for_is_lost() -> None:
    came = [one for one, _ in through(LinkFaults(loss=0.2))]
    assert came == sorted(came)
    assert len(came) / len(SENT) == pytest.approx(0.8, abs=0.03)


def test_the_share_that_was_asked_for_is_overtaken_and_nothing_lost() -> None:
    came = [one for one, _ in through(LinkFaults(reorder=0.1))]
    assert sorted(came)[:-1] == SENT[: len(came) - 1]
    overtaken = np.mean(np.diff([SENT.index(one) for one in came]) < 0)
    assert overtaken == pytest.approx(0.1, abs=0.03)


def test_what_is_no_share_is_said(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with pytest.raises(SystemExit) as refused:
        main(["play", "--link-loss", "1.5"])
    assert refused.value.code == 2
    assert "'1.5' is not a number from 0 to 1" in capsys.readouterr().err
    assert main(["play", "--lockstep", "--link-delay-ms", "5", "--out", str(tmp_path)]) == 2
    assert "only in real time, not in lock-step" in capsys.readouterr().err


class Link:
    """The daemon's end of an autopilot without sockets: messages in, messages out, by pymavlink alone."""

    def __init__(self, firmware: str) -> None:
        self.autopilot = Autopilot(turning_flight(), 0, -5_000 * MS, firmware=firmware)
        self._mav = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=191)

    def said(self, now_ns: int) -> list[object]:
        return [m for one in self.autopilot.due(now_ns) for m in MAVLink(None).parse_buffer(one) or []]

    def tell(self, message: object, now_ns: int) -> list[object]:
        replies, _ = self.autopilot.take(pack(self._mav, message), now_ns)
        return [m for one in replies for m in MAVLink(None).parse_buffer(one) or []]


def interval(param3: float) -> object:
    command = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
    attitude = dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
    return dialect.MAVLink_command_long_message(SYSTEM_ID, 1, command, 0, attitude, 20_000, param3, 0, 0, 0, 0)


@pytest.mark.parametrize(("firmware", "result"), [("ardupilot", 0), ("px4", dialect.MAV_RESULT_DENIED)])
def test_px4_denies_an_interval_with_parameters_it_does_not_know(firmware: str, result: int) -> None:
    link = Link(firmware)
    (heartbeat,) = [m for m in link.said(0) if m.get_type() == "HEARTBEAT"]  # type: ignore[attr-defined]
    assert heartbeat.autopilot == (12 if firmware == "px4" else 3)  # type: ignore[attr-defined]
    assert link.tell(interval(0.0), 0)[0].result == 0  # type: ignore[attr-defined]
    assert link.tell(interval(1.0), 0)[0].result == result  # type: ignore[attr-defined]


def test_px4_asks_for_the_time_itself_and_does_not_believe_a_slow_answer() -> None:
    link = Link("px4")
    asked = [m for ms in range(0, 1000, 5) for m in link.said(ms * MS) if m.get_type() == "TIMESYNC"]  # type: ignore[attr-defined]
    assert 9 <= len(asked) <= 11
    question = asked[-1]
    answered_ns = question.ts1 - 5_000 * MS  # type: ignore[attr-defined]
    answer = dialect.MAVLink_timesync_message(123, question.ts1)  # type: ignore[attr-defined]
    link.tell(answer, answered_ns + 4 * MS)
    link.tell(answer, answered_ns + 40 * MS)
    assert link.autopilot.received["TIMESYNC"] == 1
    assert link.autopilot.refused == {"TIMESYNC took too long": 1}
