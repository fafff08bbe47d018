"""Parses endpoint texts. Pure.

udpin:HOST:PORT     wait on this port for the autopilot
udpout:HOST:PORT    send to this address
tcpin:HOST:PORT     TCP server
tcpout:HOST:PORT    TCP client; reconnects indefinitely
serial:DEVICE:BAUD  serial port; reopened indefinitely
"""

from __future__ import annotations

import ipaddress
import re
from dataclasses import dataclass
from typing import Literal

BAUD_MAX = 12_000_000
FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcpin:HOST:PORT, tcpout:HOST:PORT or serial:DEVICE:BAUD"


@dataclass(frozen=True)
class NetworkEndpoint:
    kind: Literal["udpin", "udpout", "tcpin", "tcpout"]
    host: str  # an IPv6 address without its brackets
    port: int
    text: str


@dataclass(frozen=True)
class SerialEndpoint:
    device: str
    baud: int
    text: str


def parse_endpoint(text: str) -> NetworkEndpoint | SerialEndpoint:
    """Raises ValueError with a sentence that names the text and the valid forms."""
    serial = re.fullmatch(r"serial:(/[^\x00-\x1f]+):(\d{1,8})", text)
    if serial and 0 < int(serial[2]) <= BAUD_MAX:
        return SerialEndpoint(serial[1], int(serial[2]), text)
    network = re.fullmatch(r"(udpin|udpout|tcpin|tcpout):(?:\[([^\]]+)\]|([^:\s]+)):(\d{1,5})", text)
    if network and int(network[4]) <= 65_535:
        kind: Literal["udpin", "udpout", "tcpin", "tcpout"] = network[1]  # type: ignore[assignment]
        if kind.endswith("out") and int(network[4]) == 0:
            raise ValueError(f"'{text}' has port 0, where nobody listens")
        return NetworkEndpoint(kind, network[2] or network[3], int(network[4]), text)
    raise ValueError(f"'{text}' is not {FORMS}")


def plain_host(text: str) -> str:
    """A sender's address as sockets report it, without the zone; an IPv4-mapped IPv6 address becomes IPv4. Raises
    ValueError if it is not an address."""
    try:
        address = ipaddress.ip_address(text.partition("%")[0])
    except ValueError:
        raise ValueError(f"'{text}' is no address such as 192.168.1.10 or fe80::1; names are not looked up") from None
    return str(getattr(address, "ipv4_mapped", None) or address)
