"""A camera fixed to the own ship: which encounters it can observe, and where to point it."""

from __future__ import annotations

import numpy as np

from msgs.geometry import R_FORWARD_CAM, R_from_euler
from sim_replay.flight.pointing import bearing_rad, radius_rad
from sim_replay.flight.track import Array, Mask, Track

STEEPEST_MOUNT_RAD = np.radians(55.0)


def bolted(yaw_rad: Array, pitch_rad: Array) -> Array:
    """R_body_cam [..., 3, 3] of upright cameras rotated to the right and up from the nose by angles [...]."""
    return R_from_euler(np.zeros_like(yaw_rad), pitch_rad, yaw_rad) @ R_FORWARD_CAM


def mean_aim(own: Track, relative_m: Array) -> tuple[Array, Array]:
    """(yaw and pitch [M, 2] of the mean sight line, sight lines [M, N, 3], own body axes) of M encounters in NED."""
    body = np.einsum("nij,mni->mnj", own.R_ned_body, relative_m)
    mean = (body / np.linalg.norm(body, axis=-1, keepdims=True)).mean(axis=1)
    pitch = np.arctan2(-mean[:, 2], np.hypot(mean[:, 0], mean[:, 1]))
    return np.stack([np.arctan2(mean[:, 1], mean[:, 0]), pitch], axis=-1), body


def reach_rad(relative_m: Array, half_fov_rad: tuple[float, float], radius_m: float, jitter_rad: float) -> Array:
    """Largest angle off axis [..., 2] of a target's origin at which a sphere of `radius_m` is fully in the image."""
    radius = radius_rad(radius_m, np.linalg.norm(relative_m, axis=-1))
    return 0.97 * np.asarray(half_fov_rad) - radius[..., None] - 6.0 * jitter_rad


def keeps(aim_rad: Array, body: Array, reach: Array) -> Mask:
    """Whether fixed cameras [M] at yaw and pitch [M, 2] keep lines of sight [M, N, 3] (body) within reach [M, N, 2]."""
    angles = bearing_rad(np.einsum("mij,mni->mnj", bolted(aim_rad[:, 0], aim_rad[:, 1]), body))
    inside: Mask = np.all(np.abs(angles) <= reach, axis=(1, 2))
    return inside & (np.abs(aim_rad[:, 1]) <= STEEPEST_MOUNT_RAD)


def aim(
    rng: np.random.Generator, mean_rad: Array, body: Array, reach: Array, half_fov_rad: tuple[float, float]
) -> Array:
    """R_body_cam [3, 3] with sight lines [N, 3] as far off centre, in a random direction, as `reach` [N, 2] allows."""
    aside = rng.uniform(-1.0, 1.0, 2) * np.asarray(half_fov_rad)
    for share in (1.0, 0.7, 0.5, 0.3, 0.15, 0.0):
        moved = mean_rad + share * aside
        if keeps(moved[None], body[None], reach[None])[0]:
            break
    return bolted(moved[0], moved[1])
