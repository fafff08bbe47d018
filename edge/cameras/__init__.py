"""Camera sources and the supply of frames to the loop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol

from edge.cameras.capture import Capture
from edge.cameras.device import DeviceSource
from edge.cameras.file import FileSource
from edge.cameras.folder import FolderSource
from edge.cameras.live import LiveSource
from edge.cameras.lockstep import LockstepCapture
from edge.cameras.sequence import SequenceSource
from edge.cameras.source import Source, SourceLost
from edge.cameras.stream import StreamSource
from edge.config_camera import (
    CameraSettings,
    DeviceCamera,
    FileCamera,
    FolderCamera,
    SequenceCamera,
    StreamCamera,
    ZenohCamera,
)
from edge.health import Reason
from edge.types import CameraInfo, Frame

if TYPE_CHECKING:
    from edge.cameras.zenoh_topic import ZenohSource


class FrameSupply(Protocol):
    """Supplies the loop with frames."""

    def start(self, settle: Callable[[], None], stopped: Callable[[], bool]) -> None:
        """Begin; `settle` makes the links send everything queued, and `stopped` tells whether the daemon is to end, for
        a supply that waits. Raises EndOfStream if there is no first frame to wait for any more."""

    def newest(self, timeout_s: float) -> Frame | None:
        """The newest frame not yet taken, waiting up to `timeout_s`. Raises EndOfStream after the last."""

    def reasons(self, now_ns: int) -> tuple[Reason, ...]:
        """Faults of the camera at `now_ns` (monotonic)."""

    def counters(self) -> Mapping[str, int]:
        """Frames captured, and faults, by name."""

    def stop(self) -> None:
        """Stop and close the camera."""


def open_capture(settings: CameraSettings) -> tuple[FrameSupply, CameraInfo]:
    """The frame supply of the configured camera, to be started and stopped, and its properties. Raises InputError."""
    source, info, opened = open_source(settings)
    if isinstance(settings, SequenceCamera) and settings.lockstep is not None and isinstance(source, SequenceSource):
        return LockstepCapture(source, settings.lockstep), info
    return Capture(source, opened), info


def open_source(settings: CameraSettings) -> tuple[Source, CameraInfo, bool]:
    """The configured source, its properties, and whether it is open.

    A live camera that does not answer yet is not an error: it is opened later. Raises InputError if it never can be.
    """
    if isinstance(settings, SequenceCamera | FolderCamera | FileCamera):
        recording = _recording(settings)
        return recording, recording.open(), True
    live = _live(settings)
    try:
        return live, live.open(), True
    except SourceLost:
        return live, live.nominal(), False


def _recording(settings: SequenceCamera | FolderCamera | FileCamera) -> SequenceSource | FileSource:
    if isinstance(settings, FileCamera):
        return FileSource(settings)
    return FolderSource(settings) if isinstance(settings, FolderCamera) else SequenceSource(settings)


def _live(settings: DeviceCamera | StreamCamera | ZenohCamera) -> LiveSource | ZenohSource:
    if isinstance(settings, ZenohCamera):
        # Imported here: a daemon without zenoh does not load it.
        from edge.cameras.zenoh_topic import ZenohSource

        return ZenohSource(settings)
    return DeviceSource(settings) if isinstance(settings, DeviceCamera) else StreamSource(settings)
