"""Where frames come from."""

from __future__ import annotations

from edge.cameras.file import FileSource
from edge.cameras.live import LiveSource
from edge.cameras.sequence import SequenceSource
from edge.cameras.source import Source, SourceLost
from edge.config import CameraSettings, FileCamera, SequenceCamera
from edge.types import CameraInfo


def open_source(settings: CameraSettings) -> tuple[Source, CameraInfo, bool]:
    """The configured source, what it gives, and whether it is open.

    A live camera that does not answer yet is no error: it is opened later. Raises InputError when none ever will.
    """
    if isinstance(settings, SequenceCamera | FileCamera):
        recording = SequenceSource(settings) if isinstance(settings, SequenceCamera) else FileSource(settings)
        return recording, recording.open(), True
    live = LiveSource(settings)
    try:
        return live, live.open(), True
    except SourceLost:
        return live, live.nominal(), False
