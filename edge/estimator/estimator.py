"""The estimator's two stages: acquire on the downscaled frame or its tiles, track in windows of its native pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge.estimator.decode import Shown, decode, distinct, grown, nearest_expected
from edge.estimator.given_size import TargetSize
from edge.estimator.lens import lens_of
from edge.estimator.looks import confirmed, mirrored, of_looks, of_one_target, unmirrored
from edge.estimator.model import Model, Peaks
from edge.estimator.regions import Region, tiles, whole
from edge.estimator.upright import quarter_turns, turned, turned_back
from edge.estimator.window import cut, fit_frame, pixel_aspect, window_around
from edge.types import Array, Estimate, Frame

WORTH_A_LOOK = 0.02  # a place with a lower probability is not examined in a window
FAINTEST = 0.02  # lowest score of a window at a place, also if it detects nothing
# Places and targets examined in one frame, even if there is room for fewer targets: the likeliest place may turn out to
# be false in frame after frame.
PLACES_MOST = 4
LOOKS_MOST = 3  # evaluations of one target, each in a larger window, until no window's edge cuts it


class Estimator:
    """Poses of the targets in single frames. Between frames it keeps only whether the last windows were evaluated
    mirrored, and the counts of rejections. `target_size`, if known, may be changed between frames."""

    def __init__(self, model: Model, max_targets: int = 4) -> None:
        self.model = model
        self.target_size: TargetSize | None = None
        self.refused: Counter[str] = Counter()
        self._max_targets = max_targets
        self._mirror = True

    @property
    def has_track_stage(self) -> bool:
        return self.model.contract.track_size_wh is not None

    def warm_up(self, frame: Frame) -> None:
        """Run both stages on `frame`, an empty one of the camera's size, so that the first real frame is fast."""
        width, height = frame.size_wh
        self.acquire(frame)
        box = np.array([0.4 * width, 0.4 * height, 0.6 * width, 0.6 * height])
        if self.has_track_stage:
            for _ in range(2):  # plain and mirrored
                self.track(frame, [box])
            self._look_both_ways(frame, [box], FAINTEST)
        self.refused.clear()

    def regions(self, frame: Frame) -> tuple[Region, ...]:
        """What there is to search in a frame: first the whole of it, then tiles, if there is a track stage that can
        confirm what they show."""
        lens = lens_of(frame.K, frame.distortion)
        finer = tiles(frame.size_wh, self.model.contract.acquire_size_wh, lens, pixel_aspect(frame.K))
        return whole(frame.size_wh, lens), *(finer if self.has_track_stage else ())

    def acquire(self, frame: Frame, thrice: bool = True, regions: Sequence[Region] = ()) -> list[Estimate]:
        """Targets in the whole frame, or in some `regions` of it, without those that overlap one of a region before;
        best first in each.

        Each is evaluated in a track window of the same frame, placed by the coarse detection; if `thrice`, twice more
        in a window placed by the first result, plain and mirrored. A detection that the windows do not show, or do not
        confirm together, is dropped.
        """
        found: list[Estimate] = []
        for region in regions or self.regions(frame)[:1]:
            found += self._acquire_in(region, frame, [estimate.box_xyxy_px for estimate in found], thrice)
        return found

    def _acquire_in(self, region: Region, frame: Frame, known_boxes: Sequence[Array], thrice: bool) -> list[Estimate]:
        room = max(self._max_targets - len(known_boxes), 0)
        if not self.has_track_stage:
            least = self.model.contract.acquire_score_min
            return self._search(region, frame, known_boxes, least, self.model.run, self.refused)[:room]
        places = self._search(region, frame, known_boxes, self._worth_a_look, self.model.run, self.refused)
        faintest = min(FAINTEST, self.model.contract.track_score_min)
        firsts = _each_once(self._look(frame, [place.box_xyxy_px for place in places], faintest))
        seen = [
            (place, first)
            for place, first in zip(places, firsts, strict=True)
            if first is not None and confirmed(place.score, [first.score]) >= self._worth_a_look
        ]
        if thrice:
            boxes = [first.box_xyxy_px for _, first in seen]
            finer = self._look_both_ways(frame, boxes, faintest, looks_left=1)
            looks = [self._together(*one) for one in zip(seen, *finer, strict=True)]
        else:
            looks = [first if self.confirms(place, [first]) else None for place, first in seen]
        found = [look for look in looks if look is not None]
        likely = sum(place.score >= self.model.contract.acquire_score_min for place in places)
        self.refused["unconfirmed"] += max(likely - len(found), 0)
        return distinct(sorted(found, key=lambda estimate: -estimate.score), known_boxes)[:room]

    def _together(self, seen: tuple[Estimate, Estimate], *finer: Estimate | None) -> Estimate | None:
        """Combine a place, its first window and two finer ones; None: no target."""
        place, first = seen
        looks = [look for look in finer if look is not None and of_one_target(look, first)]
        if not looks or not self.confirms(place, [first, *looks], missed=len(finer) - len(looks)):
            return None
        return of_looks(looks, [first])

    def confirms(self, place: Estimate, looks: Sequence[Estimate], missed: int = 0) -> bool:
        """Whether windows confirm a place found in this frame or an earlier one; `missed`: number of windows without a
        detection."""
        scores = [*(look.score for look in looks), *[FAINTEST] * missed]
        return confirmed(place.score, scores) >= self.model.contract.acquire_score_min

    def anywhere(
        self, frame: Frame, known_boxes: Sequence[Array], refused: Counter[str], region: Region | None = None
    ) -> list[Estimate]:
        """Places worth examining in a window, from the whole frame, or a `region` of it, alone; rejections are counted
        in `refused`.

        Changes no state of the estimator, so it may be called from a thread other than the loop's.
        """
        region = region or self.regions(frame)[0]
        return self._search(region, frame, known_boxes, self._worth_a_look, self.model.infer, refused)

    @property
    def _worth_a_look(self) -> float:
        return min(WORTH_A_LOOK, self.model.contract.acquire_score_min)

    def _search(
        self,
        region: Region,
        frame: Frame,
        known_boxes: Sequence[Array],
        score_min: float,
        run: Callable[[NDArray[np.uint8], Array], Peaks],
        refused: Counter[str],
    ) -> list[Estimate]:
        contract = self.model.contract
        size_wh, fit = contract.acquire_size_wh, contract.acquire_fit
        lens = lens_of(frame.K, frame.distortion)
        image, pixel_map = fit_frame(frame.image_bgr, size_wh, fit, lens, pixel_aspect(frame.K), region.window)
        shown = Shown(pixel_map, pixel_map.intrinsics(frame.K), size_wh, frame.size_wh, frame.up_cam, frame.own_parts)
        turns = quarter_turns(frame.up_cam)
        peaks = turned_back(run(*turned(image[None], shown.K[None], turns)), size_wh, turns)
        least = region.score_of(score_min)
        found = decode(peaks, 0, shown, contract, "acquire", least, refused, self.target_size)
        places = [replace(place, score=region.probability(place.score)) for place in distinct(found, known_boxes)]
        return places[: max(max(self._max_targets, PLACES_MOST) - len(known_boxes), 1)]

    def track(self, frame: Frame, boxes_xyxy_px: Sequence[Array], twice: Sequence[bool] = ()) -> list[Estimate | None]:
        """For each expected box the target in the window around it, or None. One run of the model for all windows.

        Every other frame is evaluated mirrored, because the network's errors on an image and on its mirror image
        differ. `twice`, if given: which boxes are evaluated both ways in this frame.
        """
        self._mirror = not self._mirror
        again = [i for i, both in enumerate(twice) if both]
        boxes = [*boxes_xyxy_px, *(boxes_xyxy_px[i] for i in again)]
        count = len(boxes_xyxy_px)
        mirrors = [self._mirror] * count + [not self._mirror] * len(again)
        found = self._look(frame, boxes, self.model.contract.track_score_min, mirrors)
        looks, others = _each_once(found[:count]), _each_once(found[count:])
        for i, other in zip(again, others, strict=True):
            looks[i] = _of_either(looks[i], other)
        return _each_once(looks)

    def _look_both_ways(
        self, frame: Frame, boxes_xyxy_px: Sequence[Array], score_min: float, looks_left: int = LOOKS_MOST
    ) -> tuple[list[Estimate | None], list[Estimate | None]]:
        """The results of the plain windows and those of the mirrored ones; one inference for all."""
        count = len(boxes_xyxy_px)
        mirrors = [False] * count + [True] * count
        found = self._look(frame, [*boxes_xyxy_px, *boxes_xyxy_px], score_min, mirrors, looks_left)
        return _each_once(found[:count]), _each_once(found[count:])

    def _look(
        self,
        frame: Frame,
        boxes_xyxy_px: Sequence[Array],
        score_min: float,
        mirrors: Sequence[bool] = (),
        looks_left: int = LOOKS_MOST,
        expected: Sequence[Array] = (),
    ) -> list[Estimate | None]:
        """For each box the target in the window around it; `mirrors`, if given: which windows are evaluated mirrored;
        `expected`, if given: the targets' own boxes, where windows are larger.

        A target cut by a window's edge is evaluated again in a larger window; only that result counts, even if None.
        """
        contract = self.model.contract
        if contract.track_size_wh is None:
            raise ValueError("this model has no track stage")
        if not boxes_xyxy_px:
            return []
        expected = expected or boxes_xyxy_px
        size_wh = contract.track_size_wh
        frame_wh = frame.size_wh
        lens = lens_of(frame.K, frame.distortion)
        scale, aspect = contract.track_window_scale, pixel_aspect(frame.K)
        windows = [window_around(box, scale, size_wh, frame_wh, lens, aspect) for box in boxes_xyxy_px]
        maps = [window.pixel_map(size_wh, lens) for window in windows]
        shown = [Shown(one, one.intrinsics(frame.K), size_wh, frame_wh, frame.up_cam, frame.own_parts) for one in maps]
        pixels = {window: cut(frame.image_bgr, window, size_wh, lens) for window in dict.fromkeys(windows)}
        turns = quarter_turns(frame.up_cam)
        images, K = turned(np.stack([pixels[window] for window in windows]), np.stack([one.K for one in shown]), turns)
        flipped = np.array(mirrors, dtype=bool) if mirrors else np.zeros(len(images), dtype=bool)
        peaks = unmirrored(self.model.run(*mirrored(images, K, flipped)), images.shape[2], flipped)
        peaks = turned_back(peaks, size_wh, turns)
        decoded = [
            decode(peaks, i, one, contract, "track", score_min, self.refused, self.target_size, box)
            for i, (one, box) in enumerate(zip(shown, expected, strict=True))
        ]
        found = [nearest_expected(estimates, box) for estimates, box in zip(decoded, boxes_xyxy_px, strict=True)]
        beyond = {
            i: box
            for i, (estimate, one) in enumerate(zip(found, shown, strict=True))
            if estimate is not None and (box := grown(estimate.box_xyxy_px, one)) is not None
        }
        if beyond and looks_left > 1:
            again = self._look(
                frame,
                list(beyond.values()),
                score_min,
                flipped[list(beyond)].tolist(),
                looks_left - 1,
                [expected[i] for i in beyond],
            )
            for i, estimate in zip(beyond, again, strict=True):
                found[i] = estimate
        return found


def _of_either(one: Estimate | None, other: Estimate | None) -> Estimate | None:
    """The result of two evaluations of one place: combined if they show one aircraft, else the one of higher score."""
    looks = sorted(filter(None, (one, other)), key=lambda look: -look.score)
    if not looks:
        return None
    return of_looks([look for look in looks if look is looks[0] or of_one_target(look, looks[0])])


def _each_once(found: Sequence[Estimate | None]) -> list[Estimate | None]:
    """Where two windows see the same aircraft, keep only the detection of higher score; the others become None."""
    kept = {id(e) for e in distinct(sorted(filter(None, found), key=lambda e: -e.score))}
    return [estimate if id(estimate) in kept else None for estimate in found]
