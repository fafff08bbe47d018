"""Status reports to systemd: the datagrams of sd_notify, written by hand as they are one line each."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping

FEEDS_PER_LIMIT = 3


class Notifier:
    """Sends on NOTIFY_SOCKET if systemd has set it (Type=notify, WatchdogSec=); otherwise does nothing.

    Never raises: a service manager that does not listen must not end the flight.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        address = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + address[1:] if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if address else None
        self._period_ns = _watchdog_ns(environment) // FEEDS_PER_LIMIT
        self._due_ns = 0

    def ready(self) -> None:
        self._send("READY=1")

    def stopping(self) -> None:
        self._send("STOPPING=1")

    def status(self, text: str) -> None:
        """The line that `systemctl status` shows."""
        self._send(f"STATUS={text.splitlines()[0] if text else ''}")

    def feed(self, now_ns: int) -> None:
        """Report that the loop is running, as often as the watchdog requires. Call it in every iteration."""
        if self._period_ns and now_ns >= self._due_ns:
            self._due_ns = now_ns + self._period_ns
            self._send("WATCHDOG=1")

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, text: str) -> None:
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.sendto(text.encode(), socket.MSG_DONTWAIT, self._address)


def _watchdog_ns(environment: Mapping[str, str]) -> int:
    """WatchdogSec= in nanoseconds, 0 if it is not set or set for another process."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return 0
    try:
        return max(int(environment.get("WATCHDOG_USEC", "0")), 0) * 1000
    except ValueError:
        return 0
