"""A small stand-in for the renderer: a flat-shaded aircraft of three plates, drawn in NumPy with exact labels."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from msgs.geometry import R_from_euler
from sim_replay.sample import SampleBatch

# Plates in body axes (FRD), metres: wing, fuselage, fin; and their BGR colours.
PLATES = (
    (np.array([[1.0, -6, 0], [1.0, 6, 0], [-1.0, 6, 0], [-1.0, -6, 0]]), (60, 60, 200)),
    (np.array([[5.0, -0.5, 0.1], [5.0, 0.5, 0.1], [-5.0, 0.5, 0.1], [-5.0, -0.5, 0.1]]), (200, 80, 40)),
    (np.array([[-3.0, 0, 0], [-5.0, 0, 0], [-5.0, 0, -2.5], [-4.0, 0, -2.5]]), (40, 180, 60)),
)
DIAMETER_M = 12.0
R_CAM_NED_NORTH = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # a camera that looks north, upright


class PlateSampler:
    """Sample i is a pure function of (seed, i, size), like sim_replay.sampler.WindowSampler's."""

    def __init__(self, seed: int, size_px: int, empty_share: float = 0.15) -> None:
        self.seed, self.size_px, self.empty_share = seed, size_px, empty_share

    def batch(self, first_index: int, count: int) -> SampleBatch:
        columns = zip(*(self._one(i) for i in range(first_index, first_index + count)), strict=True)
        image, K, present, R, t, box, mask, noc = (np.stack(column) for column in columns)
        ids = np.where(present, 0, -1).astype(np.int32)
        diameter = np.where(present, DIAMETER_M, 0).astype(np.float32)
        return SampleBatch(image, K, present, R, t, box, mask, noc, ids, diameter)

    def _one(self, index: int) -> tuple:
        rng = np.random.default_rng((self.seed, index))
        side = self.size_px
        f = rng.uniform(10, 25) * side
        K = np.array([[f, 0, side / 2 + rng.normal() * side], [0, f, side / 2 + rng.normal() * side], [0, 0, 1]])
        image = np.full((side, side, 3), rng.uniform(120, 230, 3), np.uint8)
        image = (image + rng.normal(0, 6, image.shape)).clip(0, 255).astype(np.uint8)
        mask, noc = np.zeros((side, side), bool), np.zeros((side, side, 3), np.float16)
        if rng.random() < self.empty_share:
            zero = np.zeros(3, np.float32)
            return (
                image,
                K.astype(np.float32),
                np.False_,
                np.eye(3, dtype=np.float32),
                zero,
                np.zeros(4, np.float32),
                mask,
                noc,
            )
        roll, pitch, yaw = rng.normal(0, 0.4), rng.normal(0, 0.1), rng.uniform(-np.pi, np.pi)
        tilt = R_from_euler(0.0, rng.normal(0, 0.3), 0.0)
        R = R_CAM_NED_NORTH @ tilt @ R_from_euler(roll, pitch, yaw)
        Z = f * DIAMETER_M / (side * rng.uniform(0.4, 0.75))
        aim = (side - 1) / 2 + rng.uniform(-0.12, 0.12, 2) * side
        t = np.array([(aim[0] - K[0, 2]) / f, (aim[1] - K[1, 2]) / f, 1.0]) * Z
        self._draw(image, mask, noc, K, R, t)
        rows, columns = np.nonzero(mask)
        box = np.array([columns.min() - 0.5, rows.min() - 0.5, columns.max() + 0.5, rows.max() + 0.5], np.float32)
        return image, K.astype(np.float32), np.True_, R.astype(np.float32), t.astype(np.float32), box, mask, noc

    @staticmethod
    def _draw(image, mask, noc, K, R, t) -> None:
        """Paint the plates far to near; object coordinates from each pixel's ray through its plate."""
        rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
        rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1], np.ones(rows.shape)], -1)
        for points_body, colour in sorted(PLATES, key=lambda plate: -(R @ plate[0].mean(0))[2]):
            points = points_body @ R.T + t
            pixels = points[:, :2] / points[:, 2:] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
            drawn = np.zeros(mask.shape, np.uint8)
            cv2.fillPoly(drawn, [np.round(pixels).astype(np.int32)], 1)
            normal = np.cross(points[1] - points[0], points[2] - points[0])
            normal /= np.linalg.norm(normal)
            on = drawn.astype(bool)
            depth = (normal @ points[0]) / (rays[on] @ normal)
            body = np.clip((rays[on] * depth[:, None] - t) @ R, -DIAMETER_M, DIAMETER_M)
            image[on] = np.array(colour) * (0.5 + 0.5 * abs(normal[1]))
            mask |= on
            noc[on] = body / DIAMETER_M


def opener(seed: int, size_px: int) -> partial:
    """(seed, size_px) to a picklable opener, as trainer.train.run_training takes it."""
    return partial(PlateSampler, seed, size_px)
