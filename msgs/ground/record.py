"""`uavpose-ground record`: what vehicles tell, as MCAP on the ground's disk."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from msgs import topics
from msgs.ground.feed import Incoming, linked, listening, session
from msgs.recording import Recorder, RecordingLimits
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
    """Record these vehicles, all if none is named, until `stop` is set; 0. Samples are kept as they came, sound or not.

    Raises InputError for a bad endpoint.
    """
    recorder = Recorder(folder, STEM, limits, lambda _, text: say(text))

    def take(one: Incoming) -> None:
        attachment = topics.parse_attachment(one.attachment)
        publish_ns = attachment[1] if attachment is not None else time.time_ns()
        recorder.record(one.topic, one.uav, one.target, one.payload, max(publish_ns, 0))

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
    say(", ".join(f"{name} {count}" for name, count in recorder.counters().items()))
    return 0
