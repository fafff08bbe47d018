"""All links as one: the loop's output goes to each enabled link, and none of them blocks the loop."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from typing import TYPE_CHECKING

from edge import clock
from edge.health import Condition, HealthSnapshot, HealthState
from edge.requests import AskReload, RequestQueue
from edge.tracking.own_ship import OwnShipBuffer
from edge.types import Frame, Report

if TYPE_CHECKING:
    from edge.links.mavlink_link import MavlinkLink
    from edge.links.zenoh_link import ZenohLink
    from edge.pictures import Pictures
    from edge.status_board import StatusBoard
    from msgs.recording import Recorder

log = logging.getLogger(__name__)

# Python's logging levels equal those of rcl_interfaces/Log; MAV_SEVERITY counts in the opposite direction.
LEVELS = {HealthState.DEGRADED: logging.WARNING, HealthState.FAULT: logging.ERROR}
MAV_SEVERITY = {logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3}


class Outlets:
    """The running links that are enabled. Peers may come and go; only our own endpoints must be free."""

    def __init__(
        self,
        zenoh: ZenohLink | None,
        mavlink: MavlinkLink | None,
        recorder: Recorder | None = None,
        pictures: Pictures | None = None,
    ) -> None:
        self._zenoh = zenoh
        self._mavlink = mavlink
        self._recorder = recorder
        self._pictures = pictures

    def publish(self, report: Report) -> None:
        if self._mavlink is not None:
            self._mavlink.publish(report)
        if self._zenoh is not None:
            self._zenoh.publish(report)

    def show(self, frame: Frame) -> None:
        """The picture itself, for viewers and recordings."""
        if self._pictures is not None:
            self._pictures.show(frame)

    def set_health(self, condition: Condition) -> None:
        """To be called in every iteration of the loop, so that HEARTBEAT, which depends on it, stops with the loop."""
        if self._mavlink is not None:
            self._mavlink.set_health(condition)

    def tell(self, condition: Condition) -> None:
        """Report a change of state as an event."""
        self._say(LEVELS.get(condition.state, logging.INFO), str(condition), of_state=True)

    def event(self, level: int, text: str) -> None:
        """A message for the operator; may be called from any thread."""
        self._say(level, text)

    def _say(self, level: int, text: str, of_state: bool = False) -> None:
        text = text.encode(errors="backslashreplace").decode()  # a path need not be UTF-8; the log escapes it alike
        if self._mavlink is not None:
            self._mavlink.event(MAV_SEVERITY[level], text, of_state)
        if self._zenoh is not None:
            self._zenoh.publish_event(level, text)

    def last_event(self, level: int, text: str) -> None:
        """The last event: returns when each link has sent it and ended."""
        self.event(level, text)
        for link in (self._pictures, self._mavlink, self._zenoh, self._recorder):
            if link is not None:
                link.stop()

    def publish_diagnostics(self, snapshot: HealthSnapshot) -> None:
        if self._zenoh is not None:
            self._zenoh.publish_diagnostics(snapshot)

    def threads(self) -> frozenset[str]:
        """Names of the links' threads, running or not."""
        links = {
            "zenoh": self._zenoh,
            "recorder": self._recorder,
            "mavlink": None if clock.stepped() else self._mavlink,
        }
        return frozenset(name for name, link in links.items() if link is not None)

    def settle(self) -> None:
        """In lock-step mode: return when all output is sent and all input is processed."""
        if self._mavlink is not None:
            self._mavlink.settle()
        if self._zenoh is not None:
            self._zenoh.settle()

    def counters(self) -> dict[str, int]:
        links = {
            "zenoh": self._zenoh,
            "mavlink": self._mavlink,
            "recorder": self._recorder,
            "pictures": self._pictures,
        }
        return {f"{name}_{key}": n for name, link in links.items() if link for key, n in link.counters().items()}


def start_outlets(
    board: StatusBoard, own_ship: OwnShipBuffer, requests: RequestQueue, reload: AskReload, cleanup: ExitStack
) -> Outlets:
    """Start the enabled links, to be stopped by `cleanup`. A disabled link is not even imported.

    Over zenoh, the board answers status queries.

    Raises InputError (LinkError) when an endpoint of our own cannot be opened.
    """
    file, config = board.file, board.file.config
    zenoh: ZenohLink | None = None
    mavlink: MavlinkLink | None = None
    recorder: Recorder | None = None
    pictures: Pictures | None = None
    if config.zenoh.enabled or config.recorder.enabled:
        from edge.links.zenoh_link import ZenohLink
        from msgs.recording import Recorder

        def tell(level: int, text: str) -> None:
            log.log(level, "%s", text)
            outlets.event(level, text)

        recorder = Recorder(
            config.recorder.folder,
            config.vehicle.name,
            config.recorder.limits(),
            tell,
            on=config.recorder.enabled,
        )
        cleanup.callback(recorder.stop)
        if config.zenoh.enabled and config.zenoh.tls is not None:
            doubt = config.zenoh.tls.files().doubt()
            if doubt is not None:
                log.warning("there may be no link over tls and quic: %s", doubt)
        if (unheard := config.zenoh.unheard(config.vehicle.name)) is not None:
            log.warning("the ground may hear nothing: %s", unheard)
        with file.blame("zenoh", "listen"):
            zenoh = ZenohLink(config.zenoh, config.vehicle.name, config.mount.mount(), recorder, requests, reload)
            cleanup.callback(zenoh.stop)
            zenoh.start()
        from edge.pictures import Pictures

        pictures = Pictures(zenoh, config.zenoh.image_max_hz, config.recorder.image_max_hz)
        cleanup.callback(pictures.stop)
        pictures.start()
        if zenoh.session is not None:
            from edge.status_board import declare_status

            cleanup.callback(declare_status(zenoh.session, board))
    if config.mavlink.enabled:
        from edge.links.mavlink_link import MavlinkLink, signing_of

        with file.blame("mavlink", "signing_key"):
            signing = signing_of(config.mavlink)
        with file.blame("mavlink", "endpoints"):
            mavlink = MavlinkLink(config.mavlink, own_ship, board.camera, requests, signing)
            cleanup.callback(mavlink.stop)
            mavlink.start()
    outlets = Outlets(zenoh, mavlink, recorder, pictures)
    if recorder is not None:
        recorder.start()
    if config.health.prometheus_port is not None:
        from edge.prometheus import MetricsServer

        with file.blame("health", "prometheus_port"):
            cleanup.callback(MetricsServer(board, config.health.prometheus_port).stop)
    return outlets
