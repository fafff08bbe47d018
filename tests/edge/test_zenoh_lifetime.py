"""A zenoh link begins and ends, and so does the ground: real sessions on loopback."""

from __future__ import annotations

import subprocess
import sys
import threading
import time

import pytest
import zenoh

from edge.config import ZenohSettings
from edge.links.errors import LinkError
from edge.links.zenoh_link import ZenohLink
from msgs.session import router_config
from sim_replay.ports import free_endpoint
from tests.waiting import until

from .reports import make_report as report
from .reports import make_track as track
from .test_zenoh_link import MOUNT, linked


def test_the_ground_may_come_later_than_the_daemon_and_come_again() -> None:
    ground = free_endpoint()
    with linked(free_endpoint(), connect=[ground]) as link:
        for _ in range(2):
            with zenoh.open(router_config([ground])) as router:
                came = threading.Event()
                handler = zenoh.handlers.Callback(lambda _, came=came: came.set(), indirect=False)
                subscriber = router.declare_subscriber("0/uav1/target/**", handler)
                until(came.is_set, lambda: link.publish(report(track(time.monotonic_ns()))), what="a sample")
                until(lambda: link.counters()["links"] == 1, what="the count of links")
                subscriber.undeclare()
            gone = lambda: link.publish(report(track(time.monotonic_ns())))  # noqa: E731
            until(lambda: link.counters()["links"] == 0, gone, what="its going")


def test_the_ground_sees_that_the_daemon_is_there_and_that_it_has_gone() -> None:
    endpoint, tool = free_endpoint(), free_endpoint()
    with zenoh.open(router_config([tool])) as ground:

        def alive() -> list[str]:
            return [str(reply.ok.key_expr) for reply in ground.liveliness().get("uavpose/@v1/*/alive") if reply.ok]

        with linked(endpoint, connect=[tool]):
            until(lambda: alive() == ["uavpose/@v1/uav1/alive"], what="sight of the daemon")
        until(lambda: alive() == [], what="its going")


def test_a_port_that_is_taken_is_a_sentence() -> None:
    endpoint = free_endpoint()
    with linked(endpoint):
        second = ZenohLink(ZenohSettings(listen=[endpoint]), "uav1", MOUNT)
        with pytest.raises(LinkError, match=f"^{endpoint} is in use: does another daemon run"):
            second.start()
        second.stop()


def test_the_process_ends_when_the_link_is_stopped() -> None:
    script = (
        "import sys\n"
        "from edge.config import MountSettings, ZenohSettings\n"
        "from edge.links.zenoh_link import ZenohLink\n"
        "link = ZenohLink(ZenohSettings(listen=[sys.argv[1]]), 'uav1', MountSettings().mount())\n"
        "link.start()\n"
        "link.publish_event(20, 'bye')\n"
        "link.stop()\n"
        "assert link.counters()['sent_events'] == 1, 'what waited was sent'\n"
    )
    done = subprocess.run([sys.executable, "-c", script, free_endpoint()], timeout=60, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
