"""What the ground is told of the camera is what its pixels are: OpenCV's lens, with the coefficients of the frame."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from edge.links.zenoh_messages import camera_info
from msgs import cdr

from .reports import make_report, make_track


@pytest.mark.parametrize(
    ("distortion", "model", "count"),
    [
        ((), "plumb_bob", 5),
        ((-0.21, 0.05, 0.001, -0.0005), "plumb_bob", 5),
        ((-0.21, 0.05, 0.001, -0.0005, 0.01), "plumb_bob", 5),
        ((0.3, -0.1, 0.001, 0.0, 0.02, 0.31, -0.08, 0.01), "rational_polynomial", 8),
    ],
)
def test_a_ground_tool_projects_to_the_pixels_of_the_frame(
    distortion: tuple[float, ...], model: str, count: int
) -> None:
    told = make_report(make_track(1_000))
    info = cdr.CameraInfo.decode(camera_info(replace(told, distortion=distortion), 5).encode())
    assert (info.distortion_model, len(info.distortion)) == (model, count)
    points = np.array([[3.0, -2.0, 40.0], [-6.0, 1.0, 50.0]])
    by_info, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), info.K, np.asarray(info.distortion))
    given = np.asarray(distortion) if distortion else None
    by_frame, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), told.K, given)
    np.testing.assert_allclose(by_info, by_frame, atol=1e-9)
