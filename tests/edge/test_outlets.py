"""All links as the daemon starts and ends them: what it says goes to the ground, the autopilot and the recording."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import zenoh
from mcap.reader import make_reader

from edge import threads
from edge.config import MavlinkSettings, load_config
from edge.config_ground import ZenohSettings
from edge.estimator.model import load_model
from edge.health import Activity, Condition, HealthState, Reason
from edge.links.mavlink_link import MavlinkLink
from edge.links.zenoh_link import ZenohLink
from edge.outlets import Outlets, start_outlets
from edge.pictures import Picture
from edge.requests import RequestQueue
from edge.status_board import StatusBoard
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import Mount
from msgs import topics
from msgs.cdr import Log
from msgs.client import connect
from msgs.ground.keys import init_authority, issue
from msgs.mavlink import dialect
from sim_replay.ports import free_endpoint, free_port
from tests.certificates import redate
from tests.waiting import until

from .mavlink_peer import CAMERA, Peer
from .reports import FAULT, TRACKING

LIMPING = Condition(HealthState.DEGRADED, Activity.TRACKING, (Reason("slow", "slow"),))


@dataclass
class Ends:
    """The running links, and what their peers have heard: text and severity."""

    outlets: Outlets
    folder: Path
    peer: Peer
    by_ground: list[tuple[str, int]] = field(default_factory=list)

    def by_autopilot(self) -> list[tuple[str, int]]:
        return [(one.text, one.severity) for one in self.peer.received if one.get_type() == "STATUSTEXT"]

    def until_heard(self, *texts: str) -> None:
        """Until each of these was heard by both peers."""
        until(
            lambda: all(set(texts) <= {text for text, _ in said} for said in (self.by_ground, self.by_autopilot())),
            self.peer.serve,
            what=f"{texts}, not {self.by_ground} and {self.by_autopilot()}",
        )

    def recorded(self) -> list[str]:
        """The texts of the events on disk."""
        texts = []
        for path in self.folder.glob("*.mcap"):
            with open(path, "rb") as file:
                for _, channel, message in make_reader(file).iter_messages():
                    if channel.topic.endswith("/events"):
                        texts.append(Log.decode(message.data).msg)
        return texts


def board_of(tmp_path: Path, toy_model: Path, text: str) -> StatusBoard:
    """Of a daemon with this configuration."""
    (tmp_path / "config.toml").write_text(f'[camera]\ntype = "sequence"\npath = "scene"\n{text}')
    return StatusBoard(load_config(tmp_path / "config.toml"), load_model(toy_model, 1), CAMERA)


@contextmanager
def started(tmp_path: Path, toy_model: Path, folder: Path, *states: Condition) -> Iterator[Ends]:
    """Once the autopilot is met; `states` were told before anybody was there."""
    ground, autopilot = free_port(), free_port(socket.SOCK_DGRAM)
    board = board_of(
        tmp_path,
        toy_model,
        f'[zenoh]\nlisten = ["tcp/127.0.0.1:{ground}"]\n'
        f'[mavlink]\nendpoints = ["udpin:127.0.0.1:{autopilot}"]\n'
        f'[recorder]\nenabled = true\nfolder = "{folder}"\nfree_min_mb = 0\n',
    )
    with ExitStack() as cleanup:
        outlets = start_outlets(board, OwnShipBuffer(), RequestQueue(), lambda _: False, cleanup)
        for state in states:
            outlets.tell(state)
        with connect(f"tcp/127.0.0.1:{ground}") as session, Peer(autopilot) as peer:
            ends = Ends(outlets, folder, peer)

            def hear(sample: zenoh.Sample) -> None:
                event = Log.decode(sample.payload.to_bytes())
                ends.by_ground.append((event.msg, event.level))

            session.declare_subscriber(
                topics.subscription_key(topics.EVENTS, "uav1"), zenoh.handlers.Callback(hear, indirect=False)
            )
            peer.named("HEARTBEAT", lambda: outlets.set_health(TRACKING))
            yield ends


LINKS = {"zenoh", "mavlink", "recorder"}


def test_what_is_said_reaches_ground_autopilot_and_recording_as_serious_as_it_is(
    tmp_path: Path, toy_model: Path
) -> None:
    no_utf8 = os.fsdecode(b"/fl\xfcge/f.toml cannot be read")
    by_ground = {"target 0 acquired": 20, "target 0 lost": 30, str(LIMPING): 30, str(FAULT): 40}
    by_autopilot = {"target 0 acquired": 6, "target 0 lost": 4, str(LIMPING): 4, str(FAULT): 3}
    escaped = r"/fl\udcfcge/f.toml cannot be read"
    by_ground[escaped], by_autopilot[escaped] = 40, 3
    with started(tmp_path, toy_model, tmp_path / "recordings") as ends:
        assert ends.outlets.threads() == LINKS <= threads.running()
        ends.outlets.event(logging.INFO, "target 0 acquired")
        ends.outlets.event(logging.WARNING, "target 0 lost")
        ends.outlets.tell(LIMPING)
        ends.outlets.tell(FAULT)
        ends.outlets.event(logging.ERROR, no_utf8)
        ends.until_heard(*by_ground)
        assert dict(ends.by_ground) == by_ground
        assert by_autopilot.items() <= dict(ends.by_autopilot()).items()
        ends.outlets.event(logging.INFO, "the last word")
    assert set(ends.recorded()) == {*by_ground, "the last word"}
    assert not LINKS & threads.running()


def test_an_autopilot_that_comes_later_is_told_the_state_of_now_and_none_of_before(
    tmp_path: Path, toy_model: Path
) -> None:
    with started(tmp_path, toy_model, tmp_path / "recordings", FAULT, LIMPING) as ends:
        until(lambda: ends.by_autopilot() != [], ends.peer.serve, what="the state")
    assert ends.by_autopilot() == [(str(LIMPING), dialect.MAV_SEVERITY_WARNING)]


def test_the_last_event_is_sent_and_on_disk_once_it_is_said(tmp_path: Path, toy_model: Path) -> None:
    stuck = "the main loop has stood still for 9 s"
    with started(tmp_path, toy_model, tmp_path / "recordings") as ends:
        ends.outlets.last_event(logging.ERROR, stuck)
        recorded, running = ends.recorded(), threads.running()
        ends.until_heard(stuck)
    assert recorded == [stuck]
    assert not LINKS & running


def test_a_folder_that_cannot_be_recorded_to_is_told_to_ground_and_autopilot(tmp_path: Path, toy_model: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    stopped = "recording stopped: Not a directory"
    with started(tmp_path, toy_model, tmp_path / "file" / "recordings") as ends:
        ends.outlets.event(logging.INFO, "target 0 acquired")
        ends.until_heard(stopped)
    assert (stopped, logging.ERROR) in ends.by_ground
    assert (stopped, dialect.MAV_SEVERITY_ERROR) in ends.by_autopilot()


def test_a_certificate_that_the_ground_may_refuse_is_in_the_log(
    tmp_path: Path, toy_model: Path, caplog: pytest.LogCaptureFixture
) -> None:
    init_authority(tmp_path)
    issue(tmp_path, "uav2")
    _, ended = redate(tmp_path, "uav2", begins_days=-9, ends_days=-2)
    board = board_of(
        tmp_path,
        toy_model,
        f'[mavlink]\nenabled = false\n[zenoh]\nlisten = []\nconnect = ["{free_endpoint()}"]\n'
        '[zenoh.tls]\nroot_ca = "ca.pem"\ncertificate = "uav2.pem"\nprivate_key = "uav2.key"\n',
    )
    with ExitStack() as cleanup:
        start_outlets(board, OwnShipBuffer(), RequestQueue(), lambda _: False, cleanup)
    no_link, unheard = (record.message for record in caplog.records if record.levelno == logging.WARNING)
    assert no_link.startswith("there may be no link over tls and quic: ")
    assert f"uav2.pem expired on {ended:%Y-%m-%d}" in no_link
    assert unheard.startswith("the ground may hear nothing: ")
    assert "uav2.pem is that of uav2, not uav1's" in unheard


def test_what_a_link_has_no_room_for_is_counted(stepped: int) -> None:
    """As where it stands still: the newest are kept."""
    zenoh_link = ZenohLink(ZenohSettings(listen=[free_endpoint()]), "uav1", Mount(np.eye(3), np.zeros(3)))
    mavlink = MavlinkLink(MavlinkSettings(endpoints=["udpin:127.0.0.1:0"]), OwnShipBuffer(), CAMERA, RequestQueue())
    outlets = Outlets(zenoh_link, mavlink)
    for number in range(70):
        outlets.event(logging.INFO, f"target {number} acquired")
        zenoh_link.publish_picture(Picture(stepped, b"", live=True, recorded=False))
    lost = outlets.counters()
    assert (lost["zenoh_events_lost"], lost["mavlink_events_lost"], lost["zenoh_pictures_replaced"]) == (6, 6, 66)
    zenoh_link.start()
    zenoh_link.settle()
    zenoh_link.stop()
    mavlink.stop()
    sent = outlets.counters()
    assert (sent["zenoh_sent_events"], sent["zenoh_sent_image"]) == (64, 4)
