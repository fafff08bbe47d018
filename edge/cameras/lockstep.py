"""A sequence in lock-step mode: over a socket, a player sets time and frames, and waits for the end of each step.

One line per step, answered with `ok` when the loop has processed it and the links have sent its output:

    time NS      set the time to NS (monotonic); what peers sent before is received
    frame INDEX  frame INDEX of the sequence is exposed now

`ready` is sent first, when the daemon is warm. The recording ends when the player disconnects.
"""

from __future__ import annotations

import select
import socket
from collections.abc import Callable

from edge import clock
from edge.cameras.sequence import SequenceSource
from edge.cameras.source import EndOfStream
from edge.errors import InputError
from edge.health import Reason
from edge.types import Frame

CONNECT_TIMEOUT_S = 10.0
LOOK_EVERY_S = 0.1
LINE_MAX = 64


class LockstepCapture:
    """Replaces `Capture`, but works in the loop's own thread. Once it is created, only the player advances the time."""

    def __init__(self, source: SequenceSource, address: str) -> None:
        """`address` is the player's HOST:PORT. Raises InputError if nobody answers there."""
        self._source = source
        self._settle: Callable[[], None] = lambda: None
        self._frames = 0
        self._owes_answer = False
        self._unread = b""
        host, _, port = address.rpartition(":")
        try:
            self._player = socket.create_connection((host, int(port)), CONNECT_TIMEOUT_S)
        except OSError as error:
            raise InputError(
                f"no player answers at {address}: {error.strerror or error}", ("camera", "lockstep")
            ) from error
        self._player.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        clock.step_to(0)

    def start(self, settle: Callable[[], None], stopped: Callable[[], bool] = lambda: False) -> None:
        """Send `ready` and wait for the first step: before it the time is not set.

        `settle` makes the links send everything queued. Raises EndOfStream if the player has disconnected, or once
        `stopped` tells that the daemon is to end.
        """
        self._settle = settle
        self._say("ready")
        while (line := self._line(LOOK_EVERY_S)) is None:
            if stopped():
                raise EndOfStream
        self._obey(line)

    def newest(self, timeout_s: float) -> Frame | None:
        """Execute the player's next step, waiting up to `timeout_s` for it; returns the frame, if it was one.

        Raises EndOfStream if the player has disconnected, InputError for a frame that the sequence does not have.
        """
        if self._owes_answer:
            self._settle()
            self._say("ok")
            self._owes_answer = False
        line = self._line(timeout_s)
        return None if line is None else self._obey(line)

    def reasons(self, _: int) -> tuple[Reason, ...]:
        """This camera never has faults."""
        return ()

    def counters(self) -> dict[str, int]:
        """captured: frames requested so far; none is ever dropped."""
        return {"captured": self._frames, "dropped": 0}

    def stop(self) -> None:
        """Disconnect and close the sequence."""
        self._player.close()
        self._source.close()

    def _obey(self, line: str) -> Frame | None:
        word, _, number = line.partition(" ")
        if not number.isdecimal() or word not in ("time", "frame"):
            raise InputError(f"the player said {line!r}, neither time NS nor frame INDEX", ("camera", "lockstep"))
        self._owes_answer = True
        if word == "time":
            try:
                clock.step_to(int(number))
            except ValueError as error:
                raise InputError(f"the player's time goes back: {error}", ("camera", "lockstep")) from error
            return None
        frame = self._source.exposed_now(int(number), self._frames)
        self._frames += 1
        return frame

    def _line(self, timeout_s: float) -> str | None:
        """The player's next line; None if there is none in time. Raises EndOfStream if the player has disconnected."""
        while b"\n" not in self._unread:
            if not select.select([self._player], [], [], timeout_s)[0]:
                return None
            try:
                more = self._player.recv(LINE_MAX)
            except OSError:
                more = b""
            if not more:
                raise EndOfStream
            self._unread += more
        line, _, self._unread = self._unread.partition(b"\n")
        return line.decode("ascii", "replace")

    def _say(self, word: str) -> None:
        try:
            self._player.sendall(f"{word}\n".encode())
        except OSError as error:
            raise EndOfStream from error
