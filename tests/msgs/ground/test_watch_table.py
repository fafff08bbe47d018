"""The table of `uavpose-ground watch`."""

from __future__ import annotations

import dataclasses
import io
from collections import Counter

import numpy as np
import pytest
from rich.console import Console

from msgs import cdr, topics
from msgs.ground.feed import Incoming
from msgs.ground.fleet import Fleet
from msgs.ground.watch import Fitted, table

from ..conftest import pose_now

NOW_NS, S = 1_700_000_000_000_000_000, 1_000_000_000
DIM = "\x1b[2m"


def tell(
    fleet: Fleet, topic: topics.Topic, message: cdr.Payload, now_ns: int, target: str | None = None, uav: str = "uav1"
) -> None:
    """A first sample of this topic."""
    key, attachment = topics.publication_key(topic, uav, target), topics.attachment(1, now_ns, bytes(16))
    fleet.take(Incoming(uav, topic, target, key, message.encode(), attachment), now_ns)


def told_health(level: int, text: str) -> cdr.DiagnosticArray:
    return cdr.DiagnosticArray(NOW_NS, "", (cdr.DiagnosticStatus(level, "uavpose_edge", text, "uav1"),))


def line(fleet: Fleet, now_ns: int, start: str) -> str:
    """The line of the table that begins so, as a terminal gets it."""
    console = Console(file=io.StringIO(), width=160, height=50, force_terminal=True, color_system="standard")
    console.print(table(fleet.rows(now_ns), True, "tcp/127.0.0.1:7447", now_ns))
    assert isinstance(console.file, io.StringIO)
    (found,) = (one for one in console.file.getvalue().splitlines() if start in one)
    return found


@pytest.mark.parametrize("text", ["cannot open [/dev/video0]", "[camera] 3 frames dropped", "[bold]loud[/bold]"])
def test_what_a_vehicle_says_is_shown_as_it_says_it(text: str) -> None:
    fleet = Fleet()
    tell(fleet, topics.EVENTS, cdr.Log(NOW_NS, 20, "uavpose_edge", text), NOW_NS)
    tell(fleet, topics.DIAGNOSTICS, told_health(2, text), NOW_NS)
    assert line(fleet, NOW_NS, "uav1").count(text) == 2


def test_what_a_vehicle_says_does_not_steer_the_terminal() -> None:
    fleet, text = Fleet(), "all\x1b[2J\x1b]0;owned\x07 is\r\nwell\x9b5m"
    tell(fleet, topics.EVENTS, cdr.Log(NOW_NS, 20, "uavpose_edge", text), NOW_NS)
    tell(fleet, topics.DIAGNOSTICS, told_health(2, text), NOW_NS)
    shown = line(fleet, NOW_NS, "uav1")
    assert shown.count("all [2J ]0;owned  is  well 5m") == 2
    assert not any(one in shown for one in ("\x1b[2J", "\x1b]", "\x07", "\r", "\x9b"))


def test_health_that_is_no_longer_told_is_dim_and_says_its_age() -> None:
    fleet = Fleet()
    fleet.alive("uav1", True)
    assert f"{DIM}–" in line(fleet, NOW_NS, "uav1")
    tell(fleet, topics.DIAGNOSTICS, told_health(0, "tracking"), NOW_NS)
    assert "\x1b[32mtracking" in line(fleet, NOW_NS + 2 * S, "uav1")
    assert f"{DIM}tracking (4 s ago)" in line(fleet, NOW_NS + 4 * S, "uav1")
    assert "tracking" not in line(fleet, NOW_NS - 3600 * S, "uav1")
    fleet.alive("uav1", False)
    assert f"{DIM}tracking (2 s ago)" in line(fleet, NOW_NS + 2 * S, "uav1")


def test_why_nothing_is_shown_is_told_beside_the_number_of_refused_samples() -> None:
    fleet = Fleet()
    tell(fleet, topics.POSE, dataclasses.replace(pose_now(), stamp_ns=NOW_NS + 7200 * S), NOW_NS, "t0")
    assert " 1: stamp lies in the future " in line(fleet, NOW_NS, "uav1")
    tell(fleet, topics.POSE, dataclasses.replace(pose_now(), stamp_ns=NOW_NS), NOW_NS, "t1")
    assert "stamp" not in line(fleet, NOW_NS, "uav1 ")


def test_a_target_is_dim_by_when_it_was_heard_whatever_the_vehicle_s_clock_says() -> None:
    fleet = Fleet()
    tell(fleet, topics.POSE, dataclasses.replace(pose_now(), stamp_ns=NOW_NS - 3 * S // 2), NOW_NS, "t0")
    assert DIM not in line(fleet, NOW_NS + S // 2, "uav1/t0")
    assert DIM in line(fleet, NOW_NS + 2 * S, "uav1/t0")


def test_of_a_target_whose_range_is_not_known_the_table_shows_where_it_is_seen() -> None:
    fleet = Fleet()
    tell(fleet, topics.POSE, dataclasses.replace(pose_now(), stamp_ns=NOW_NS - S // 10), NOW_NS, "t0")
    for target in ("t0", "t1"):
        ray = cdr.Vector3Stamped(NOW_NS - S // 20, "camera_optical_frame", np.array([0.48, 0.6, 0.64]))
        tell(fleet, topics.DIRECTION, ray, NOW_NS, target)
    console = Console(file=io.StringIO(), width=120)
    console.print(table(fleet.rows(NOW_NS), True, "tcp/127.0.0.1:7447", NOW_NS))
    assert isinstance(console.file, io.StringIO)
    shown = [line.split() for line in console.file.getvalue().splitlines() if "uav1/t" in line]
    assert shown == [[f"uav1/{name}", "?", "?", "–", "36.9c", "-36.9", "–", "?", "–", "0.05"] for name in ("t0", "t1")]


@pytest.mark.parametrize("columns", [40, 60, 80])
def test_a_narrow_terminal_cuts_neither_names_nor_numbers(columns: int) -> None:
    fleet = Fleet()
    tell(fleet, topics.DIAGNOSTICS, told_health(1, "degraded, tracking; no own attitude"), NOW_NS)
    for target in ("t0", "t12"):
        key = topics.publication_key(topics.POSE, "reconnaissance_12", target)
        pose = dataclasses.replace(pose_now(), stamp_ns=NOW_NS, t_cam_target_m=np.array([-1218.2, -310.5, 804.1]))
        attachment = topics.attachment(1, NOW_NS, bytes(16))
        incoming = Incoming("reconnaissance_12", topics.POSE, target, key, pose.encode(), attachment)
        assert fleet.take(incoming, NOW_NS) is not None

    def shown(width: int) -> Counter[str]:
        console = Console(file=io.StringIO(), width=width, height=50)
        console.print(table(fleet.rows(NOW_NS), True, "tcp/127.0.0.1:7447", NOW_NS))
        assert isinstance(console.file, io.StringIO)
        return Counter(one for one in console.file.getvalue() if not one.isspace() and one != "─")

    assert shown(columns) == shown(200)


def test_a_screen_shows_targets_first_one_line_each_and_says_how_many_lines_are_hidden() -> None:
    fleet, uavs = Fleet(), [f"uav{number}" for number in range(10)]
    for uav in uavs:
        told, event = told_health(1, "degraded, tracking; no own attitude"), "target 0 lost: held for 3.7 s"
        tell(fleet, topics.DIAGNOSTICS, told, NOW_NS, uav=uav)
        tell(fleet, topics.EVENTS, cdr.Log(NOW_NS, 20, "uavpose_edge", event), NOW_NS, uav=uav)
        tell(fleet, topics.POSE, dataclasses.replace(pose_now(), stamp_ns=NOW_NS), NOW_NS, "t0", uav)

    def shown(lines: int) -> list[str]:
        console = Console(file=io.StringIO(), width=80, height=lines)
        console.print(Fitted(table(fleet.rows(NOW_NS), True, "tcp/127.0.0.1:7447", NOW_NS, one_line=True)))
        assert isinstance(console.file, io.StringIO)
        return console.file.getvalue().splitlines()

    whole, cut = shown(100), shown(24)
    assert [one.split()[0] for one in whole if "uav" in one] == [*(f"{uav}/t0" for uav in uavs), *uavs]
    assert sum("degraded" in one and "target 0" in one and one.count("…") == 2 for one in whole) == 10
    assert len(cut) == 24
    assert cut[:-1] == whole[:23]
    assert cut[-1].startswith(f"… {len(whole) - 23} more lines")
