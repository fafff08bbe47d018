"""Where frames come from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from edge.cameras.device import DeviceSource
from edge.cameras.file import FileSource
from edge.cameras.folder import FolderSource
from edge.cameras.live import LiveSource
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
from edge.types import CameraInfo

if TYPE_CHECKING:
    from edge.cameras.zenoh_topic import ZenohSource


def open_source(settings: CameraSettings) -> tuple[Source, CameraInfo, bool]:
    """The configured source, what it gives, and whether it is open.

    A live camera that does not answer yet is no error: it is opened later. Raises InputError when none ever will.
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
        # Not at the top: a daemon without zenoh does not load it.
        from edge.cameras.zenoh_topic import ZenohSource

        return ZenohSource(settings)
    return DeviceSource(settings) if isinstance(settings, DeviceCamera) else StreamSource(settings)
