"""Real zenoh sessions on loopback: explicit endpoints, no discovery."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import pytest
import zenoh

from msgs import cdr, session
from sim_replay.ports import free_endpoint
from tests.waiting import until


def pose_now(z_m: float = 300.0, age_s: float = 0.0) -> cdr.PoseWithCovarianceStamped:
    stamp_ns = time.time_ns() - round(age_s * 1e9)
    t, q = np.array([1.0, 2.0, z_m]), np.array([0.0, 0.0, 0.0, 1.0])
    return cdr.PoseWithCovarianceStamped(stamp_ns, "camera_optical_frame", t, q, np.eye(6))


@dataclass(frozen=True)
class Network:
    """A daemon's peer and the ground's router that it connects to."""

    endpoint: str
    daemon: zenoh.Session
    router: zenoh.Session


@pytest.fixture
def network() -> Iterator[Network]:
    endpoint = free_endpoint()
    with ExitStack() as stack:
        router = stack.enter_context(zenoh.open(session.router_config([endpoint])))
        config = session.peer_config([free_endpoint()], [endpoint])
        config.insert_json5("scouting/delay", "0")  # zenoh waits as long although they are connected at once
        daemon = stack.enter_context(zenoh.open(config))
        until(lambda: list(daemon.info.routers_zid()), what="the daemon's connection to the router")
        yield Network(endpoint, daemon, router)
