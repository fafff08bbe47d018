"""Name resolution of a peer's host. It may be slow, or become available after the daemon: nothing waits for it."""

from __future__ import annotations

import queue
import socket
import threading

from edge.links.errors import LinkError
from edge.links.mavlink_endpoints import NetworkEndpoint
from edge.links.transports.medium import Address, resolve

Places = list[tuple[socket.AddressFamily, Address]]


class Lookup:
    """One query at a time, each in a short-lived thread; an address needs no query."""

    def __init__(self, endpoint: NetworkEndpoint, kind: socket.SocketKind) -> None:
        self._endpoint = endpoint
        self._kind = kind
        self._asked = False
        self._answers: queue.SimpleQueue[Places | LinkError] = queue.SimpleQueue()

    def answer(self) -> Places | LinkError | None:
        """The host's addresses, or why they cannot be resolved; None: not known yet. The next call after an answer
        queries again."""
        if not self._asked:
            self._asked = True
            try:
                self._answers.put(resolve(self._endpoint, self._kind, socket.AI_NUMERICHOST))
            except LinkError:
                threading.Thread(target=self._ask, name="lookup", daemon=True).start()
        try:
            answer = self._answers.get_nowait()
        except queue.Empty:
            return None
        self._asked = False
        return answer

    def _ask(self) -> None:
        try:
            self._answers.put(resolve(self._endpoint, self._kind))
        except LinkError as error:
            self._answers.put(error)
