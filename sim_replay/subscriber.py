"""A zenoh subscriber as an integrator would write one: it knows `msgs` and nothing else of the project.

    python -m sim_replay.subscriber --connect tcp/127.0.0.1:7448 --uav uav1

Prints one JSON object per line: `ready`, each valid `pose` and `direction`, each `diagnostics`, with --all each
`sample`, valid or not, of the topics with a timestamp other than poses, and a `summary` of samples by topic and
refusals by reason when it is told to stop (SIGTERM, SIGINT).
"""

from __future__ import annotations

import argparse
import functools
import json
import queue
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import zenoh

from msgs import topics
from msgs.cdr import Detection3DArray, DiagnosticArray, Odometry, TFMessage, Vector3Stamped
from msgs.client import connect, subscribe_all
from msgs.command_line import exit_code
from msgs.receive import TargetDirection, TargetPose
from msgs.signals import stop_on_signals
from msgs.wire import PayloadError

TIMED = (topics.ODOM, topics.DIRECTION, topics.DETECTIONS, topics.TF)
MAX_AGE_S = 1.0
_POLL_S = 0.2
_RETRY_S = 0.1


def pose_record(pose: TargetPose) -> dict[str, Any]:
    """The `pose` line of an accepted pose."""
    x, y, z, w = pose.pose.q_cam_target_xyzw.tolist()
    return {
        "event": "pose",
        "target": pose.target,
        "capture_utc_ns": pose.stamp_ns,
        "age_ms": round(pose.age_s * 1e3, 3),
        "t_cam_target_m": pose.pose.t_cam_target_m.tolist(),
        "rotation_known": pose.rotation_known,
        "q_cam_target_wxyz": [w, x, y, z],
        "covariance": pose.pose.covariance.tolist(),
    }


def direction_record(seen: TargetDirection) -> dict[str, Any]:
    """The `direction` line of an accepted direction."""
    return {
        "event": "direction",
        "target": seen.target,
        "capture_utc_ns": seen.stamp_ns,
        "age_ms": round(seen.age_s * 1e3, 3),
        "ray_cam": seen.ray_cam.tolist(),
    }


def _diagnostics_record(payload: bytes) -> dict[str, Any] | None:
    try:
        array = DiagnosticArray.decode(payload)
    except PayloadError:
        return None
    values = {key: value for status in array.status for key, value in status.values}
    message = "; ".join(status.message for status in array.status)
    return {"event": "diagnostics", "stamp_utc_ns": array.stamp_ns, "message": message, "values": values}


def sample_record(topic: topics.Topic, payload: bytes, now_utc_ns: int) -> dict[str, Any]:
    """The `sample` line of a topic in TIMED: its stamp, age and content, or why it cannot be read."""
    told: dict[str, Any] = {"event": "sample", "topic": topic.name.rpartition("/")[2]}
    try:
        stamp_ns, content = _content(topic, payload)
    except PayloadError as error:
        return {**told, "unreadable": str(error)}
    return {**told, "stamp_utc_ns": stamp_ns, "age_ms": round((now_utc_ns - stamp_ns) / 1e6, 3), **content}


def _content(topic: topics.Topic, payload: bytes) -> tuple[int, dict[str, Any]]:
    if topic is topics.ODOM:
        odometry = Odometry.decode(payload)
        return odometry.stamp_ns, {"frame_id": odometry.frame_id, "t_m": odometry.t_ned_target_m.tolist()}
    if topic is topics.DIRECTION:
        seen = Vector3Stamped.decode(payload)
        return seen.stamp_ns, {"ray_cam": seen.ray_cam.tolist()}
    if topic is topics.DETECTIONS:
        array = Detection3DArray.decode(payload)
        return array.stamp_ns, {"targets": [one.id for one in array.detections]}
    transforms = TFMessage.decode(payload).transforms
    turned = {one.child_frame_id: one.q_frame_child_xyzw.tolist() for one in transforms}
    return min((one.stamp_ns for one in transforms), default=0), {"q_xyzw": turned}


def _connect(endpoint: str, wait_s: float, stop: threading.Event) -> zenoh.Session:
    """A session with the daemon, however late it starts.

    Raises ConnectionError after `wait_s`, and on `stop`.
    """
    deadline = time.monotonic() + wait_s
    while True:
        try:
            return connect(endpoint)
        except ConnectionError:
            if stop.wait(_RETRY_S) or time.monotonic() > deadline:
                raise


def _listen(
    session: zenoh.Session, uav: str, stop: threading.Event, everything: bool, max_age_s: float
) -> dict[str, Any]:
    """Print what arrives until `stop` is set; returns the summary."""
    records: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()

    def on_diagnostics(sample: zenoh.Sample) -> None:
        record = _diagnostics_record(sample.payload.to_bytes())
        if record is not None:
            records.put(record)

    def on_sample(topic: topics.Topic, sample: zenoh.Sample) -> None:
        records.put(sample_record(topic, sample.payload.to_bytes(), time.time_ns()))

    counts = subscribe_all(
        session,
        uav,
        lambda pose: records.put(pose_record(pose)),
        lambda seen: records.put(direction_record(seen)),
        max_age_s=max_age_s,
    )
    takers: list[tuple[topics.Topic, Callable[[zenoh.Sample], None]]] = [(topics.DIAGNOSTICS, on_diagnostics)]
    if everything:
        takers += [(topic, functools.partial(on_sample, topic)) for topic in TIMED]
    subscribers = [
        session.declare_subscriber(topics.subscription_key(topic, uav), zenoh.handlers.Callback(taker, indirect=False))
        for topic, taker in takers
    ]
    _emit({"event": "ready"})
    while not stop.is_set():
        try:
            _emit(records.get(timeout=_POLL_S))
        except queue.Empty:
            continue
    for subscriber in subscribers:
        subscriber.undeclare()
    counts.close()
    while not records.empty():
        _emit(records.get())
    refused = {reason.name: count for reason, count in counts.refused().items()}
    return {"event": "summary", "received": counts.counts(), "refused": refused}


def _emit(record: dict[str, Any]) -> None:
    sys.stdout.write(json.dumps(record) + "\n")
    sys.stdout.flush()


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m sim_replay.subscriber", description=__doc__.splitlines()[0])
    parser.add_argument("--connect", required=True, help="zenoh endpoint of the daemon, e.g. tcp/127.0.0.1:7448")
    parser.add_argument("--uav", default="uav1", help="name of the vehicle")
    parser.add_argument("--wait-s", type=float, default=30.0, help="how long the daemon may take to appear")
    parser.add_argument("--all", action="store_true", help="print a line for odometry, detections and transforms too")
    parser.add_argument(
        "--max-age-s", type=float, default=MAX_AGE_S, help="what comes later than this is refused (%(default)s)"
    )
    args = parser.parse_args(argv)
    stop = stop_on_signals()
    try:
        with _connect(args.connect, args.wait_s, stop) as session:
            summary = _listen(session, args.uav, stop, args.all, args.max_age_s)
    except ConnectionError as error:
        print(error, file=sys.stderr)
        return 1
    _emit(summary)
    return 0


if __name__ == "__main__":
    sys.exit(exit_code(main, ()))
