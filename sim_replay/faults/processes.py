"""The processes of a rig: each is started, read line by line, signalled and ended by its own id."""

from __future__ import annotations

import signal
import subprocess
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

# Before a command: it is told to stop (SIGTERM) when what starts it has ended, however that happened. For the kernel
# that is the thread: start nothing from one that ends sooner.
ENDS_WITH_US = ("setpriv", "--pdeathsig", "TERM")  # of util-linux
_END_S = 10.0

Heard = Callable[[str, int], None]  # a line, and its arrival time (monotonic ns)


class Process:
    """A child process; a thread passes each line of its standard output and error to `heard`.

    `ended` is called in the same thread once there is an exit code.
    """

    def __init__(self, command: Sequence[str | Path], heard: Heard, ended: Callable[[], object] = lambda: None) -> None:
        self._heard, self._ended = heard, ended
        self._popen = subprocess.Popen(
            [*ENDS_WITH_US, *(str(word) for word in command)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            start_new_session=True,  # a terminal's Ctrl-C is for the rig, which then ends the others
        )
        self._reader = threading.Thread(target=self._read, name=f"read {self.pid}", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        return self._popen.pid

    @property
    def exit_code(self) -> int | None:
        """None while it runs; minus the signal's number if a signal ended it."""
        return self._popen.poll()

    def wait(self, within_s: float) -> int | None:
        """Its exit code as soon as there is one; None if it is still running after `within_s`."""
        try:
            return self._popen.wait(within_s)
        except subprocess.TimeoutExpired:
            return None

    def tell(self, line: str) -> None:
        """Write a line to its standard input."""
        assert self._popen.stdin is not None
        self._popen.stdin.write(line + "\n")
        self._popen.stdin.flush()

    def send_signal(self, number: signal.Signals) -> None:
        self._popen.send_signal(number)

    def end(self, number: signal.Signals = signal.SIGTERM) -> int:
        """End it, by force if it ignores the signal; returns its exit code once all its output was read."""
        if self._popen.poll() is None:
            self._popen.send_signal(number)
            self._popen.send_signal(signal.SIGCONT)
        if self.wait(_END_S) is None:
            self._popen.kill()
        return self.reap()

    def reap(self) -> int:
        """Wait for its end and its last line."""
        code = self._popen.wait()
        self._reader.join(_END_S)
        for stream in (self._popen.stdin, self._popen.stdout):
            if stream is not None:
                stream.close()
        return code

    def _read(self) -> None:
        assert self._popen.stdout is not None
        for line in self._popen.stdout:
            self._heard(line.rstrip("\n"), time.monotonic_ns())
        self._popen.wait()
        self._ended()
