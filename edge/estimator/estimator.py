"""The estimator's two stages: acquire on the whole frame, track in windows of its native pixels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from edge.estimator.decode import decode, distinct, nearest_expected, of_two_looks
from edge.estimator.lens import lens_of
from edge.estimator.model import Model, Peaks
from edge.estimator.window import cut, fit_frame, window_around
from edge.types import Array, Estimate, Frame


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

    def acquire(self, frame: Frame, known_boxes: Sequence[Array] = (), twice: bool = True) -> list[Estimate]:
        """Targets anywhere in the frame that lie on none of `known_boxes` (box_xyxy_px), best first.

        Each is refined in a track window of the same frame; one the window does not confirm is no target. That window
        lies as the whole frame has the target, coarsely; if `twice`, it is looked at again, as the window has it.
        """
        found = self._whole(frame, known_boxes, self.model.run, self.refused)
        if not self.has_track_stage:
            return found
        refined = [estimate for estimate in self.track(frame, [f.box_xyxy_px for f in found]) if estimate is not None]
        self.refused["unconfirmed"] += len(found) - len(refined)
        if not twice:
            return distinct(refined, known_boxes)
        again = self.track(frame, [estimate.box_xyxy_px for estimate in refined])
        both = [
            first if second is None else of_two_looks(first, second)
            for first, second in zip(refined, again, strict=True)
        ]
        return distinct(both, known_boxes)

    def anywhere(self, frame: Frame, known_boxes: Sequence[Array], refused: Counter[str]) -> list[Estimate]:
        """The same as far as the whole frame alone tells, unconfirmed; refusals are added to `refused`.

        It touches nothing of the estimator's own, so another thread than the loop's may call it.
        """
        return self._whole(frame, known_boxes, self.model.infer, refused)

    def _whole(
        self,
        frame: Frame,
        known_boxes: Sequence[Array],
        run: Callable[[NDArray[np.uint8], Array], Peaks],
        refused: Counter[str],
    ) -> list[Estimate]:
        contract = self.model.contract
        lens = lens_of(frame.K, frame.distortion)
        frame_wh = (frame.image_bgr.shape[1], frame.image_bgr.shape[0])
        image, pixel_map = fit_frame(frame.image_bgr, contract.acquire_size_wh, contract.acquire_fit, lens)
        K = pixel_map.intrinsics(frame.K)
        found = decode(run(image[None], K[None]), 0, pixel_map, K, contract, "acquire", refused, frame_wh)
        return distinct(found, known_boxes)[: max(self._max_targets - len(known_boxes), 0)]

    def track(self, frame: Frame, boxes_xyxy_px: Sequence[Array]) -> list[Estimate | None]:
        """For each expected box the target in the window around it, or None. One inference for all windows."""
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
        K = np.stack([pixel_map.intrinsics(frame.K) for pixel_map in maps])
        peaks = self.model.run(np.stack([cut(frame.image_bgr, window, size_wh, lens) for window in windows]), K)
        found = [
            nearest_expected(
                decode(peaks, i, pixel_map, K[i], contract, "track", self.refused, frame_wh), boxes_xyxy_px[i]
            )
            for i, pixel_map in enumerate(maps)
        ]
        # Two windows may see the same aircraft; the stronger sight of it counts.
        kept = {id(e) for e in distinct(sorted(filter(None, found), key=lambda e: -e.score))}
        return [estimate if id(estimate) in kept else None for estimate in found]
