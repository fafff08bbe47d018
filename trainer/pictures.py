"""Example images of a network's predictions: windows with the body axes of ground truth and estimate."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from trainer.data import TrainingBatch
from trainer.evaluate import Predictions

TRUTH_BGR, ESTIMATE_BGR = (60, 220, 60), (40, 60, 255)
COLUMNS, ROWS = 4, 2
SIDE_PX = 192
# Nose, wing tips and belly in units of half the diameter, body FRD: enough to see the attitude.
STICKS = np.array([[[-0.7, 0, 0], [1.0, 0, 0]], [[0, -1.0, 0], [0, 1.0, 0]], [[0, 0, 0], [0, 0, 0.4]]])


def _draw_sticks(
    picture: NDArray[np.uint8], K: NDArray, R: NDArray, t_m: NDArray, radius_m: float, colour: tuple[int, int, int]
) -> None:
    points = STICKS * radius_m @ np.asarray(R, np.float64).T + np.asarray(t_m, np.float64)
    if not (np.isfinite(points).all() and points[..., 2].min() > 0):
        return
    pixels = points @ np.asarray(K, np.float64).T
    pixels = pixels[..., :2] / pixels[..., 2:]
    for start, stop in np.clip(pixels, -4 * SIDE_PX, 4 * SIDE_PX):
        ends = [tuple(round(v * 16) for v in point) for point in (start, stop)]
        cv2.line(picture, ends[0], ends[1], colour, 1, cv2.LINE_AA, shift=4)
    nose = tuple(round(v * 16) for v in np.clip(pixels[0, 1], -4 * SIDE_PX, 4 * SIDE_PX))
    cv2.circle(picture, nose, 3 * 16, colour, 1, cv2.LINE_AA, shift=4)


def example_sheet(batch: TrainingBatch, predicted: Predictions) -> NDArray[np.uint8]:
    """[2 * 192, 4 * 192, 3] BGR: the batch's first windows, truth in green and estimate in red, a ring at the nose."""
    sheet = np.zeros((ROWS * SIDE_PX, COLUMNS * SIDE_PX, 3), np.uint8)
    for k in range(min(ROWS * COLUMNS, len(batch.present))):
        scale = SIDE_PX / batch.image_bgr.shape[1]
        picture = cv2.resize(batch.image_bgr[k], (SIDE_PX, SIDE_PX), interpolation=cv2.INTER_LINEAR)
        to_sheet = np.array([[scale, 0, (scale - 1) / 2], [0, scale, (scale - 1) / 2], [0, 0, 1]])
        K = to_sheet @ batch.K[k]
        radius_m = float(batch.diameter_m[k]) / 2
        if batch.present[k]:
            _draw_sticks(picture, K, batch.R_cam_target[k], batch.t_cam_target_m[k], radius_m, TRUTH_BGR)
            _draw_sticks(picture, K, predicted.R_cam_target[k], predicted.t_cam_target_m[k], radius_m, ESTIMATE_BGR)
        label = f"score {predicted.score[k]:.2f}"
        cv2.putText(picture, label, (4, SIDE_PX - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1, cv2.LINE_AA)
        row, column = divmod(k, COLUMNS)
        sheet[row * SIDE_PX : (row + 1) * SIDE_PX, column * SIDE_PX : (column + 1) * SIDE_PX] = picture
    return sheet
