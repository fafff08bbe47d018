"""A vehicle's daemon as far as the ground can tell: its zenoh link, with made-up tracks where the camera would be.

    python -m sim_replay.radio.vehicle --uav uav1 --connect tcp/127.0.0.1:7447

Begins to send when a line comes on standard input, ends that with the next one and prints its link's counters as JSON,
and leaves when standard input ends. The range of a target tells the true time of its exposure (`range_m`,
`content_age_s`), so that a receiver can judge ages without believing any stamp.
"""

from __future__ import annotations

import argparse
import json
import sys
import threading
import time
from pathlib import Path

import numpy as np

from edge.config import MountSettings
from edge.config_ground import ZenohSettings, ZenohTlsSettings
from edge.health import Activity, Condition, HealthSnapshot, HealthState, Percentiles
from edge.links.zenoh_link import ZenohLink
from edge.types import FrameMeta, OwnShip, Report, Track, TrackState
from msgs.geometry import R_FORWARD_CAM

RANGE_MIN_M = 100.0
PERIOD_S = 600.0  # after which ranges repeat
EVENT_S = 1.0
_K = np.array([[2000.0, 0.0, 959.5], [0.0, 2000.0, 539.5], [0.0, 0.0, 1.0]])
_OWN_NED_M = np.array([0.0, 0.0, -120.0])


def range_m(utc_s: float) -> float:
    """Range of a target that was exposed at that time."""
    return RANGE_MIN_M + utc_s % PERIOD_S


def content_age_s(measured_range_m: float, utc_s: float) -> float:
    """Age of a pose by its content, not by its stamp; valid while it is younger than half a period."""
    age_s = (utc_s - (measured_range_m - RANGE_MIN_M)) % PERIOD_S
    return age_s if age_s < PERIOD_S / 2 else age_s - PERIOD_S


def report(sequence: int, targets: int, uav_number: int = 0) -> Report:
    """A frame exposed now, with this many targets straight ahead of an own ship that flies north."""
    now_ns, now_s = time.monotonic_ns(), time.time()
    own_m = _OWN_NED_M + np.array([0.0, 50.0 * uav_number, 0.0])
    own = OwnShip(now_ns, np.eye(3), own_m, np.array([20.0, 0.0, 0.0]), (47.0, 8.0, 400.0))
    t_cam_m = np.array([0.0, 0.0, range_m(now_s)])
    sigma_m = 0.05 * t_cam_m[2]
    covariance = np.diag([0.04, 0.04, sigma_m**2, 0.01, 0.01, 0.01])
    covariance_ned = np.diag([sigma_m**2, 0.04, 0.04, 4.0, 4.0, 4.0, 0.01, 0.01, 0.01])
    tracks = tuple(
        Track(
            track_id=number,
            state=TrackState.CONFIRMED,
            time_ns=now_ns,
            measured_ns=now_ns,
            born_ns=now_ns,
            score=0.9,
            box_xyxy_px=np.array([950.0, 530.0, 970.0, 550.0]),
            R_cam_target=R_FORWARD_CAM.T,
            t_cam_target_m=t_cam_m,
            covariance=covariance,
            R_ned_target=np.eye(3),
            t_ned_target_m=own_m + R_FORWARD_CAM @ t_cam_m,
            v_ned_target_mps=np.array([21.0, 0.0, 0.0]),
            covariance_ned=covariance_ned,
        )
        for number in range(targets)
    )
    return Report(FrameMeta(sequence, now_ns, now_ns), _K, (1920, 1080), tracks, own)


def snapshot(tracks: int, fps: float) -> HealthSnapshot:
    """Health of the daemon's usual size."""
    stages = ("capture", "wait", "preprocess", "inference", "decode", "track", "publish", "total")
    condition = Condition(HealthState.TRACKING, Activity.TRACKING)
    latency = {stage: Percentiles(5.0, 6.0, 7.0) for stage in stages}
    counters = {"capture_dropped": 0, "frames": 1000, "tracks_withheld": 0, "reports_replaced": 0}
    return HealthSnapshot(time.monotonic_ns(), condition, tracks, fps, counters, latency)


def fly(link: ZenohLink, fps: float, targets: int, stop: threading.Event) -> None:
    """Publish at this rate until `stop`, health and an event each second."""
    begun_s = time.monotonic()
    sequence, next_event_s = 0, begun_s
    while not stop.wait(max(begun_s + sequence / fps - time.monotonic(), 0.0)):
        link.publish(report(sequence, targets))
        if time.monotonic() >= next_event_s:
            link.publish_diagnostics(snapshot(targets, fps))
            link.publish_event(20, f"frame {sequence}")
            next_event_s += EVENT_S
        sequence += 1


def _settings(args: argparse.Namespace) -> ZenohSettings:
    tls = None
    if args.ca is not None:
        tls = ZenohTlsSettings(root_ca=args.ca, certificate=args.cert, private_key=args.key)
    return ZenohSettings(listen=[], connect=[args.connect], tls=tls, pose_rate_max_hz=args.pose_rate_max)


def main() -> int:
    parser = argparse.ArgumentParser(prog="sim_replay.radio.vehicle", description=__doc__)
    parser.add_argument("--uav", default="uav1")
    parser.add_argument("--connect", required=True, metavar="ENDPOINT")
    parser.add_argument("--ca", type=Path, metavar="PEM")
    parser.add_argument("--cert", type=Path, metavar="PEM")
    parser.add_argument("--key", type=Path, metavar="PEM")
    parser.add_argument("--fps", type=float, default=20.0)
    parser.add_argument("--targets", type=int, default=1)
    parser.add_argument("--pose-rate-max", type=float, metavar="HZ", help="as [zenoh] has it")
    args = parser.parse_args()
    stop = threading.Event()
    link = ZenohLink(_settings(args), args.uav, MountSettings().mount())
    link.start()
    print(json.dumps({"ready": args.uav}), flush=True)
    if sys.stdin.readline():
        sender = threading.Thread(target=fly, args=(link, args.fps, args.targets, stop), name="loop", daemon=True)
        sender.start()
        sys.stdin.readline()
        stop.set()
        sender.join()
        print(json.dumps({"counters": link.counters()}), flush=True)
        sys.stdin.readline()
    link.stop()
    return 0


if __name__ == "__main__":
    sys.exit(main())
