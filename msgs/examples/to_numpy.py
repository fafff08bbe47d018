"""Collect poses in arrays and write them as .npz: stamps, positions, rotation matrices, covariances."""

from __future__ import annotations

import itertools
import sys
from contextlib import suppress

import numpy as np

from msgs.client import connect, subscribe
from msgs.examples.arguments import parse, run
from msgs.geometry import R_from_q_wxyz
from msgs.receive import TargetPose

OUT = "poses.npz"


def main() -> None:
    options, taken = parse(f"Gather the poses of a vehicle's targets into {OUT}.", count=100), list[TargetPose]()
    # Ctrl-C ends early and keeps the poses received so far.
    with (
        suppress(KeyboardInterrupt),
        connect(options.endpoint) as session,
        subscribe(session, options.uav, depth=256) as poses,
    ):
        for one in itertools.islice(poses, options.count):
            taken.append(one)
    if not taken:
        sys.exit("no poses came")
    np.savez(
        OUT,
        target=np.array([one.target for one in taken]),
        stamp_ns=np.array([one.stamp_ns for one in taken]),
        t_cam_target_m=np.array([one.pose.t_cam_target_m for one in taken]),
        R_cam_target=R_from_q_wxyz(np.roll([one.pose.q_cam_target_xyzw for one in taken], 1, axis=-1)),
        covariance=np.array([one.pose.covariance for one in taken]),
    )
    print(f"{len(taken)} poses in {OUT}")


if __name__ == "__main__":
    run(main)
