"""The camera on its own ship: fixed, or on a gimbal that follows a target with lag, wander and jitter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from msgs.geometry import slerp, so3_exp
from sim_replay.flight.track import Array, Track, spans

DOWN = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Jitter:
    """Vibration of the camera: sinusoids on each of its axes."""

    frequency_hz: Array  # [S, 3]
    phase_rad: Array  # [S, 3]
    size_rad: Array  # [S, 3]

    def rotation(self, t_s: Array) -> Array:
        """R_still_shaken [M, 3, 3] at times [M]."""
        angle = 2.0 * np.pi * self.frequency_hz * t_s[:, None, None] + self.phase_rad
        return so3_exp(np.sum(self.size_rad * np.sin(angle), axis=1))


def draw_jitter(rng: np.random.Generator, rms_rad: float) -> Jitter:
    """Vibration of 3 to 30 Hz whose angle about each axis has that root mean square."""
    count = 8
    share = rng.uniform(0.3, 1.0, (count, 3))
    size = rms_rad * np.sqrt(2.0) * share / np.linalg.norm(share, axis=0)
    frequency_hz = np.exp(rng.uniform(np.log(3.0), np.log(30.0), (count, 3)))
    return Jitter(frequency_hz, rng.uniform(0.0, 2.0 * np.pi, (count, 3)), size)


@dataclass(frozen=True)
class Pointing:
    """Where the camera points on its own ship: samples [N] over time, plus jitter."""

    t_s: Array  # [N]
    R_body_cam: Array  # [N, 3, 3] without jitter
    jitter: Jitter

    def at(self, t_s: Array) -> Array:
        """R_body_cam [M, 3, 3] at times [M]."""
        return self.still_at(t_s) @ self.jitter.rotation(t_s)

    def still_at(self, t_s: Array) -> Array:
        """R_body_cam [M, 3, 3] at times [M], without jitter: a fixed camera's mount."""
        i, share, _ = spans(self.t_s, t_s)
        return slerp(self.R_body_cam[i], self.R_body_cam[i + 1], share)


def look(direction_ned: Array) -> Array:
    """R_ned_cam [N, 3, 3] of upright cameras whose axes lie along unit directions [N, 3], none of them vertical."""
    right = np.cross(DOWN, direction_ned)
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    return np.stack([right, np.cross(direction_ned, right), direction_ned], axis=-1)


def aside(angles_rad: Array) -> Array:
    """Shortest rotations [N, 3, 3], to be applied after a camera that looks at a point.

    The point then lies `angles_rad` [N, 2] to the right of and below the rotated camera's axis: its direction in that
    camera is (tan a, tan b, 1).
    """
    direction = np.concatenate([np.tan(angles_rad), np.ones((len(angles_rad), 1))], axis=-1)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    axis = np.cross(direction, DOWN)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    return so3_exp(axis / np.maximum(sine, 1e-12) * np.arctan2(sine, direction[:, 2:]))


def bearing_rad(direction_cam: Array) -> Array:
    """Angles [..., 2] to the right of and below the axis of directions [..., 3] in a camera; pi if behind it."""
    ahead = direction_cam[..., 2:]
    angles = np.arctan2(direction_cam[..., :2], np.maximum(ahead, 1e-9))
    return np.where(ahead > 0.0, angles, np.pi)


def radius_rad(radius_m: float, range_m: Array) -> Array:
    """Angle [...] from a sphere's centre to its edge, seen from `range_m` [...] away; bounded if that is too near."""
    return np.arcsin(np.minimum(radius_m / range_m, 0.9))


def within(angles_rad: Array, limit_rad: Array) -> Array:
    """Angles [N, 2] smoothly limited to plus and minus `limit_rad` [N, 2]; small ones are unchanged."""
    return limit_rad * np.tanh(angles_rad / np.maximum(limit_rad, 1e-6))


def draw_wander(rng: np.random.Generator, t_s: Array, reach_rad: tuple[float, float]) -> Array:
    """A slow random walk [N, 2] of the target through the image, around a place drawn within `reach_rad`."""
    place = rng.uniform(-1.2, 1.2, 2)
    period_s = rng.uniform(4.0, 15.0, (3, 2))
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, 2))
    size = rng.uniform(0.05, 0.35) * rng.uniform(0.2, 1.0, (3, 2))
    walk = np.sum(size * np.sin(2.0 * np.pi * t_s[:, None, None] / period_s + phase), axis=1)
    return (place + walk) * np.asarray(reach_rad)


def lag(direction_ned: Array, step_s: float, time_constant_s: float) -> Array:
    """Unit directions [N, 3] that follow `direction_ned` as a first-order servo does, from rest on it."""
    out = np.empty_like(direction_ned)
    out[0] = direction_ned[0]
    share = 1.0 - np.exp(-step_s / time_constant_s)
    for k in range(1, len(out)):
        moved = out[k - 1] + share * (direction_ned[k] - out[k - 1])
        out[k] = moved / np.linalg.norm(moved)
    return out


@dataclass(frozen=True)
class Excursion:
    """When the target is out of the image, and in which direction it left."""

    out_s: tuple[float, float]  # completely outside between these times
    ramp_s: float
    towards: tuple[float, float]  # unit, right and down

    def share(self, t_s: Array) -> Array:
        """0 inside, 1 outside, with a smooth transition, at times [N]."""
        before = (t_s - (self.out_s[0] - self.ramp_s)) / self.ramp_s
        after = ((self.out_s[1] + self.ramp_s) - t_s) / self.ramp_s
        u = np.clip(np.minimum(before, after), 0.0, 1.0)
        return u * u * (3.0 - 2.0 * u)


def draw_excursion(rng: np.random.Generator, last_frame_s: float) -> Excursion:
    """An absence of 12 to 22 % of the time, away from both ends."""
    length = float(rng.uniform(0.12, 0.22)) * last_frame_s
    ramp = float(rng.uniform(0.03, 0.06)) * last_frame_s
    start = float(rng.uniform(0.15 * last_frame_s, 0.85 * last_frame_s - length))
    side = [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)][int(rng.integers(4))]
    return Excursion((start, start + length), ramp, side)


def gimbal(
    rng: np.random.Generator,
    own: Track,
    target: Track,
    t_body_cam_m: Array,
    half_fov_rad: tuple[float, float],
    radius_m: float,
    jitter: Jitter,
    excursion: Excursion | None,
) -> Pointing:
    """A gimbal that keeps the target [same times as own] fully in the image, except during an excursion."""
    camera_m = own.t_ned_body_m + np.einsum("nij,j->ni", own.R_ned_body, t_body_cam_m)
    sight = target.t_ned_body_m - camera_m
    range_m = np.linalg.norm(sight, axis=-1, keepdims=True)
    sight /= range_m
    R_ned_look = look(sight)
    if rng.random() < 0.4:  # the gimbal has no roll axis: the image tilts with the own ship
        R_ned_look = R_ned_look @ _lean(own, sight)
    step_s = float(own.t_s[1] - own.t_s[0])
    behind = lag(sight, step_s, float(rng.uniform(0.05, 0.25)))
    half = np.asarray(half_fov_rad)
    size_rad = radius_rad(radius_m, range_m)
    shake_rad = np.sum(jitter.size_rad, axis=0).max()
    reach = np.maximum(half - size_rad - shake_rad - 0.02 * half, 0.02 * half)
    late = -np.einsum("nji,nj->ni", R_ned_look, behind)[:, :2]
    angles = within(draw_wander(rng, own.t_s, half_fov_rad) + late, reach)
    if excursion is not None:
        towards = np.asarray(excursion.towards)
        gone = towards * (half + size_rad + shake_rad + 0.05 * half)
        share = excursion.share(own.t_s)[:, None] * np.abs(towards)
        angles = (1.0 - share) * angles + share * gone
    R_ned_cam = R_ned_look @ aside(angles)
    return Pointing(own.t_s, np.swapaxes(own.R_ned_body, -1, -2) @ R_ned_cam, jitter)


def _lean(own: Track, sight_ned: Array) -> Array:
    """Rotations [N, 3, 3] about an upright camera's axis by the own ship's bank as seen along the line of sight."""
    forward = own.R_ned_body[:, :, 0]
    bank = np.arctan2(own.R_ned_body[:, 2, 1], own.R_ned_body[:, 2, 2])
    along = np.einsum("ni,ni->n", forward, sight_ned)
    return so3_exp(np.stack([np.zeros_like(bank), np.zeros_like(bank), bank * along], axis=-1))
