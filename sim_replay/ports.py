"""Ports of loopback for servers that are about to be started."""

from __future__ import annotations

import errno
import random
import socket

LOOPBACK = "127.0.0.1"
# Below those that Linux gives to outgoing connections, which could take a port before its server does.
PORTS = range(16384, 32768)
_chance = random.SystemRandom()  # a seeded generator would draw the same ports in processes side by side


def free_port(kind: socket.SocketKind = socket.SOCK_STREAM) -> int:
    """A port that nothing uses now."""
    while True:
        port = _chance.choice(PORTS)
        with socket.socket(socket.AF_INET, kind) as probe:
            try:
                probe.bind((LOOPBACK, port))
            except OSError as error:
                if error.errno != errno.EADDRINUSE:
                    raise
            else:
                return port


def free_endpoint() -> str:
    """The same for TCP, as zenoh writes it."""
    return f"tcp/{LOOPBACK}:{free_port()}"
