"""Metrics for Prometheus in its text format, served on loopback only, by a separate thread."""

from __future__ import annotations

import errno
import socket
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from edge.errors import InputError
from edge.health import Activity, HealthState
from edge.stages import STAGES
from edge.status_board import StatusBoard

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
RETRY_S = 0.2  # until a caller is accepted again, if the process has no file descriptor left
QUANTILES = {"p50": "0.5", "p95": "0.95", "p99": "0.99"}


def metrics(board: StatusBoard) -> str:
    """All metrics, in seconds and counts; without the state during the first second."""
    return "\n".join(_lines(board)) + "\n"


def _lines(board: StatusBoard) -> Iterator[str]:
    info = board.info()
    labels = ",".join(f"{name}={_quoted(info[name])}" for name in ("vehicle", "version", "model_sha256"))
    yield from _metric("uavpose_info", "gauge", "what flies")
    yield f"uavpose_info{{{labels}}} 1"
    yield from _metric("uavpose_uptime_seconds", "gauge", "since the start")
    yield f"uavpose_uptime_seconds {info['uptime_s']}"
    if "state" not in info:
        return
    yield from _metric("uavpose_state", "gauge", "1 for the state that holds")
    for state in HealthState:
        yield f"uavpose_state{{state={_quoted(state.value)}}} {int(state.value == info['state'])}"
    yield from _metric("uavpose_activity", "gauge", "1 for what it does, degraded or not")
    for activity in Activity:
        yield f"uavpose_activity{{activity={_quoted(activity.value)}}} {int(activity.value == info['activity'])}"
    yield from _metric("uavpose_reasons", "gauge", "why it is not well: how many reasons hold")
    yield f"uavpose_reasons {len(info['reason_kinds'])}"
    if info["reason_kinds"]:
        yield from _metric("uavpose_reason", "gauge", "1 for each that holds; absent else")
    for kind in info["reason_kinds"]:
        yield f"uavpose_reason{{kind={_quoted(kind)}}} 1"
    for name, key, text in (
        ("uavpose_tracks", "tracks", "targets confirmed or coasting"),
        ("uavpose_frame_rate_hertz", "frame_rate_hz", "frames a second, done"),
        ("uavpose_snapshot_age_seconds", "age_s", "age of these figures; grows when the loop stands still"),
    ):
        yield from _metric(name, "gauge", text)
        yield f"{name} {info[key]}"
    yield from _metric("uavpose_count", "untyped", "by name: frames, poses, drops, messages, refusals since the start")
    for name, count in info["counters"].items():
        yield f"uavpose_count{{name={_quoted(name)}}} {count}"
    yield from _metric("uavpose_stage_seconds", "gauge", f"by stage over the last frames: {', '.join(STAGES)}")
    for stage, percentiles in info["latency_ms"].items():
        for name, quantile in QUANTILES.items():
            label = f"stage={_quoted(stage)},quantile={_quoted(quantile)}"
            yield f"uavpose_stage_seconds{{{label}}} {percentiles[name] / 1e3:.6f}"


def _metric(name: str, kind: str, text: str) -> Iterator[str]:
    yield f"# HELP {name} {text}"
    yield f"# TYPE {name} {kind}"


def _quoted(value: object) -> str:
    text = str(value).replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
    return f'"{text}"'


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def get_request(self) -> tuple[socket.socket, Any]:
        try:
            return super().get_request()
        except OSError as error:
            # Such a caller stays pending and would wake the server without end.
            if error.errno in (errno.EMFILE, errno.ENFILE):
                time.sleep(RETRY_S)
            raise

    def handle_error(self, request: object, client_address: object) -> None:
        """socketserver prints a traceback. A client that breaks off its connection is not worth one."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)  # type: ignore[arg-type]


class MetricsServer:
    """Serves `/metrics` on 127.0.0.1. Raises InputError if the port is taken."""

    def __init__(self, board: StatusBoard, port: int) -> None:
        class Handler(BaseHTTPRequestHandler):
            timeout = 5.0  # limits how long a silent client occupies its thread

            def do_GET(self) -> None:
                if self.path.partition("?")[0] != "/metrics":  # a scrape may have parameters
                    self.send_error(404)
                    return
                body = metrics(board).encode()
                self.send_response(200)
                self.send_header("Content-Type", CONTENT_TYPE)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: object) -> None:
                """Scrapes are not logged."""

        try:
            self._server = _Server(("127.0.0.1", port), Handler)
        except OSError as error:
            raise InputError(f"port {port} of 127.0.0.1 cannot be served: {error.strerror}") from error
        self._thread = threading.Thread(target=self._server.serve_forever, name="prometheus", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()
