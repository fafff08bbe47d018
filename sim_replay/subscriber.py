"""A zenoh subscriber as an integrator would write one: it knows `msgs` and nothing else of the project.

    python -m sim_replay.subscriber --connect tcp/127.0.0.1:7448 --uav uav1

Prints one JSON object a line: `ready`, each valid `pose`, each `diagnostics`, and a `summary` of samples by topic
and refusals by reason when it is told to stop (SIGTERM, SIGINT) or the process that started it ends.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import sys
import threading
import time
from typing import Any

import zenoh

from msgs import topics
from msgs.cdr import DiagnosticArray
from msgs.client import connect, subscribe_all
from msgs.receive import TargetPose
from msgs.signals import stop_on_signals
from msgs.wire import PayloadError

_POLL_S = 0.2
_RETRY_S = 0.1


def pose_record(pose: TargetPose) -> dict[str, Any]:
    """The `pose` line of one that was taken."""
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


def _diagnostics_record(payload: bytes) -> dict[str, Any] | None:
    try:
        array = DiagnosticArray.decode(payload)
    except PayloadError:
        return None
    values = {key: value for status in array.status for key, value in status.values}
    message = "; ".join(status.message for status in array.status)
    return {"event": "diagnostics", "stamp_utc_ns": array.stamp_ns, "message": message, "values": values}


def _connect(endpoint: str, wait_s: float, stop: threading.Event) -> zenoh.Session:
    """A session with the daemon, however late it starts. Raises ConnectionError after `wait_s` and on `stop`."""
    deadline = time.monotonic() + wait_s
    while True:
        try:
            return connect(endpoint)
        except ConnectionError:
            if stop.wait(_RETRY_S) or time.monotonic() > deadline:
                raise


def _listen(session: zenoh.Session, uav: str, stop: threading.Event) -> dict[str, Any]:
    """Print what arrives until `stop` is set or the parent process is gone; returns the summary."""
    records: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    parent = os.getppid()

    def on_diagnostics(sample: zenoh.Sample) -> None:
        record = _diagnostics_record(sample.payload.to_bytes())
        if record is not None:
            records.put(record)

    counts = subscribe_all(session, uav, lambda pose: records.put(pose_record(pose)))
    handler = zenoh.handlers.Callback(on_diagnostics, indirect=False)
    diagnostics = session.declare_subscriber(topics.subscription_key(topics.DIAGNOSTICS, uav), handler)
    _emit({"event": "ready"})
    while not stop.is_set() and os.getppid() == parent:
        try:
            _emit(records.get(timeout=_POLL_S))
        except queue.Empty:
            continue
    diagnostics.undeclare()
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
    args = parser.parse_args(argv)
    stop = stop_on_signals()
    try:
        with _connect(args.connect, args.wait_s, stop) as session:
            summary = _listen(session, args.uav, stop)
    except ConnectionError as error:
        print(error, file=sys.stderr)
        return 1
    _emit(summary)
    return 0


if __name__ == "__main__":
    sys.exit(main())
