"""Where a peer's host is. Name service may take long to answer, or come up after the daemon: nobody waits for it."""

from __future__ import annotations

import queue
import socket
import threading

from edge.links.errors import LinkError
from edge.links.mavlink_endpoints import NetworkEndpoint
from edge.links.transports.medium import Address, resolve

Places = list[tuple[socket.AddressFamily, Address]]


class Lookup:
    """One question at a time, each asked by a short thread; what is an address already needs none."""

    def __init__(self, endpoint: NetworkEndpoint, kind: socket.SocketKind) -> None:
        self._endpoint = endpoint
        self._kind = kind
        self._asked = False
        self._answers: queue.SimpleQueue[Places | LinkError] = queue.SimpleQueue()

    def answer(self) -> Places | LinkError | None:
        """Where the host is, or why nobody can say; None: not known yet. What was answered is asked anew."""
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
