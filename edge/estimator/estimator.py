"""The estimator's two stages: acquire on the whole frame, track in windows of its native pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge.estimator.decode import View, decode, distinct, grown, nearest_expected
from edge.estimator.lens import lens_of
from edge.estimator.looks import confirmed, mirrored, of_looks, unmirrored
from edge.estimator.model import Model, Peaks
from edge.estimator.window import cut, fit_frame, window_around
from edge.types import Array, Estimate, Frame

WORTH_A_LOOK = 0.1  # where the whole frame has a target less probably, no window is spent on it
LOOKS_MOST = 3  # in larger windows each, until no window's edge cuts the target
FAINTEST = 0.02  # the least that a window says of a place that the whole frame has named


class Estimator:
    """Poses of the targets in single frames; it remembers nothing between them but counts of what it refused."""

    def __init__(self, model: Model, max_targets: int = 4) -> None:
        self.model = model
        self.refused: Counter[str] = Counter()
        self._max_targets = max_targets

    @property
    def has_track_stage(self) -> bool:
        return self.model.contract.track_size_wh is not None

    def warm_up(self, frame: Frame) -> None:
        """Go through both stages once with an empty frame of the camera's size, so that the first real one is fast."""
        width, height = frame.image_bgr.shape[1], frame.image_bgr.shape[0]
        self.acquire(frame)
        if self.has_track_stage:
            self.track(frame, [np.array([0.4 * width, 0.4 * height, 0.6 * width, 0.6 * height])])
        self.refused.clear()

    def acquire(self, frame: Frame, known_boxes: Sequence[Array] = (), thrice: bool = True) -> list[Estimate]:
        """Targets anywhere in the frame that lie on none of `known_boxes` (box_xyxy_px), best first.

        Each is looked at in a track window of the same frame, which lies as the whole frame has the target: coarsely;
        if `thrice`, twice more in a window that lies as the first has it, plain and mirrored. What the whole frame and
        the windows together do not confirm is no target.
        """
        least = self.model.contract.acquire_score_min
        if not self.has_track_stage:
            return self._whole(frame, known_boxes, least, self.model.run, self.refused)
        places = self._whole(frame, known_boxes, WORTH_A_LOOK, self.model.run, self.refused)
        firsts = self._look(frame, [place.box_xyxy_px for place in places], FAINTEST)
        seen = [
            (place, first)
            for place, first in zip(places, firsts, strict=True)
            if first is not None and confirmed(place.score, [first.score]) >= WORTH_A_LOOK
        ]
        boxes = [first.box_xyxy_px for _, first in seen]
        finer = [self._look(frame, boxes, FAINTEST, mirror) for mirror in ((False, True) if thrice else ())]
        found = []
        for (place, first), *again in zip(seen, *finer, strict=True):
            scores = [FAINTEST if look is None else look.score for look in (first, *again)]
            looks = [look for look in again if look is not None]
            estimate = of_looks(looks, [first]) if looks else first
            found.append(replace(estimate, score=confirmed(place.score, scores)))
        targets = [estimate for estimate in found if estimate.score >= least]
        self.refused["unconfirmed"] += len(places) - len(targets)
        return distinct(sorted(targets, key=lambda estimate: -estimate.score), known_boxes)

    def anywhere(self, frame: Frame, known_boxes: Sequence[Array], refused: Counter[str]) -> list[Estimate]:
        """The same as far as the whole frame alone tells, unconfirmed; refusals are added to `refused`.

        It touches nothing of the estimator's own, so another thread than the loop's may call it.
        """
        return self._whole(frame, known_boxes, self.model.contract.acquire_score_min, self.model.infer, refused)

    def _whole(
        self,
        frame: Frame,
        known_boxes: Sequence[Array],
        score_min: float,
        run: Callable[[NDArray[np.uint8], Array], Peaks],
        refused: Counter[str],
    ) -> list[Estimate]:
        contract = self.model.contract
        lens = lens_of(frame.K, frame.distortion)
        frame_wh = (frame.image_bgr.shape[1], frame.image_bgr.shape[0])
        image, pixel_map = fit_frame(frame.image_bgr, contract.acquire_size_wh, contract.acquire_fit, lens)
        view = View(pixel_map, pixel_map.intrinsics(frame.K), contract.acquire_size_wh, frame_wh)
        found = decode(run(image[None], view.K[None]), 0, view, contract, "acquire", score_min, refused)
        return distinct(found, known_boxes)[: max(self._max_targets - len(known_boxes), 0)]

    def track(self, frame: Frame, boxes_xyxy_px: Sequence[Array]) -> list[Estimate | None]:
        """For each expected box the target in the window around it, or None. One inference for all windows.

        Every other frame is looked at mirrored: what the network gets wrong of one it gets wrong otherwise of the next.
        """
        mirror = frame.meta.sequence % 2 == 1
        return self._look(frame, boxes_xyxy_px, self.model.contract.track_score_min, mirror)

    def _look(
        self,
        frame: Frame,
        boxes_xyxy_px: Sequence[Array],
        score_min: float,
        mirror: bool = False,
        looks_left: int = LOOKS_MOST,
    ) -> list[Estimate | None]:
        """As `track`; what a window's edge cuts is looked at again through a larger one, and is there or is not."""
        contract = self.model.contract
        if contract.track_size_wh is None:
            raise ValueError("this model has no track stage")
        if not boxes_xyxy_px:
            return []
        size_wh = contract.track_size_wh
        frame_wh = (frame.image_bgr.shape[1], frame.image_bgr.shape[0])
        lens = lens_of(frame.K, frame.distortion)
        windows = [window_around(box, contract.track_window_scale, size_wh, frame_wh, lens) for box in boxes_xyxy_px]
        maps = [window.pixel_map(size_wh, lens) for window in windows]
        views = [View(pixel_map, pixel_map.intrinsics(frame.K), size_wh, frame_wh) for pixel_map in maps]
        images = np.stack([cut(frame.image_bgr, window, size_wh, lens) for window in windows])
        K = np.stack([view.K for view in views])
        peaks = unmirrored(self.model.run(*mirrored(images, K)), size_wh[0]) if mirror else self.model.run(images, K)
        found = [
            nearest_expected(decode(peaks, i, view, contract, "track", score_min, self.refused), boxes_xyxy_px[i])
            for i, view in enumerate(views)
        ]
        beyond = {
            i: box
            for i, (estimate, view) in enumerate(zip(found, views, strict=True))
            if estimate is not None and (box := grown(estimate.box_xyxy_px, view)) is not None
        }
        if beyond and looks_left > 1:
            again = self._look(frame, list(beyond.values()), score_min, mirror, looks_left - 1)
            for i, estimate in zip(beyond, again, strict=True):
                found[i] = estimate
        # Two windows may see the same aircraft; the stronger sight of it counts.
        kept = {id(e) for e in distinct(sorted(filter(None, found), key=lambda e: -e.score))}
        return [estimate if id(estimate) in kept else None for estimate in found]
