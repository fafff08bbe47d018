"""What makes a target of a place in the whole frame: the looks at it, plain and mirrored, and what each may say."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.estimator.estimator import Estimator
from edge.estimator.model import Peaks, load_model
from edge.estimator.pace import Pace, looked_at_twice
from edge.types import Frame, FrameMeta, TrackState
from msgs.contract import ModelContract

from .toy_model import CONTRACT
from .toy_scene import SIZE_WH, K, draw, draw_faint

RANGE_M = 250.0
TARGET_PX = np.array([700.0, 500.0])
OTHER_PX = np.array([760.0, 500.0])
CLOUD_PX = np.array([1400.0, 300.0])
SIZE_PX = np.array([50.0, 20.0])
# Brighter to the right, so that an image tells whether it is mirrored.
SLOPE = np.broadcast_to(np.linspace(0, 255, SIZE_WH[0])[None, :, None], (SIZE_WH[1], SIZE_WH[0], 3)).astype(np.uint8)


def answer(score: float, at_px: np.ndarray = TARGET_PX, range_m: float = RANGE_M) -> tuple[float, np.ndarray, float]:
    return score, at_px, range_m


@dataclass
class Scripted:
    """Stands in for a network whose every answer is known: what it says of whole frames and of windows, plain and
    mirrored, is a script; where that lies in an image, the image's own K tells."""

    script: dict[str, list[tuple[float, np.ndarray, float]]]  # the last answer of a kind stays
    contract: ModelContract
    asked: list[str] = field(default_factory=list)

    def run(self, images: np.ndarray, K_images: np.ndarray) -> Peaks:
        of_each = [self._one(image, K_image) for image, K_image in zip(images, K_images, strict=True)]
        return Peaks(*(np.asarray(value, dtype=np.float32)[:, None] for value in zip(*of_each, strict=True)))

    def _one(self, image: np.ndarray, K_image: np.ndarray) -> tuple[Any, ...]:
        left, right = image[:, image.shape[1] // 3].mean(), image[:, 2 * image.shape[1] // 3].mean()
        whole = image.shape[1::-1] == self.contract.acquire_size_wh
        kind = "whole" if whole else "plain" if left < right else "mirrored"
        self.asked.append(kind)
        answers = self.script[kind]
        score, at_px, range_m = answers.pop(0) if len(answers) > 1 else answers[0]
        ray = np.linalg.inv(K) @ [*at_px, 1.0]
        if kind == "mirrored":
            ray[0] *= -1
        center = (K_image @ ray)[:2]
        size = SIZE_PX * K_image[0, 0] / K[0, 0]
        R = np.array([[0, 1, 0], [0, 0, 1], [1, 0, 0]])  # from behind, the same when mirrored
        return score, center, size, center, range_m * ray / np.linalg.norm(ray), R, np.full(6, 0.05)

    infer = run


def scripted(
    whole: list[Any], plain: list[Any], mirrored: list[Any], **changes: object
) -> tuple[Estimator, Scripted, Frame]:
    contract = ModelContract(**(CONTRACT | {"acquire_score_min": 0.7, "track_score_min": 0.3} | changes))
    model = Scripted({"whole": whole, "plain": plain, "mirrored": mirrored}, contract)
    return Estimator(model), model, Frame(FrameMeta(0, 0, 0), SLOPE, K)  # type: ignore[arg-type]


def test_a_place_is_looked_at_once_then_plain_and_mirrored_and_a_track_by_turns() -> None:
    coarse = answer(0.9, range_m=1.2 * RANGE_M)
    estimator, model, frame = scripted([answer(0.9)], [coarse, answer(0.9)], [answer(0.9)])
    (found,) = estimator.acquire(frame)
    assert model.asked == ["whole", "plain", "plain", "mirrored"]
    assert np.linalg.norm(found.t_cam_target_m) == pytest.approx(RANGE_M, rel=1e-4), "as the finer two have it"
    np.testing.assert_allclose(found.box_xyxy_px, [*(TARGET_PX - SIZE_PX / 2), *(TARGET_PX + SIZE_PX / 2)], atol=0.01)
    model.asked.clear()
    estimator.acquire(frame, thrice=False)
    assert model.asked == ["whole", "plain"]
    model.asked.clear()
    for _ in range(4):
        assert estimator.track(frame, [found.box_xyxy_px]) != [None]
    assert model.asked == ["plain", "mirrored", "plain", "mirrored"]


def test_a_track_that_cannot_wait_is_looked_at_both_ways_in_one_frame() -> None:
    estimator, model, frame = scripted([], [answer(0.9, range_m=200.0)], [answer(0.8, range_m=242.0)])
    box = np.concatenate([TARGET_PX - SIZE_PX / 2, TARGET_PX + SIZE_PX / 2])
    for _ in range(2):  # whichever way the turn is
        (both,) = estimator.track(frame, [box], [True])
        assert both is not None
        assert np.linalg.norm(both.t_cam_target_m) == pytest.approx(220.0, rel=1e-3)
    assert sorted(model.asked) == ["mirrored", "mirrored", "plain", "plain"]
    estimator.track(frame, [box], [False])
    assert len(model.asked) == 5


def test_a_target_that_every_larger_window_cuts_again_is_looked_at_three_times() -> None:
    class Cut(Scripted):
        """Of whatever window it is shown, it says that the target reaches beyond the left edge."""

        def _one(self, image: np.ndarray, K_image: np.ndarray) -> tuple[Any, ...]:
            score, _, _, _, *pose = super()._one(image, K_image)
            at_edge = np.array([60.0, 0.5 * image.shape[0]])
            return score, at_edge, np.array([200.0, 100.0]), at_edge, *pose

    _, model, frame = scripted([], [answer(0.9)], [answer(0.9)])
    cut = Cut(model.script, model.contract)
    box = np.array([1875.0, 490.0, 1905.0, 502.0])
    assert Estimator(cut).track(frame, [box]) != [None]  # type: ignore[arg-type]
    assert cut.asked == ["plain"] * 3


@pytest.mark.parametrize(
    ("plain", "mirrored", "range_m"),
    [
        (answer(0.9, range_m=200.0), answer(0.1, range_m=300.0), 200.0),
        (answer(0.1, range_m=200.0), answer(0.9, range_m=300.0), 300.0),
        (answer(0.5, range_m=200.0), answer(0.9, OTHER_PX, 300.0), 300.0),  # two aircraft: the surer sight
        (answer(0.1), answer(0.1), None),
    ],
)
def test_what_one_of_two_looks_does_not_show_the_other_may(plain: Any, mirrored: Any, range_m: float | None) -> None:
    estimator, _, frame = scripted([], [plain], [mirrored])
    box = np.concatenate([TARGET_PX - SIZE_PX / 2, TARGET_PX + SIZE_PX / 2])
    (found,) = estimator.track(frame, [box], [True])
    if range_m is None:
        assert found is None
    else:
        assert found is not None
        assert np.linalg.norm(found.t_cam_target_m) == pytest.approx(range_m, rel=1e-6)


def test_a_camera_of_few_frames_a_second_leaves_time_for_both() -> None:
    pace = Pace()
    assert not pace.unhurried(FrameMeta(7, 1_000_000_000, 0))  # who knows
    assert pace.unhurried(FrameMeta(8, 1_100_000_000, 0))
    assert not pace.unhurried(FrameMeta(9, 1_133_000_000, 0))
    # A camera of thirty a second, of which two frames in three were dropped, is still in a hurry.
    assert not pace.unhurried(FrameMeta(12, 1_233_000_000, 0))


@pytest.mark.parametrize(("look", "in_whole", "in_tile"), [(0.75, 1, 0), (0.9, 1, 1), (0.5, 0, 0)])
def test_what_one_of_many_tiles_shows_has_to_be_surer(look: float, in_whole: int, in_tile: int) -> None:
    """Each tile may show something that is none: looking into four finds four times as much of that."""
    for of, targets in ((0, in_whole), (1, in_tile)):
        estimator, _, frame = scripted([answer(0.6)], [answer(look)], [answer(look)], acquire_size_wh=(768, 448))
        assert len(estimator.regions(frame)) == 5
        assert len(estimator.acquire(frame, regions=estimator.regions(frame)[of : of + 1])) == targets


def test_what_one_region_shows_is_not_looked_at_again_in_the_next() -> None:
    estimator, model, frame = scripted([answer(0.01), answer(0.95)], [answer(0.99)], [answer(0.99)])
    regions = estimator.regions(frame)
    assert len(estimator.acquire(frame, regions=regions[:4])) == 1
    assert model.asked == ["whole", "whole", "plain", "plain", "mirrored", "whole", "whole"], "the second shows it"


@pytest.mark.parametrize("unhurried", [True, False])
def test_what_few_frames_have_shown_is_looked_at_both_ways_at_any_rate(unhurried: bool) -> None:
    assert looked_at_twice(TrackState.TENTATIVE, unhurried)
    assert looked_at_twice(TrackState.CONFIRMED, unhurried) is unhurried


@pytest.mark.parametrize(
    ("place", "look", "targets", "unconfirmed"),
    [
        (0.5, 0.9, 1, 0),  # windows show what the whole frame is not sure of
        (0.6, 0.7, 1, 0),  # neither is sure, both together are
        (0.6, 0.5, 0, 0),
        (0.9, 0.25, 1, 0),  # less than a track needs, but the whole frame is sure
        (0.9, 0.15, 0, 1),  # the whole frame is sure, and wrong
        (0.03, 0.999, 1, 0),  # hardly a hint in the whole frame, but the windows leave no doubt
        (0.03, 0.98, 0, 0),
        (0.015, 0.999, 0, 0),  # nobody looks
    ],
)
def test_the_whole_frame_and_its_windows_confirm_a_target_together(
    place: float, look: float, targets: int, unconfirmed: int
) -> None:
    for thrice in (True, False):
        estimator, model, frame = scripted([answer(place)], [answer(look)], [answer(look)])
        found = estimator.acquire(frame, thrice=thrice)
        assert len(found) == targets
        assert [estimate.score for estimate in found] == [pytest.approx(look)] * targets
        assert estimator.refused["unconfirmed"] == unconfirmed
        assert ("plain" in model.asked) == (place > 0.02)


def test_what_the_finer_windows_do_not_show_is_no_target_however_sure_the_first_was() -> None:
    estimator, _, frame = scripted([answer(0.99)], [answer(0.99), answer(0.0)], [answer(0.0)])
    assert estimator.acquire(frame) == []
    assert estimator.refused["unconfirmed"] == 1


class TwoPlaces(Scripted):
    """The whole frame shows two, the first the likelier."""

    def run(self, images: np.ndarray, K_images: np.ndarray) -> Peaks:
        self.script["whole"] = [answer(0.8, CLOUD_PX), answer(0.6)]
        peaks = super().run(images, K_images)
        if self.asked[-1] != "whole":
            return peaks
        both = zip(vars(peaks).values(), vars(super().run(images, K_images)).values(), strict=True)
        return Peaks(*(np.concatenate(of_both, axis=1) for of_both in both))


@pytest.mark.parametrize("max_targets", [1, 2])
@pytest.mark.parametrize(
    ("plain", "mirrored", "targets"),
    [
        # Nothing where the cloud is, in its window and in the next.
        ([answer(0.0), answer(0.9)], [answer(0.9)], 1),
        # It is an aircraft too, of which the windows are less sure.
        ([answer(0.8, CLOUD_PX), answer(0.95)] * 2, [answer(0.8, CLOUD_PX), answer(0.95)], 2),
    ],
)
def test_where_there_is_room_for_few_what_the_whole_frame_takes_for_likelier_hides_no_surer_target(
    plain: list[Any], mirrored: list[Any], targets: int, max_targets: int
) -> None:
    """Such as a speck of cloud, frame after frame."""
    contract = ModelContract(**(CONTRACT | {"acquire_score_min": 0.7, "track_score_min": 0.3}))
    model = TwoPlaces({"whole": [], "plain": list(plain), "mirrored": list(mirrored)}, contract)
    estimator = Estimator(model, max_targets)  # type: ignore[arg-type]
    found = estimator.acquire(Frame(FrameMeta(0, 0, 0), SLOPE, K))
    assert len(found) == min(targets, max_targets)
    np.testing.assert_allclose(found[0].box_xyxy_px[0], TARGET_PX[0] - SIZE_PX[0] / 2, atol=0.01)


@pytest.mark.parametrize("max_targets", [1, 2])
def test_no_more_targets_are_found_than_there_is_room_for(toy_model: Path, max_targets: int) -> None:
    """One in the whole frame, another in a tile of it."""
    frame = Frame(FrameMeta(0, 0, 0), np.maximum(draw((500.5, 300.5)), draw_faint()), K)
    estimator = Estimator(load_model(toy_model, 1), max_targets)
    assert len(estimator.acquire(frame, regions=estimator.regions(frame))) == max_targets


def test_a_first_look_that_shows_nothing_is_the_last() -> None:
    estimator, model, frame = scripted([answer(0.2)], [answer(0.05)], [answer(0.99)])
    assert estimator.acquire(frame) == []
    assert model.asked == ["whole", "plain"]


def test_one_finer_look_of_two_may_miss_it() -> None:
    estimator, _, frame = scripted([answer(0.95)], [answer(0.95)], [answer(0.0)])
    assert len(estimator.acquire(frame)) == 1
    estimator, _, frame = scripted([answer(0.72)], [answer(0.72)], [answer(0.0)])
    assert estimator.acquire(frame) == []


def test_looks_at_two_aircraft_in_one_window_are_not_made_one() -> None:
    estimator, _, frame = scripted([answer(0.9)], [answer(0.9)], [answer(0.95, OTHER_PX, 2 * RANGE_M)])
    (found,) = estimator.acquire(frame)
    assert np.linalg.norm(found.t_cam_target_m) == pytest.approx(RANGE_M, rel=1e-4)
    np.testing.assert_allclose(found.box_xyxy_px[0], TARGET_PX[0] - SIZE_PX[0] / 2, atol=0.01)


def test_a_place_of_an_earlier_frame_needs_a_look_that_goes_with_it() -> None:
    estimator, _, frame = scripted([answer(0.3)], [answer(0.4)], [answer(0.9)])
    (place,) = estimator.anywhere(frame, [], estimator.refused)
    weak, strong = (estimator.track(frame, [place.box_xyxy_px])[0] for _ in range(2))
    assert weak is not None
    assert strong is not None
    assert not estimator.confirms(place, [weak])  # though it would do for a track
    assert estimator.confirms(place, [strong])


def test_a_model_that_asks_for_less_is_looked_at_for_less() -> None:
    estimator, model, frame = scripted(
        [answer(0.05)], [answer(0.6)], [answer(0.6)], acquire_score_min=0.04, track_score_min=0.04
    )
    assert len(estimator.acquire(frame)) == 1
    assert "plain" in model.asked
