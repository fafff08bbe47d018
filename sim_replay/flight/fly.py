"""fly_encounter: own ship, targets and camera drawn from a plan's seed, redrawn until range and image fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sim_replay.airframes import airframe_id, airframe_of
from sim_replay.flight import bolted
from sim_replay.flight.aircraft import flight_class
from sim_replay.flight.encounter import Encounter, EncounterPlan, camera_pose
from sim_replay.flight.jsbsim_flight import FlightError, Sortie, fly
from sim_replay.flight.meeting import Layouts, draw_aspect, draw_layouts, flyable, seen_from
from sim_replay.flight.others import View, fly_beside
from sim_replay.flight.pointing import Pointing, bearing_rad, draw_excursion, draw_jitter, gimbal
from sim_replay.flight.sorties import Clock, draw_own_class, draw_sortie
from sim_replay.flight.track import Array, Mask, Track

LOWEST_M, HIGHEST_M = 60.0, 3300.0
NEAREST_M, FARTHEST_M = 90.0, 520.0
SPANS_APART = 1.5
LAYOUTS = 600
ENOUGH = 12  # layouts from which one is chosen by aspect
CONFIRMED = 10  # layouts checked in detail before others are drawn
ATTEMPTS = 8


def fly_encounter(plan: EncounterPlan) -> Encounter:
    """Fly a plan. Raises ValueError for an impossible plan, FlightError if no flight was found for it."""
    _check(plan)
    clock = Clock(np.arange(plan.frames) / plan.fps)
    rng = np.random.default_rng([plan.seed, 0xF1])
    lever = np.array([rng.uniform(0.2, 0.8), rng.uniform(-0.2, 0.2), rng.uniform(0.05, 0.25)])
    met = _meet(plan, clock, rng, lever, bolted_on=True) if plan.mount == "fixed" and not plan.leaves else None
    met = met or _meet(plan, clock, rng, lever, bolted_on=False)
    if met is None:
        raise FlightError(f"seed {plan.seed}: no flight keeps {plan.range_m:.0f} m over {plan.frames} frames")
    met = _into_the_world(rng, met)
    pointing = _point(plan, clock, rng, met, lever)
    targets = _with_others(plan, clock, rng, met, lever, pointing)
    R_ned_cam, t_ned_cam_m = camera_pose(met.own, pointing, lever, clock.frame_t_s)
    return Encounter(
        plan=replace(plan, mount="gimbal" if met.R_body_cam is None else "fixed"),
        frame_t_s=clock.frame_t_s,
        own=met.own,
        targets=targets,
        R_ned_cam=R_ned_cam,
        t_ned_cam_m=t_ned_cam_m,
        R_body_cam=pointing.at(clock.frame_t_s),
        t_body_cam_m=lever,
        pointing=pointing,
    )


def _check(plan: EncounterPlan) -> None:
    if plan.frames < 2 or plan.fps <= 0.0:
        raise ValueError(f"an encounter needs at least 2 frames and a positive rate, not {plan.frames} at {plan.fps}")
    if not NEAREST_M + 5.0 <= plan.range_m <= FARTHEST_M - 10.0:
        raise ValueError(f"range_m must lie between {NEAREST_M + 5:.0f} and {FARTHEST_M - 10:.0f}, not {plan.range_m}")
    if not plan.airframes:
        raise ValueError("an encounter needs at least one airframe")


@dataclass(frozen=True)
class _Meeting:
    """Own ship and main target in common axes."""

    own: Track
    target: Track
    target_sortie: Sortie
    R_body_cam: Array | None  # [3, 3] of a fixed camera


def _meet(
    plan: EncounterPlan, clock: Clock, rng: np.random.Generator, lever: Array, bolted_on: bool
) -> _Meeting | None:
    """The first drawn pair of flights that can be placed relative to each other as planned, with the drawn aspect."""
    aspect = draw_aspect(rng)
    for attempt in range(ATTEMPTS):
        own_sortie, target_sortie = _draw_pair(plan, clock, rng, attempt)
        try:
            own, target = (fly(s, clock.start_s, clock.end_s) for s in (own_sortie, target_sortie))
        except FlightError:
            continue
        layouts = draw_layouts(rng, LAYOUTS, plan.range_m)
        coarse = _Fit(plan, own, target, lever, clock.checked_s, layouts)
        good = coarse.flyable() & (coarse.kept_in_picture() if bolted_on else True)
        if good.sum() < (ENOUGH if attempt < ATTEMPTS // 2 else 1):
            continue
        match = seen_from(layouts, target.at(clock.checked_s), len(clock.checked_s) // 2) @ aspect
        for k in np.argsort(np.where(good, -match, np.inf), kind="stable")[: min(int(good.sum()), CONFIRMED)]:
            fine = _Fit(plan, own, target, lever, clock.all_s, layouts.only(int(k)))
            if not fine.flyable()[0] or (bolted_on and not fine.kept_in_picture()[0]):
                continue
            mount = fine.aimed(rng) if bolted_on else None
            return _Meeting(own, layouts.laid(int(k), own, target, clock.middle_s), target_sortie, mount)
    return None


class _Fit:
    """Layouts of a pair of flights, evaluated at several times; the middle one is mid sequence."""

    def __init__(
        self, plan: EncounterPlan, own: Track, target: Track, lever: Array, times_s: Array, layouts: Layouts
    ) -> None:
        ship = own.at(times_s)
        self.relative_m = layouts.relative_m(ship, target.at(times_s), len(times_s) // 2)
        sight = self.relative_m - ship.R_ned_body @ lever
        self.half_fov_rad = plan.half_fov_rad
        self.mean_rad, self.body = bolted.mean_aim(ship, sight)
        self.reach = bolted.reach_rad(sight, plan.half_fov_rad, _radius_m(plan.airframes[0]), plan.jitter_rad)

    def flyable(self) -> Mask:
        return flyable(self.relative_m, NEAREST_M + 2.0, FARTHEST_M - 2.0)

    def kept_in_picture(self) -> Mask:
        return bolted.keeps(self.mean_rad, self.body, self.reach)

    def aimed(self, rng: np.random.Generator) -> Array:
        return bolted.aim(rng, self.mean_rad[0], self.body[0], self.reach[0], self.half_fov_rad)


def _draw_pair(plan: EncounterPlan, clock: Clock, rng: np.random.Generator, attempt: int) -> tuple[Sortie, Sortie]:
    """Own ship's and main target's sorties; later attempts draw more similar ones."""
    target_class = flight_class(plan.airframes[0])
    target = draw_sortie(rng, clock, target_class, plan.gust)
    own_class = draw_own_class(rng, target.speed_mps, clock) if attempt < 2 else target_class
    own = draw_sortie(rng, clock, own_class, plan.gust)
    if attempt >= 3:
        own = replace(own, speed_mps=target.speed_mps)
    if attempt >= 4:
        own = replace(own, manoeuvre=target.manoeuvre, height_m=target.height_m, autopilot=target.autopilot)
    return own, target


def _into_the_world(rng: np.random.Generator, met: _Meeting) -> _Meeting:
    """Both flights at a random heading and height, in a steady wind, own ship over the origin at t = 0."""
    yaw_rad, wind_rad = rng.uniform(-np.pi, np.pi, 2)
    wind = rng.uniform(0.0, 8.0) * np.array([np.cos(wind_rad), np.sin(wind_rad), 0.0])
    own, target = met.own.turned(yaw_rad), met.target.turned(yaw_rad)
    start = own.at(np.zeros(1)).t_ned_body_m[0]
    down = np.concatenate([own.t_ned_body_m[:, 2], target.t_ned_body_m[:, 2]])
    lowest, highest = -down.max(), -down.min()
    low = LOWEST_M + 30.0
    height_m = np.exp(rng.uniform(np.log(low), np.log(HIGHEST_M - (highest - lowest))))  # of the lower of the two
    shift = np.array([-start[0], -start[1], lowest - height_m])
    return replace(met, own=own.moved(shift, wind), target=target.moved(shift, wind))


def _radius_m(airframe: str) -> float:
    shape = airframe_of(airframe_id(airframe))
    return 0.5 * float(np.hypot(shape.span_m, shape.length_m))


def _point(plan: EncounterPlan, clock: Clock, rng: np.random.Generator, met: _Meeting, lever: Array) -> Pointing:
    jitter = draw_jitter(rng, plan.jitter_rad)
    if met.R_body_cam is not None:
        ends = np.array([clock.start_s, clock.end_s])
        return Pointing(ends, np.stack([met.R_body_cam, met.R_body_cam]), jitter)
    excursion = draw_excursion(rng, 2.0 * clock.middle_s) if plan.leaves else None
    radius_m = _radius_m(plan.airframes[0])
    return gimbal(rng, met.own, met.target, lever, plan.half_fov_rad, radius_m, jitter, excursion)


def _with_others(
    plan: EncounterPlan, clock: Clock, rng: np.random.Generator, met: _Meeting, lever: Array, pointing: Pointing
) -> tuple[Track, ...]:
    """The main target and the other targets, in the order of the plan."""
    targets: tuple[Track, ...] = (met.target,)
    if len(plan.airframes) == 1:
        return targets
    R_ned_cam, t_ned_cam_m = camera_pose(met.own, pointing, lever, clock.checked_s)
    sight = met.target.at(clock.checked_s).t_ned_body_m - t_ned_cam_m
    angles = bearing_rad(np.einsum("nij,ni->nj", R_ned_cam, sight))
    view = View(R_ned_cam, t_ned_cam_m, plan.half_fov_rad, np.all(np.abs(angles) <= plan.half_fov_rad, axis=-1))
    apart_m = SPANS_APART * max(airframe_of(airframe_id(name)).span_m for name in plan.airframes)
    for name in plan.airframes[1:]:
        beside = fly_beside(
            rng, clock, name, met.target_sortie, met.own, targets, apart_m, _radius_m(name), LOWEST_M + 5.0, view
        )
        targets = (*targets, beside)
    return targets
