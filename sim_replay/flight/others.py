"""Second and third targets: in the image beside the main one, in loose formation or crossing."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from msgs.geometry import euler_from_R
from sim_replay.flight.aircraft import flight_class
from sim_replay.flight.jsbsim_flight import FlightError, Sortie, fly
from sim_replay.flight.meeting import Layouts, flyable
from sim_replay.flight.pointing import bearing_rad, radius_rad
from sim_replay.flight.sorties import Clock, draw_sortie
from sim_replay.flight.track import Array, Mask, Track

NEAREST_M, FARTHEST_M = 90.0, 550.0
LAYOUTS = 400
ATTEMPTS = 8


@dataclass(frozen=True)
class View:
    """The camera at the checked times [N], and half its field of view."""

    R_ned_cam: Array  # [N, 3, 3]
    t_ned_cam_m: Array  # [N, 3]
    half_fov_rad: tuple[float, float]
    counted: Mask  # [N], times at which the main target is in the image


def fly_beside(
    rng: np.random.Generator,
    clock: Clock,
    airframe: str,
    main: Sortie,
    own: Track,
    taken: tuple[Track, ...],
    apart_m: float,
    radius_m: float,
    lowest_m: float,
    view: View,
) -> Track:
    """A flight that stays `apart_m` from the `taken` ones and is in the image as long as random search achieves.

    Early attempts fly like the airframe, later ones copy the main target's sortie. Raises FlightError.
    """
    best: tuple[float, Track] | None = None
    for attempt in range(ATTEMPTS):
        sortie = draw_sortie(rng, clock, flight_class(airframe), main.gust)
        if attempt >= 2:
            sortie = replace(main, gust_seed=sortie.gust_seed)
        try:
            flown = fly(sortie, clock.start_s, clock.end_s)
        except FlightError:
            continue
        score, track = _best_layout(rng, clock, flown, own, taken, apart_m, radius_m, lowest_m, view)
        if best is None or score > best[0]:
            best = score, track
        if best[0] >= 0.95:
            break
    if best is None or best[0] <= 0.0:
        raise FlightError(f"no place beside the main target was found for {airframe}")
    return best[1]


def _best_layout(
    rng: np.random.Generator,
    clock: Clock,
    flown: Track,
    own: Track,
    taken: tuple[Track, ...],
    apart_m: float,
    radius_m: float,
    lowest_m: float,
    view: View,
) -> tuple[float, Track]:
    """(share of the counted times fully in the image, the flight in the world) of the best of many layouts."""
    times, middle = clock.checked_s, len(clock.checked_s) // 2
    first, second = own.at(times), flown.at(times)
    layouts = _draw(rng, first, second, taken[0].at(times), middle, view)
    relative = layouts.relative_m(first, second, middle)
    where = relative + first.t_ned_body_m
    good = flyable(relative, NEAREST_M + 3.0, FARTHEST_M - 3.0) & np.all(-where[..., 2] > lowest_m, axis=1)
    for other in taken:
        good &= np.all(np.linalg.norm(where - other.at(times).t_ned_body_m, axis=-1) > 1.15 * apart_m + 2.0, axis=1)
    sight = where - view.t_ned_cam_m
    angles = bearing_rad(np.einsum("nij,mni->mnj", view.R_ned_cam, sight))
    radius = radius_rad(radius_m, np.linalg.norm(sight, axis=-1))
    inside = np.all(np.abs(angles) + radius[..., None] <= np.asarray(view.half_fov_rad), axis=-1)
    share = inside[:, view.counted].mean(axis=1) * good
    k = int(np.argmax(share))
    return float(share[k]), layouts.laid(k, own, flown, clock.middle_s)


def _draw(rng: np.random.Generator, own: Track, flown: Track, main: Track, middle: int, view: View) -> Layouts:
    """Layouts inside the image at mid sequence, two in three nearly parallel to the main target."""
    heading = [float(euler_from_R(track.R_ned_body[middle])[2]) for track in (main, flown)]
    parallel = rng.random(LAYOUTS) < 0.67
    turn = np.where(parallel, rng.normal(0.0, 0.1, LAYOUTS), rng.uniform(-np.pi, np.pi, LAYOUTS))
    # If the main target is out of the image at mid sequence, the camera looks elsewhere: draw around the target.
    to_main = main.t_ned_body_m[middle] - view.t_ned_cam_m[middle]
    main_cam = view.R_ned_cam[middle].T @ to_main
    angles = rng.uniform(-0.9, 0.9, (LAYOUTS, 2)) * np.asarray(view.half_fov_rad)
    if not view.counted[middle]:
        angles = bearing_rad(main_cam) + 0.6 * angles
    near = rng.random(LAYOUTS) < 0.5
    main_m = float(np.linalg.norm(to_main))
    range_m = np.where(near, main_m + rng.uniform(-80.0, 80.0, LAYOUTS), rng.uniform(NEAREST_M, FARTHEST_M, LAYOUTS))
    direction = np.concatenate([np.tan(angles), np.ones((LAYOUTS, 1))], axis=-1)
    direction /= np.linalg.norm(direction, axis=-1, keepdims=True)
    sight = range_m[:, None] * (direction @ view.R_ned_cam[middle].T)
    return Layouts(heading[0] - heading[1] + turn, view.t_ned_cam_m[middle] + sight - own.t_ned_body_m[middle])
