"""A radio's effect on one packet: it queues, takes time to be sent, is delayed, or is lost. Pure."""

from __future__ import annotations

import random
from dataclasses import dataclass

UDP_HEADER_BYTES = 28  # IPv4 and UDP
TCP_HEADER_BYTES = 52  # IPv4, TCP and its timestamps
SEGMENT_BYTES = 1400
# Minimum timeout before a kernel retransmits a segment (RFC 6298 as in Linux).
RETRANSMIT_MIN_S = 0.2


@dataclass(frozen=True)
class Channel:
    """A radio, the same in both directions."""

    name: str
    rate_bps: float | None = None  # of the line, headers included; None: unlimited
    delay_s: float = 0.0  # one way
    jitter_s: float = 0.0  # on top of the delay, uniform from 0; packets keep their order
    loss: float = 0.0  # share of packets
    queue_s: float = 0.5  # a datagram that would wait longer for the line is dropped
    outage_s: float = 0.0  # once, in the middle of a trial

    @property
    def what(self) -> str:
        """In words."""
        rate = "unlimited rate" if self.rate_bps is None else f"{self.rate_bps / 1e3:g} kbit/s"
        jitter = f" + 0…{self.jitter_s * 1e3:g} ms" if self.jitter_s else ""
        outage = f", {self.outage_s:g} s outage" if self.outage_s else ""
        return f"{rate}, {self.delay_s * 1e3:g} ms{jitter}, {self.loss:.0%} loss{outage}"


CLEAR = Channel("clear")
LOSSY = Channel("lossy", rate_bps=1e6, delay_s=0.03, loss=0.05)
OUTAGE = Channel("outage", rate_bps=1e6, delay_s=0.03, loss=0.05, outage_s=4.0)
NARROW = Channel("narrow", rate_bps=115e3, delay_s=0.03, jitter_s=0.04, loss=0.02)
CHANNELS = {one.name: one for one in (CLEAR, LOSSY, OUTAGE, NARROW)}


class Lane:
    """One direction of a channel. Takes packets in order of time (seconds of any one clock)."""

    def __init__(self, channel: Channel, seed: int) -> None:
        self._channel = channel
        self._chance = random.Random(seed)
        self._line_free_s = 0.0
        self._last_due_s = 0.0

    def datagram(self, size_bytes: int, now_s: float) -> float | None:
        """Time at which a datagram's payload arrives at the other end; None if it is lost."""
        if self._line_free_s - now_s > self._channel.queue_s:
            return None
        sent_s = self._send(size_bytes + UDP_HEADER_BYTES, now_s)
        if self._chance.random() < self._channel.loss:
            return None  # it occupied the line nevertheless
        return self._arrive(sent_s)

    def segment(self, size_bytes: int, now_s: float) -> float:
        """Time at which a piece of a TCP stream arrives: a lost one is sent again, and all behind it wait."""
        sent_s = self._send(size_bytes + TCP_HEADER_BYTES, now_s)
        timeout_s = max(RETRANSMIT_MIN_S, 2.0 * self._channel.delay_s)
        while self._chance.random() < self._channel.loss:
            sent_s = self._send(size_bytes + TCP_HEADER_BYTES, sent_s + timeout_s)
            timeout_s *= 2.0
        return self._arrive(sent_s)

    def _send(self, size_bytes: int, now_s: float) -> float:
        taken_s = 0.0 if self._channel.rate_bps is None else 8.0 * size_bytes / self._channel.rate_bps
        self._line_free_s = max(self._line_free_s, now_s) + taken_s
        return self._line_free_s

    def _arrive(self, sent_s: float) -> float:
        due_s = sent_s + self._channel.delay_s + self._chance.uniform(0.0, self._channel.jitter_s)
        self._last_due_s = max(self._last_due_s, due_s)
        return self._last_due_s
