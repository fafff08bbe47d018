"""Print each pose on arrival: target, age, position in the camera frame, range and its standard deviation."""

from __future__ import annotations

import itertools
from contextlib import suppress

import numpy as np

from msgs.client import connect, subscribe
from msgs.examples.arguments import parse, run


def main() -> None:
    options = parse("Print each pose of a vehicle's targets.")
    with suppress(KeyboardInterrupt), connect(options.endpoint) as session, subscribe(session, options.uav) as poses:
        for one in itertools.islice(poses, options.count):
            x, y, z = one.pose.t_cam_target_m
            range_m = np.linalg.norm(one.pose.t_cam_target_m)
            along = one.pose.t_cam_target_m / range_m
            sigma_m = np.sqrt(along @ one.pose.covariance[:3, :3] @ along)
            print(
                f"{one.target}  {1e3 * one.age_s:5.0f} ms old  right {x:+7.1f}  down {y:+7.1f}  ahead {z:7.1f} m  "
                f"range {range_m:6.1f} ± {sigma_m:.1f} m",
                flush=True,
            )


if __name__ == "__main__":
    run(main)
