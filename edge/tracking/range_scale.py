"""Robust range: how well the network knows the size, and so the range, of one target, measured on its track. Pure.

An image gives angles; range needs a size, which the network infers, rightly or wrongly, from the aircraft's appearance.
So the log ranges of a track's frames contain two errors. One is nearly the same in all frames, as the target has one
size: averaging does not reduce it, and it is included in the covariance, not estimated. The other differs from frame to
frame, and some frames take the target for an aircraft of quite another size. Against these, frames are compared with
the median of the last frames: a frame is weighted less the further it is from the median (Student's t), and a track far
from it is moved there. The scatter between frames is measured; if it exceeds what the network's sigma implies, both
error variances are scaled up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import fmean, median

import numpy as np

from edge.tracking import so3
from edge.types import Array

FRAME_SHARE = 0.2  # share of the network's log-range variance that differs from frame to frame
FRAME_STD_MIN = 0.01
PRIOR_FRAMES = 4.0  # weight, in frames, of the scatter that the network's sigma implies
MAD_TO_STD = 1.4826  # of a normal distribution
WINDOW_S = 1.5  # over which frames are compared
CLOSING_MAX_PER_S, OPENING_MAX_PER_S = 1.0, 0.4  # limits of range rate over range; faster tracks are not believed
RATE_STD_PER_S = 0.05
SIGMA_MEMORY_S = 1.0
TAIL_DOF = 3.0  # Student's t
ALIKE_S = 0.25  # frames within this time have similar errors: together they count as one
OFF_STD = 3.0  # a track this many standard deviations from the median of its frames is moved to it


@dataclass(frozen=True)
class RangeScale:
    """What is known of one target's log-range errors."""

    sigma: float  # the network's own, smoothed
    recent: tuple[tuple[int, float], ...]  # (time_ns, log range) of the last frames
    frame_variance: float  # of the error that differs between frames: at first from the network, then as measured
    discord: float = 0.0  # mean square deviation of the last frames from their median
    center: float = 0.0  # median of the last frames' log ranges minus the track's log range
    beyond: float = 0.0  # the last frame's log range minus that median

    @classmethod
    def begin(cls, time_ns: int, log_range: float, log_range_variance: float) -> RangeScale:
        """After one frame with the network's variance of log range."""
        return cls(math.sqrt(log_range_variance), ((time_ns, log_range),), FRAME_SHARE * log_range_variance)

    @property
    def common_variance(self) -> float:
        """Variance of the error that all frames share: the network's, scaled up if frames scatter more than it implies.

        It is at least `discord`: frames that take the target for quite another size may be the ones that are right.
        """
        return max((1.0 - FRAME_SHARE) * max(self.sigma**2, self.frame_variance / FRAME_SHARE), self.discord)

    def seen(
        self,
        time_ns: int,
        log_range: float,
        log_range_variance: float,
        track_log_range: float,
        rates_per_s: tuple[float, float],
    ) -> RangeScale:
        """Add a frame; the track's log range and its rates (`rates_of`) are those predicted for that frame."""
        dt_s = (time_ns - self.recent[-1][0]) * 1e-9
        fade = math.exp(-dt_s / SIGMA_MEMORY_S)
        sigma2 = fade * self.sigma**2 + (1.0 - fade) * log_range_variance
        oldest_ns = time_ns - round(WINDOW_S * 1e9)
        recent = (*(one for one in self.recent if one[0] >= oldest_ns), (time_ns, log_range))
        now = [
            value + _gone_since((time_ns - then_ns) * 1e-9, *rates_per_s) - track_log_range for then_ns, value in recent
        ]
        center = median(now)
        scatter = (MAD_TO_STD * median(abs(one - center) for one in now)) ** 2
        told = PRIOR_FRAMES * FRAME_SHARE * sigma2
        frame_variance = max((told + len(now) * scatter) / (PRIOR_FRAMES + len(now)), FRAME_STD_MIN**2)
        discord = fmean((one - center) ** 2 for one in now)
        return RangeScale(math.sqrt(sigma2), recent, frame_variance, discord, center, now[-1] - center)

    def alone(self) -> RangeScale:
        """With the last frame only: without a velocity, ranges of earlier ones cannot be compared with later ones."""
        return replace(self, recent=self.recent[-1:])

    def noise(self, dt_s: float) -> float:
        """Measurement variance of log range for the last frame, dt_s after the one before."""
        z2 = self.beyond**2 / self.frame_variance
        return self.frame_variance * max(1.0, (TAIL_DOF + z2) / (TAIL_DOF + 1.0)) * max(1.0, ALIKE_S / dt_s)

    def away(self, track_variance: float) -> float:
        """How far to move the track's log range (of variance `track_variance`) to the last frames' median; 0: not."""
        drift = 0.5 * (self.recent[-1][0] - self.recent[0][0]) * 1e-9 * RATE_STD_PER_S
        spread = track_variance + self.frame_variance / len(self.recent) + drift**2
        return self.center if self.center**2 > OFF_STD**2 * spread else 0.0


def rates_of(velocity_mps: Array, ray_m: Array, across_known: bool) -> tuple[float, float]:
    """Relative velocity [3] of a target at ray_m [3] from the camera, divided by its range: along the ray, positive
    away, and across it; the latter 0 if not `across_known`, being mostly the camera's own turning."""
    range_m2 = float(ray_m @ ray_m)
    along_per_s = float(velocity_mps @ ray_m) / range_m2
    across2 = float(velocity_mps @ velocity_mps) / range_m2 - along_per_s**2
    return along_per_s, math.sqrt(max(across2, 0.0)) if across_known else 0.0


def _gone_since(ago_s: float, along_per_s: float, across_per_s: float) -> float:
    """Change of log range in the last ago_s for straight relative motion.

    A target passing abeam was farther away before, although its range is not changing at this moment.
    """
    shares_then = math.hypot(1.0 + min(-along_per_s, CLOSING_MAX_PER_S) * ago_s, across_per_s * ago_s)
    # A receding target did not start at the camera itself.
    return -math.log(max(shares_then, math.exp(-OPENING_MAX_PER_S * ago_s)))


def corrected(relative_m: Array, change_m: Array) -> tuple[Array, Array, float]:
    """Apply a correction [3] to a position relative_m [3] from the camera; returns it, the turn [3, 3] of the line of
    sight and the change of log range.

    Along the ray a correction is a change of log range, across it an angle: taken as metres, that of an uncertain
    prediction leads too near, behind the camera, or beside what was seen.
    """
    range_m2 = float(relative_m @ relative_m)
    log_factor = float(change_m @ relative_m) / range_m2
    turned = so3.exp(so3.skew(relative_m) @ change_m / range_m2)
    return np.exp(log_factor) * turned @ relative_m, turned, log_factor


def in_metres(residual_m: Array, ray_m: Array, log_factor: float, straight: bool) -> Array:
    """Convert a residual [3], along ray_m [3] a difference of log ranges and across it an angle, to metres flown: what
    corrects the velocity.

    log_factor: the change of log range by the correction; `straight`: by the chord of that angle, as a target flies;
    else by its arc, as a camera turns.
    """
    range_m2 = float(ray_m @ ray_m)
    metres = math.expm1(log_factor) / log_factor if log_factor else 1.0
    along_m = float(residual_m @ ray_m) / range_m2 * ray_m
    across_m = residual_m - along_m
    if straight:
        across_m = so3.exp(so3.skew(ray_m) @ residual_m / range_m2) @ ray_m - ray_m
    return across_m + metres * along_m
