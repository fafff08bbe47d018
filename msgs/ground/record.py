"""`uavpose-ground record`: records the vehicles' messages as MCAP on the ground station."""

from __future__ import annotations

import errno
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from msgs import topics
from msgs.ground.errors import InputError
from msgs.ground.feed import Incoming, linked, listening, session
from msgs.mcap_file import Publisher
from msgs.recording import Recorder
from msgs.recording_store import RecordingLimits
from msgs.session import TlsFiles

STEM = "ground"
_PERIOD_S = 1.0


def record(
    endpoint: str,
    tls: TlsFiles | None,
    uavs: Sequence[str],
    domain: int,
    folder: Path,
    limits: RecordingLimits,
    stop: threading.Event,
    say: Callable[[str], None],
) -> int:
    """Record these vehicles, all if none is named, until `stop` is set. Samples are not validated.

    Returns 0, or 1 if the disk has not taken all that was received.

    Raises InputError for a bad endpoint, and for a folder that cannot be written.
    """
    _check_writable(folder)
    recorder = Recorder(folder, STEM, limits, lambda _, text: say(text))

    def take(one: Incoming) -> None:
        attachment = topics.parse_attachment(one.attachment)
        _, publish_ns, gid = attachment if attachment is not None else (0, time.time_ns(), b"")
        publisher = Publisher(one.sender, gid.hex())
        recorder.record(one.topic, one.uav, one.target, one.payload, max(publish_ns, 0), publisher)

    def alive(uav: str, here: bool) -> None:
        say(f"{uav}: {'here' if here else 'gone'}")

    with session(endpoint, tls, stop, say) as opened:
        if opened is None:
            return 0
        recorder.start()
        with listening(opened, uavs, domain, take, alive):
            say(f"recording into {folder}")
            up = True
            while not stop.wait(_PERIOD_S):
                if linked(opened) != up:
                    up = not up
                    say(f"{endpoint}: {'up' if up else 'no link'}")
        recorder.stop()
    counters = recorder.counters()
    say(", ".join(f"{name} {count}" for name, count in counters.items()))
    return 1 if counters.get("lost") else 0


def _check_writable(folder: Path) -> None:
    """Fail at the start: the recorder itself writes nothing until the first sample, which may be in flight."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        # Not on a full disk: the recorder will remove old recordings or report it.
        if error.errno not in (errno.ENOSPC, errno.EDQUOT):
            raise InputError(f"--dir {folder}: cannot be written: {error.strerror}") from error
