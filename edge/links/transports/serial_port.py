"""A serial port, reopened indefinitely if it is absent or unplugged."""

from __future__ import annotations

import errno
import logging
import os
import termios
from collections.abc import Sequence

import serial

from edge import clock
from edge.links.mavlink_endpoints import SerialEndpoint
from edge.links.transports.backoff import Backoff
from edge.links.transports.medium import CHUNK_MAX, Address, Outbox, Received, unsent_bytes
from msgs.mavlink import FrameReader

log = logging.getLogger(__name__)

BITS_PER_BYTE = 10  # with start and stop
QUEUES_PER_S = 10  # the kernel's queue is limited to what is sent in a tenth of a second
QUEUE_MIN = 280  # bytes: the longest message


class SerialPort:
    """pyserial opens and configures the port; data use its file descriptor, as pyserial's writes may block."""

    finds_peers = False
    port = None

    def __init__(self, endpoint: SerialEndpoint) -> None:
        self.endpoint = endpoint.text
        self._device, self._baud = endpoint.device, endpoint.baud
        self._backoff = Backoff()
        self._port: serial.Serial | None = None
        self._reader = FrameReader(datagram=False)
        self._outbox = Outbox()

    @property
    def peer(self) -> Address | None:
        return (self._device,) if self._port is not None else None

    def filenos(self) -> Sequence[int]:
        return () if self._port is None else (self._port.fileno(),)

    def tick(self, now_ns: int) -> None:
        if self._port is not None:
            self._flush()
        elif self._backoff.due(now_ns):
            self._open(now_ns)

    def receive(self) -> Received | None:
        if self._port is None:
            return None
        try:
            data = os.read(self._port.fileno(), CHUNK_MAX)
        except BlockingIOError:
            return None
        except OSError as error:
            self._lost(error)
            return None
        if not data:
            self._lost(OSError(errno.ENODEV, os.strerror(errno.ENODEV)))
            return None
        return Received(data, (self._device,), self._reader)

    def send(self, data: bytes, peer: Address, *, yields: bool = False) -> bool:
        if self._port is None:
            return False
        fits = self._outbox.put(data, clock.monotonic_ns(), yields=yields)
        self._flush()
        return fits

    def dropped(self) -> int:
        return self._outbox.dropped()

    def reaches(self, peer: Address) -> bool:
        return self._port is not None

    def close(self) -> None:
        if self._port is not None:
            self._port.close()

    def _open(self, now_ns: int) -> None:
        try:
            self._port = serial.Serial(self._device, self._baud, timeout=0, exclusive=True)
            _tell_silence_from_absence(self._port.fileno())
        except (OSError, ValueError, termios.error) as error:  # pyserial's SerialException is an OSError
            self.close()
            self._port = None
            if self._backoff.failures == 0:
                log.warning("mavlink: %s: %s; trying again", self.endpoint, error)
            self._backoff = self._backoff.failed(now_ns)
            return
        self._reader = FrameReader(datagram=False)
        self._backoff = self._backoff.opened(now_ns)
        log.info("mavlink: %s: open", self.endpoint)

    def _flush(self) -> None:
        if self._port is None:
            return
        fileno = self._port.fileno()
        try:
            room_bytes = max(self._baud // BITS_PER_BYTE // QUEUES_PER_S, QUEUE_MIN) - unsent_bytes(fileno)
            self._outbox.flush(lambda data: os.write(fileno, data), room_bytes, clock.monotonic_ns())
        except OSError as error:
            self._lost(error)

    def _lost(self, error: OSError) -> None:
        assert self._port is not None, "only an open port is lost"
        log.warning("mavlink: %s: lost: %s", self.endpoint, error.strerror)
        self._port.close()
        self._port = None
        self._outbox.close()
        self._backoff = self._backoff.failed(clock.monotonic_ns())


def _tell_silence_from_absence(fileno: int) -> None:
    """Make reads fail with "would block" if there is no data, and return nothing only if the device is gone."""
    os.set_blocking(fileno, False)
    attributes = termios.tcgetattr(fileno)
    attributes[6][termios.VMIN] = 1
    termios.tcsetattr(fileno, termios.TCSANOW, attributes)
