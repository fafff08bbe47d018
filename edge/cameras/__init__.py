"""Where frames come from."""

from __future__ import annotations

from edge.cameras.file import FileSource
from edge.cameras.live import LiveSource
from edge.cameras.sequence import SequenceSource
from edge.cameras.source import Source
from edge.config import CameraSettings, FileCamera, SequenceCamera


def make_source(settings: CameraSettings) -> Source:
    """The source of the configured type, not yet open. Raises InputError on an unreadable calibration."""
    if isinstance(settings, SequenceCamera):
        return SequenceSource(settings)
    if isinstance(settings, FileCamera):
        return FileSource(settings)
    return LiveSource(settings)
