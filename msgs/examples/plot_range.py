"""Plot range over time in the terminal, one line per pose; replace with a real plotting library."""

from __future__ import annotations

import itertools
from contextlib import suppress

import numpy as np

from msgs.client import connect, subscribe
from msgs.examples.arguments import parse, run

NEAR_M, FAR_M, COLUMNS = 0.0, 600.0, 60


def bar(range_m: float, sigma_m: float) -> str:
    """`NEAR_M`..`FAR_M` across: `o` where the target is, `-` one sigma to both sides."""
    column = lambda metres: int(np.clip((metres - NEAR_M) / (FAR_M - NEAR_M), 0.0, 1.0) * (COLUMNS - 1))  # noqa: E731
    left, middle, right = (column(range_m + side * sigma_m) for side in (-1.0, 0.0, 1.0))
    return "".join("o" if n == middle else "-" if left <= n <= right else " " for n in range(COLUMNS))


def main() -> None:
    options = parse("Plot the range of a vehicle's targets as text.")
    with suppress(KeyboardInterrupt), connect(options.endpoint) as session, subscribe(session, options.uav) as poses:
        for one in itertools.islice(poses, options.count):
            t_m = one.pose.t_cam_target_m
            range_m = float(np.linalg.norm(t_m))
            along = t_m / range_m
            sigma_m = float(np.sqrt(along @ one.pose.covariance[:3, :3] @ along))
            print(f"{one.target} |{bar(range_m, sigma_m)}| {range_m:6.1f} m", flush=True)


if __name__ == "__main__":
    run(main)
