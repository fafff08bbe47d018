"""The player's side of lock-step: it listens, the daemon connects and receives each step (edge.cameras.lockstep)."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

from sim_replay.play import PlayError
from sim_replay.ports import LOOPBACK

STEP_TIMEOUT_S = 120.0
_POLL_S = 0.2


class Control:
    """One line per step; each waits for the daemon's answer."""

    def __init__(self) -> None:
        self._listening = socket.create_server((LOOPBACK, 0))
        self._daemon: socket.socket | None = None
        self._unread = b""

    @property
    def address(self) -> str:
        """HOST:PORT for the daemon's `[camera] lockstep`."""
        return f"{LOOPBACK}:{self._listening.getsockname()[1]}"

    def wait_until_ready(self, alive: Callable[[], bool]) -> None:
        """Wait until the daemon has connected and warmed up. Raises PlayError if it ends first or takes too long."""
        deadline_s = time.monotonic() + STEP_TIMEOUT_S
        self._listening.settimeout(_POLL_S)
        while self._daemon is None:
            try:
                self._daemon, _ = self._listening.accept()
            except TimeoutError:
                if not alive() or time.monotonic() > deadline_s:
                    raise PlayError("the daemon did not connect to the player for its first step") from None
        self._daemon.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._daemon.settimeout(STEP_TIMEOUT_S)
        self._expect("ready")

    def step(self, word: str, number: int) -> None:
        """`time` NS or `frame` INDEX; returns when the daemon has processed all its consequences. Raises PlayError."""
        assert self._daemon is not None
        try:
            self._daemon.sendall(f"{word} {number}\n".encode())
        except OSError as error:
            raise PlayError(f"the daemon closed its connection before {word} {number}") from error
        self._expect("ok")

    def close(self) -> None:
        """Disconnect: the daemon sees this as the end of the recording."""
        for end in (self._daemon, self._listening):
            if end is not None:
                end.close()

    def _expect(self, word: str) -> None:
        assert self._daemon is not None
        while b"\n" not in self._unread:
            try:
                more = self._daemon.recv(64)
            except TimeoutError as error:
                raise PlayError(f"the daemon did not finish a step within {STEP_TIMEOUT_S:.0f} s") from error
            except OSError:
                more = b""
            if not more:
                raise PlayError("the daemon ended in the middle of the sequence")
            self._unread += more
        line, _, self._unread = self._unread.partition(b"\n")
        if line.decode("ascii", "replace") != word:
            raise PlayError(f"the daemon answered {line!r}, not {word}")
