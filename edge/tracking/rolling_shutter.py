"""Rolling shutters: poses as they would be had all rows of the picture been exposed at once. Pure.

The rows of a picture are exposed one after the other, and a frame's time is that of its middle row. While the camera
turns, a target in another row was seen from another attitude than the frame's: 10 ms off the middle, at 0.5 rad/s, is
5 mrad, or 1.5 m at 300 m. What target and camera move on meanwhile is left out: 0.3 m at 30 m/s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from edge.types import Array, Estimate, Mount, OwnShip

OwnShipAt = Callable[[int], OwnShip | None]


@dataclass(frozen=True)
class RollingShutter:
    """The exposure of a picture's rows.

    readout_ns: from the first row's exposure to the last one's; negative: the last comes first; 0: all at once.
    """

    readout_ns: int
    mount: Mount

    def at_frame_time(self, estimate: Estimate, own_ship: OwnShip | None, height_px: int, at: OwnShipAt) -> Estimate:
        """The estimate in `cam` as it was turned at the frame's time, that of `own_ship`. Its box stays: that is where
        the target is seen.

        Args:
            at: Own ship at a time, as OwnShipBuffer.at.

        Unchanged without an attitude for both times, in the same axes.
        """
        if self.readout_ns == 0 or own_ship is None:
            return estimate
        row = 0.5 * (estimate.box_xyxy_px[1] + estimate.box_xyxy_px[3])
        share = float(np.clip((row + 0.5) / height_px, 0.0, 1.0)) - 0.5
        seen_from = at(own_ship.time_ns + round(share * self.readout_ns))
        if seen_from is None or seen_from.axes_epoch != own_ship.axes_epoch:
            return estimate
        R_frame_row = self._R_ned_cam(own_ship).T @ self._R_ned_cam(seen_from)
        both = np.kron(np.eye(2), R_frame_row)  # position and rotation
        return replace(
            estimate,
            R_cam_target=R_frame_row @ estimate.R_cam_target,
            t_cam_target_m=R_frame_row @ estimate.t_cam_target_m,
            covariance=both @ estimate.covariance @ both.T,
        )

    def _R_ned_cam(self, own_ship: OwnShip) -> Array:
        R_ned_cam: Array = own_ship.R_ned_body @ own_ship.camera(self.mount).R_body_cam
        return R_ned_cam
