"""A person points at a target, or lets go of it: through the running daemon, and the rules by themselves."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from edge import clock
from edge.estimator.model import load_model
from edge.requests import POINTED_AGE_MAX_NS, WAITING_MAX, Request, RequestQueue, SelectTarget, StopTracking, TrackBox
from edge.tracking.by_hand import LOOK_NS, REPEATED_NS, REST_NS, ByHand
from edge.tracking.tracker import Tracker
from edge.types import Estimate, Mount, Track, TrackState
from msgs.mavlink import dialect
from sim_replay.ports import free_port

from . import toy_scene
from .looping import OTHER, Gated, box_around, looping
from .looping import frame as loop_frame
from .mavlink_peer import Peer
from .reports import SIZE_WH
from .reports import make_track as track

CENTER_PX = (700.5, 500.5)
IDLE, ACTIVE = 0, 1


def still_scene(folder: Path) -> Path:
    """One target that stands still, as a looping sequence."""
    (folder / "rgb").mkdir(parents=True)
    for index in range(3):
        cv2.imwrite(str(folder / "rgb" / f"{index:06d}.png"), toy_scene.draw(CENTER_PX))
    camera = {"cam_K": toy_scene.K.ravel().tolist(), "depth_scale": 1.0}
    (folder / "scene_camera.json").write_text(json.dumps({str(index): camera for index in range(3)}))
    return folder


def test_stopping_drops_the_target_and_drawing_a_box_takes_it_up_again(tmp_path: Path, toy_model: Path) -> None:
    port = free_port(socket.SOCK_DGRAM)
    config = tmp_path / "flight.toml"
    config.write_text(
        f'[camera]\ntype = "sequence"\npath = "{still_scene(tmp_path / "000001")}"\nfps = 10\nloop = true\n'
        f'[model]\npath = "{toy_model}"\nthreads = 1\n[zenoh]\nenabled = false\n'
        f'[mavlink]\nendpoints = ["udpin:127.0.0.1:{port}"]\n'
    )
    run = [sys.executable, "-m", "edge.cli", "run", "--config", str(config)]
    with subprocess.Popen(run, stderr=subprocess.PIPE, text=True) as daemon, Peer(port) as peer:
        try:
            assert daemon.stderr is not None
            assert any("ready: " in line for line in daemon.stderr)
            status_in(peer, ACTIVE)
            peer.command(2010)
            assert peer.named("COMMAND_ACK").result == dialect.MAV_RESULT_ACCEPTED
            status_in(peer, IDLE)
            # Unasked, it would soon be confirmed again.
            for _ in range(10):
                assert peer.named("CAMERA_TRACKING_IMAGE_STATUS").tracking_status == IDLE
            left, top = (CENTER_PX[0] - 80) / SIZE_WH[0], (CENTER_PX[1] - 60) / SIZE_WH[1]
            right, bottom = (CENTER_PX[0] + 80) / SIZE_WH[0], (CENTER_PX[1] + 60) / SIZE_WH[1]
            peer.command(2005, left, top, right, bottom)
            assert peer.named("COMMAND_ACK").result == dialect.MAV_RESULT_ACCEPTED
            status = status_in(peer, ACTIVE)
            told = {m.text.partition(":")[0] for m in peer.received if m.get_type() == "STATUSTEXT"}
            assert {"target 0 lost", "target 0 chosen"} <= told
        finally:
            daemon.kill()
    center = [0.5 * (status.rec_top_x + status.rec_bottom_x), 0.5 * (status.rec_top_y + status.rec_bottom_y)]
    np.testing.assert_allclose(np.array(center) * SIZE_WH, np.array(CENTER_PX) + 0.5, atol=10.0)


def status_in(peer: Peer, tracking_status: int) -> Any:
    return peer.until(
        lambda m: m.get_type() == "CAMERA_TRACKING_IMAGE_STATUS" and m.tracking_status == tracking_status,
        f"tracking status {tracking_status}",
    )


def test_a_box_is_looked_into_for_a_second() -> None:
    by_hand = ByHand()
    by_hand.take(TrackBox((0.25, 0.5, 0.75, 1.0)), 0)
    np.testing.assert_allclose(by_hand.box_xyxy_px(LOOK_NS, SIZE_WH, []), [479.5, 539.5, 1439.5, 1079.5])
    assert by_hand.box_xyxy_px(LOOK_NS + 1, SIZE_WH, []) is None
    assert by_hand.news() == ["no target found where pointed"]
    assert by_hand.box_xyxy_px(LOOK_NS + 2, SIZE_WH, []) is None
    assert by_hand.news() == []


def test_a_target_that_is_tracked_there_already_is_chosen_until_its_track_ends() -> None:
    by_hand, there, elsewhere = ByHand(), track(0, track_id=2), track(0, track_id=0, box_xyxy_px=np.full(4, 50.0))
    by_hand.take(TrackBox((0.5, 0.4, 0.6, 0.5)), 0)
    assert by_hand.box_xyxy_px(1, SIZE_WH, [elsewhere, there]) is None
    by_hand.settle([elsewhere, there])
    assert by_hand.chosen_id == 2
    by_hand.settle([elsewhere])
    by_hand.settle([elsewhere, there])
    assert by_hand.chosen_id is None, "its number may be another target's by now"
    assert by_hand.box_xyxy_px(2, SIZE_WH, []) is by_hand.box_xyxy_px(LOOK_NS + 1, SIZE_WH, []) is None
    assert by_hand.news() == ["target 2 chosen"], "it was found, and its end is told by the tracker"


def test_a_box_repeated_for_want_of_an_answer_keeps_the_target_though_another_flies_there_by_now() -> None:
    """MAVSDK sends it again after half a second, three times, each like the first."""
    box, first = TrackBox((0.5, 0.4, 0.6, 0.5)), track(0, track_id=2, born_ns=-2)

    def after(*requests: tuple[Request, int], alive: tuple[Track, ...]) -> tuple[int | None, list[str]]:
        """What is chosen, and told, after a first box that found target 2, which has left it since."""
        by_hand = ByHand()
        by_hand.take(box, 0)
        assert by_hand.box_xyxy_px(0, SIZE_WH, [first]) is None
        by_hand.settle([first])
        assert (by_hand.chosen_id, by_hand.news()) == (2, ["target 2 chosen"])
        by_hand.settle(alive)
        for request, now_ns in requests:
            by_hand.take(request, now_ns)
            by_hand.box_xyxy_px(now_ns, SIZE_WH, alive)
            by_hand.settle(alive)
        return by_hand.chosen_id, by_hand.news()

    pair = (replace(first, box_xyxy_px=first.box_xyxy_px + 300.0), track(0, track_id=1, born_ns=-1))
    assert after(*((box, at) for at in (500_000_000, 1_000_000_000, REPEATED_NS)), alive=pair) == (2, [])
    assert after((box, REPEATED_NS + 1), alive=pair) == (1, ["target 1 chosen"]), "meant anew"
    assert after((box, 500_000_000), alive=pair[1:]) == (1, ["target 1 chosen"]), "what was found there is no more"
    other = TrackBox((0.5, 0.4, 0.6, 0.51))
    assert after((other, 500_000_000), alive=pair) == (1, ["target 1 chosen"])
    told = ["target 1 chosen", "target 2 chosen", "target 1 chosen"]
    assert after((other, 1), (SelectTarget(2), 2), (box, 3), alive=pair) == (1, told), "between them another was asked"
    assert after((StopTracking(), 1), alive=pair) == (None, [])


@pytest.mark.parametrize("away_px", [(-300.0, 0.0), (300.0, 0.0), (0.0, -150.0), (0.0, 150.0)])
def test_a_target_beside_the_box_is_not_the_one_pointed_at(away_px: tuple[float, float]) -> None:
    beside = track(0, box_xyxy_px=np.array([1030.0, 470.0, 1090.0, 500.0]) + np.tile(away_px, 2))
    by_hand = ByHand()
    by_hand.take(TrackBox((0.5, 0.4, 0.6, 0.5)), 0)
    np.testing.assert_allclose(by_hand.box_xyxy_px(1, SIZE_WH, [beside]), [959.5, 431.5, 1151.5, 539.5])
    assert by_hand.chosen_id is None
    in_a_corner = track(0, track_id=1, box_xyxy_px=np.array([1100.0, 500.0, 1140.0, 520.0]))
    assert by_hand.box_xyxy_px(1, SIZE_WH, [beside, in_a_corner]) is None
    by_hand.settle([beside, in_a_corner])
    assert by_hand.news() == ["target 1 chosen"]


NEAR_PX, FAR_PX = np.array([400.0, 300.0, 700.0, 500.0]), np.array([620.0, 340.0, 650.0, 352.0])


@pytest.mark.parametrize(
    ("pointed_px", "meant"),
    [
        ((615, 335, 655, 357), 1),  # drawn round the far one
        ((596, 307, 674, 385), 1),  # what a point in its middle becomes
        ((390, 290, 705, 510), 0),  # drawn round the near one, the far one in it too
        ((430, 380, 508, 458), 0),
    ],
)
def test_of_two_targets_there_the_one_pointed_at_is_chosen_though_the_other_s_box_holds_it(
    pointed_px: tuple[int, ...], meant: int
) -> None:
    both = [track(0, track_id=0, box_xyxy_px=NEAR_PX), track(0, track_id=1, box_xyxy_px=FAR_PX)]
    for expected in (both, both[::-1]):
        by_hand = ByHand()
        left, top, right, bottom = ((np.array(pointed_px) + 0.5) / np.tile(SIZE_WH, 2)).tolist()
        by_hand.take(TrackBox((left, top, right, bottom)), 0)
        assert by_hand.box_xyxy_px(1, SIZE_WH, expected) is None
        by_hand.settle(expected)
        assert by_hand.chosen_id == meant


def test_a_target_that_shows_itself_once_and_again_within_the_second_is_the_chosen_one(toy_model: Path) -> None:
    """Gone before it was sure: the look goes on, as nobody else would say that what was chosen is no more."""
    empty = replace(loop_frame(0, OTHER), image_bgr=np.zeros_like(loop_frame(0, OTHER).image_bgr))
    with looping(Gated(load_model(toy_model, 1))) as (loop, ear, requests):
        left, top, right, bottom = ((box_around(OTHER) + 0.5) / np.tile(SIZE_WH, 2)).tolist()
        requests.put(TrackBox((left, top, right, bottom)))
        for index in range(12):
            seen = loop_frame(index, OTHER)
            loop._process(seen if index == 0 or index > 4 else replace(seen, image_bgr=empty.image_bgr))
    assert [len(report.tracks) for report in ear.reports[3:5]] == [0, 0], "it was gone"
    (held,) = ear.reports[-1].tracks
    assert (held.state, ear.reports[-1].chosen_id) == (TrackState.CONFIRMED, held.track_id)


def test_a_target_found_once_and_gone_for_good_is_told_as_not_found() -> None:
    by_hand, unsure = ByHand(), track(0, state=TrackState.TENTATIVE)
    by_hand.take(TrackBox((0.5, 0.4, 0.6, 0.5)), 0)
    assert by_hand.box_xyxy_px(1, SIZE_WH, [unsure]) is None
    by_hand.settle([unsure])
    assert by_hand.box_xyxy_px(LOOK_NS + 1, SIZE_WH, [unsure]) is None
    assert (by_hand.chosen_id, by_hand.news()) == (0, ["target 0 chosen"])
    by_hand.settle([])
    assert by_hand.box_xyxy_px(LOOK_NS + 2, SIZE_WH, []) is None
    assert (by_hand.chosen_id, by_hand.news()) == (None, ["no target found where pointed"])


def test_a_target_selected_by_its_name_is_chosen_unless_it_is_gone() -> None:
    hand, both = ByHand(), [track(1, born_ns=0), track(1, track_id=1, born_ns=0)]
    hand.take(SelectTarget(1), 0)
    assert hand.box_xyxy_px(0, SIZE_WH, both) is None
    assert hand.chosen_id == 1, "before the frame is over too, so that it keeps its slot"
    hand.settle(both)
    assert (hand.chosen_id, hand.news()) == (1, ["target 1 chosen"])
    hand.take(SelectTarget(3), 0)
    hand.settle(both)
    assert (hand.chosen_id, hand.news()) == (None, ["target 3 is gone: not chosen"])
    hand.settle(both)
    assert hand.news() == []
    hand.take(SelectTarget(2), 0)
    hand.settle([*both, track(1, track_id=2)])
    assert hand.news() == ["target 2 is gone: not chosen"], "another was born with its number"


def test_the_search_rests_after_stopping_until_the_next_box_or_ten_seconds() -> None:
    by_hand = ByHand()
    assert by_hand.searches(0)
    by_hand.take(StopTracking(), 0)
    assert not by_hand.searches(REST_NS - 1)
    assert by_hand.searches(REST_NS)
    by_hand.take(TrackBox((0.0, 0.0, 0.1, 0.1)), 5)
    assert by_hand.searches(5)


def seen_at(x_m: float) -> Estimate:
    t_m = np.array([x_m, 0.0, 200.0])
    center_px = (toy_scene.K @ t_m / t_m[2])[:2]
    box = np.concatenate([center_px - 20.0, center_px + 20.0])
    return Estimate(0.9, box, np.eye(3), t_m, np.diag([0.1, 0.1, 4.0, 0.01, 0.01, 0.01]), "track")


def test_a_target_pointed_at_takes_the_place_of_the_one_not_seen_for_longest() -> None:
    mount = Mount(np.eye(3), np.zeros(3))
    tracker = Tracker(2, mount)

    def see(frame: int, *x_m: float) -> list[float]:
        tracks = tracker.update(frame * 33_000_000, [seen_at(x) for x in x_m], None, toy_scene.K, SIZE_WH)
        return sorted(round(float(t.t_cam_target_m[0])) for t in tracks)

    for frame in range(5):
        see(frame, -40.0, 0.0)
    assert see(5, 0.0) == [-40, 0]
    assert see(6, 0.0, 40.0) == [-40, 0], "no room"
    tracker.make_room(seen_at(40.0))
    assert see(7, 0.0, 40.0) == [0, 40]
    tracker.drop_all()
    assert see(8) == []


def test_a_fainter_target_pointed_at_is_taken_though_the_one_that_gives_way_is_seen_too() -> None:
    tracker, by_hand, held = Tracker(1, Mount(np.eye(3), np.zeros(3))), ByHand(), seen_at(0.0)
    wanted = replace(seen_at(40.0), score=0.6)
    for frame in range(1, 5):
        (before,) = tracker.update(frame * 33_000_000, [held], None, toy_scene.K, SIZE_WH)
    by_hand.take(TrackBox((0.0, 0.0, 0.1, 0.1)), 150_000_000)
    by_hand.found(wanted)
    tracker.make_room(wanted)
    tracks = tracker.update(165_000_000, [held, wanted], None, toy_scene.K, SIZE_WH)
    by_hand.settle(tracks)
    assert [round(float(t.t_cam_target_m[0])) for t in (before, *tracks)] == [0, 40]
    assert (by_hand.chosen_id, by_hand.news()) == (tracks[0].track_id, [f"target {tracks[0].track_id} chosen"])


def test_who_gives_way_to_a_target_pointed_at_is_missed_or_not_yet_sure_or_faint() -> None:
    def kept(*seen: tuple[float, float, int]) -> list[int]:
        """Where the targets are that stay, of those seen at x in metres with a score from a frame on."""
        tracker = Tracker(len(seen), Mount(np.eye(3), np.zeros(3)))
        for frame in range(1, 6):
            here = [replace(seen_at(x), score=score) for x, score, first in seen if frame >= first]
            tracker.update(frame * 33_000_000, here, None, toy_scene.K, SIZE_WH)
        tracker.make_room(seen_at(80.0))
        expected = tracker.predict(200_000_000, None, toy_scene.K, (4000, 3000))
        return sorted(round(float(track.t_cam_target_m[0])) for track in expected)

    assert kept((-40.0, 0.9, 1), (0.0, 0.7, 1), (40.0, 0.8, 1)) == [-40, 40], "the faintest goes"
    assert kept((-40.0, 0.7, 1), (0.0, 0.9, 5), (40.0, 0.8, 1)) == [-40, 40], "the one just begun goes"


def test_the_choice_ends_with_its_target_though_another_has_its_number_at_once() -> None:
    by_hand, first = ByHand(), track(1, born_ns=0)
    by_hand.take(SelectTarget(0), 0)
    by_hand.settle([first])
    assert by_hand.chosen_id == 0
    by_hand.settle([track(1)])
    assert by_hand.chosen_id is None


def test_a_target_found_where_pointed_that_got_no_track_chooses_no_other() -> None:
    by_hand, elsewhere = ByHand(), track(0, box_xyxy_px=np.array([700.0, 300.0, 760.0, 330.0]))
    by_hand.take(TrackBox((0.0, 0.0, 0.1, 0.1)), 0)
    by_hand.found(seen_at(0.0))
    by_hand.settle([elsewhere])
    assert (by_hand.chosen_id, by_hand.news()) == (None, [])
    assert by_hand.box_xyxy_px(1, SIZE_WH, []) is not None, "the look goes on"
    by_hand.found(seen_at(0.0))
    by_hand.settle([elsewhere, track(0, track_id=1, box_xyxy_px=seen_at(0.0).box_xyxy_px + 2.0)])
    assert by_hand.chosen_id == 1
    assert by_hand.box_xyxy_px(2, SIZE_WH, []) is None


def test_what_was_pointed_at_before_the_frames_stopped_is_not_looked_for_when_they_come_again() -> None:
    requests = RequestQueue()
    try:
        clock.step_to(0)
        for request in (TrackBox((0.0, 0.0, 0.1, 0.1)), SelectTarget(1), StopTracking()):
            assert requests.put(request)
        clock.step_to(POINTED_AGE_MAX_NS + 1)
        assert requests.put(SelectTarget(2))
        assert requests.take() == [StopTracking(), SelectTarget(2)]
        assert [requests.too_late(), requests.too_late()] == [2, 0]
        assert [requests.put(SelectTarget(1)) for _ in range(WAITING_MAX + 1)] == [True] * WAITING_MAX + [False]
        clock.step_to(2 * (POINTED_AGE_MAX_NS + 1))
        assert requests.put(SelectTarget(2)), "those that are too old keep no place"
        assert requests.take() == [SelectTarget(2)]
        assert requests.too_late() == WAITING_MAX
    finally:
        clock.run_freely()
