"""Draws one encounter as a picture: the paths from above, range, bank, aspect, and the target's way through the frame.

python -m sim_replay.flight --seed 3 --airframe male_v_tail --out encounter.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from msgs.geometry import euler_from_R
from sim_replay.flight.encounter import Encounter, EncounterPlan
from sim_replay.flight.fly import fly_encounter
from sim_replay.flight.jsbsim_flight import FlightError
from sim_replay.flight.pointing import bearing_rad


def draw(encounter: Encounter) -> Figure:
    """The figure of one encounter."""
    figure = Figure(figsize=(13, 8), layout="constrained")
    grid = figure.add_gridspec(4, 2)
    _draw_paths(figure.add_subplot(grid[:, 0]), encounter)
    t_s = encounter.frame_t_s
    over_time = [figure.add_subplot(grid[row, 1]) for row in range(4)]
    for k, (name, track) in enumerate(zip(encounter.plan.airframes, encounter.targets, strict=True)):
        seen = track.at(t_s)
        sight = seen.t_ned_body_m - encounter.t_ned_cam_m
        over_time[0].plot(t_s, np.linalg.norm(sight, axis=1), f"C{k + 1}", label=name)
        over_time[1].plot(t_s, np.degrees(euler_from_R(seen.R_ned_body)[0]), f"C{k + 1}")
        back = np.einsum("nji,nj->ni", seen.R_ned_body, -sight)
        over_time[2].plot(t_s, np.degrees(np.arctan2(back[:, 1], back[:, 0])), f"C{k + 1}.", markersize=2)
        angles = bearing_rad(np.einsum("nji,nj->ni", encounter.R_ned_cam, sight))
        over_time[3].plot(*(angles / np.asarray(encounter.plan.half_fov_rad)).T, f"C{k + 1}")
    over_time[1].plot(t_s, np.degrees(euler_from_R(encounter.own.at(t_s).R_ned_body)[0]), "C0", label="own ship")
    for axes, label in zip(over_time, ("range, m", "bank, °", "seen from, ° (0 ahead)", "place in frame"), strict=True):
        axes.set_ylabel(label)
    over_time[0].legend(fontsize=8)
    over_time[3].set(xlim=(-1, 1), ylim=(1, -1))
    return figure


def _draw_paths(axes: Axes, encounter: Encounter) -> None:
    for k, (name, track) in enumerate(
        zip(("own ship", *encounter.plan.airframes), (encounter.own, *encounter.targets), strict=True)
    ):
        shown = track.at(encounter.frame_t_s)
        north, east, down = shown.t_ned_body_m.T
        axes.plot(east, north, f"C{k}", label=f"{name}, {-down[0]:.0f} to {-down[-1]:.0f} m up")
        every = slice(None, None, max(len(north) // 8, 1))
        nose = shown.R_ned_body[every, :, 0]
        axes.quiver(east[every], north[every], nose[:, 1], nose[:, 0], color=f"C{k}", width=0.004)
    for sample in np.linspace(0, len(encounter.frame_t_s) - 1, 8).astype(int):
        here = encounter.t_ned_cam_m[sample]
        there = encounter.targets[0].at(encounter.frame_t_s[sample : sample + 1]).t_ned_body_m[0]
        axes.plot([here[1], there[1]], [here[0], there[0]], "0.8", linewidth=0.8)
    axes.set(xlabel="east, m", ylabel="north, m", aspect="equal")
    axes.set_title(f"seed {encounter.plan.seed}, {encounter.plan.mount} camera, {encounter.plan.gust} air")
    axes.legend(fontsize=8)


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m sim_replay.flight", description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path, required=True, metavar="PNG", help="picture to write")
    parser.add_argument("--seed", type=int, default=0, help="(default %(default)s)")
    parser.add_argument("--airframe", action="append", metavar="NAME", help="again for a second and third target")
    parser.add_argument("--range", type=float, default=250.0, metavar="M", help="at mid sequence (default %(default)s)")
    parser.add_argument("--frames", type=int, default=120, help="(default %(default)s)")
    parser.add_argument("--fps", type=float, default=15.0, help="(default %(default)s)")
    parser.add_argument("--mount", choices=("fixed", "gimbal"), default="gimbal")
    parser.add_argument("--gust", choices=("calm", "light", "moderate"), default="light")
    parser.add_argument("--leaves", action="store_true", help="the target leaves the picture and comes back")
    options = parser.parse_args()
    airframes = tuple(options.airframe or ("light_aircraft",))
    plan = EncounterPlan(
        options.seed,
        options.frames,
        options.fps,
        options.range,
        airframes,
        half_fov_rad=(0.31, 0.18),
        mount=options.mount,
        jitter_rad=2e-4,
        gust=options.gust,
        leaves=options.leaves,
    )
    try:
        figure = draw(fly_encounter(plan))
    except (ValueError, FlightError) as error:
        parser.error(str(error))
    figure.savefig(options.out, dpi=90)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
