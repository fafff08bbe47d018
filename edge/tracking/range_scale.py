"""How well the network knows the size of one target, and so its range: measured on the track itself. Pure.

One picture tells angles; range needs a size, and the size of an unknown aircraft is recognised, rightly or wrongly, by
its looks. So the log ranges of a track's frames hold two errors. One is nearly the same in all of them, as the target
is of one size: no looking again makes it smaller, and it is told, not estimated. The other is the frame's own, and some
frames take the target for an aircraft of quite another size. Against these, what counts is the median of the last
frames: a frame counts the less the further from it (Student's t), and a track that lies far from it is moved. How far
frames scatter is measured; where that is more than the network says, neither error is believed to be as small as it
says.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import fmean, median

import numpy as np

from edge.types import Array

FRAME_SHARE = 0.2  # of the network's log-range variance: what differs from frame to frame
FRAME_STD_MIN = 0.01
PRIOR_FRAMES = 4.0  # the network's word on the scatter counts as so many frames
MAD_TO_STD = 1.4826  # of a normal distribution
WINDOW_S = 1.5  # over which frames are compared
CLOSING_MAX_PER_S, OPENING_MAX_PER_S = 1.0, 0.4  # of range, by the range; a track that runs faster is not believed
RATE_STD_PER_S = 0.05
SIGMA_MEMORY_S = 1.0
TAIL_DOF = 3.0  # Student's t
ALIKE_S = 0.25  # frames within it err alike: together they count as one
OFF_STD = 3.0  # a track this many standard deviations from the median of its frames is moved to it


@dataclass(frozen=True)
class RangeScale:
    """What is known of one target's errors of log range."""

    sigma: float  # the network's own, smoothed
    recent: tuple[tuple[int, float], ...]  # (time_ns, log range) of the last frames
    frame_variance: float  # of a frame's own error: as the network has it at first, then as seen
    discord: float = 0.0  # mean square of how far the last frames lie from their median
    center: float = 0.0  # the median of the last frames' log ranges, beyond the track's
    beyond: float = 0.0  # the last frame's log range, beyond that median

    @classmethod
    def begin(cls, time_ns: int, log_range: float, log_range_variance: float) -> RangeScale:
        """After one frame with the network's variance of log range."""
        return cls(math.sqrt(log_range_variance), ((time_ns, log_range),), FRAME_SHARE * log_range_variance)

    @property
    def common_variance(self) -> float:
        """Of the error that all frames share: the network's, more where its frames disagree more than it says.

        Where some frames take the target for quite another size, it may be they who are right.
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
        """With another frame; the track's log range and how it moves (`rates_of`) are those predicted for it."""
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

    def noise(self, dt_s: float) -> float:
        """Variance of log range to take the last frame with, dt_s after the one before."""
        z2 = self.beyond**2 / self.frame_variance
        return self.frame_variance * max(1.0, (TAIL_DOF + z2) / (TAIL_DOF + 1.0)) * max(1.0, ALIKE_S / dt_s)

    def away(self, track_variance: float) -> float:
        """By how much the track's log range, of that variance, should be moved to where its last frames are."""
        drift = 0.5 * (self.recent[-1][0] - self.recent[0][0]) * 1e-9 * RATE_STD_PER_S
        spread = track_variance + self.frame_variance / len(self.recent) + drift**2
        return self.center if self.center**2 > OFF_STD**2 * spread else 0.0


def rates_of(velocity_mps: Array, ray_m: Array, across_known: bool) -> tuple[float, float]:
    """How fast a target at ray_m [3] from the camera moves against it by velocity_mps [3], as shares of its range:
    along the ray, away positive, and across it; 0 where that is not known, being mostly the camera's own turning."""
    range_m2 = float(ray_m @ ray_m)
    along_per_s = float(velocity_mps @ ray_m) / range_m2
    across2 = float(velocity_mps @ velocity_mps) / range_m2 - along_per_s**2
    return along_per_s, math.sqrt(max(across2, 0.0)) if across_known else 0.0


def _gone_since(ago_s: float, along_per_s: float, across_per_s: float) -> float:
    """How log range has changed in that time, of one that moves straight on against the camera.

    What passes abeam was farther off before, though its range does not change just now.
    """
    shares_then = math.hypot(1.0 + min(-along_per_s, CLOSING_MAX_PER_S) * ago_s, across_per_s * ago_s)
    # Who draws away did not start at the camera itself.
    return -math.log(max(shares_then, math.exp(-OPENING_MAX_PER_S * ago_s)))


def corrected(relative_m: Array, change_m: Array) -> tuple[Array, float]:
    """Where a correction [3] takes what lies at relative_m [3] from the camera, and by how much in log range.

    It was weighed in log range: taken for metres, that of a wide prediction leads too near, or behind the camera.
    """
    log_factor = float(change_m @ relative_m) / float(relative_m @ relative_m)
    return np.exp(log_factor) * (relative_m + change_m - log_factor * relative_m), log_factor


def in_metres(residual_m: Array, ray_m: Array, log_factor: float) -> Array:
    """A residual [3], which along ray_m [3] is a difference of log ranges, as the way flown, which speaks for a speed.

    log_factor: by how much it changes the log range.
    """
    metres = math.expm1(log_factor) / log_factor if log_factor else 1.0
    return residual_m + (metres - 1.0) * float(residual_m @ ray_m) / float(ray_m @ ray_m) * ray_m
