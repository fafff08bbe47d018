"""The daemon's own listeners: of two on one TCP or UDP port, the second would not open. Pure."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Literal

from edge.links.mavlink_endpoints import NetworkEndpoint, parse_endpoint

EVERY_IPV4, EVERY = "0.0.0.0", "::"  # Linux serves IPv4 on the latter too


@dataclass(frozen=True)
class Listener:
    key: str  # of the configuration, as `[section] key`
    text: str  # its value
    host: str  # an address in its shortest form, or a name
    port: int
    protocol: Literal["TCP", "UDP"] = "TCP"

    def excludes(self, other: Listener) -> bool:
        """Whether only one of the two can be open. Names are not resolved: only the same one counts as the same."""
        if (self.protocol, self.port) != (other.protocol, other.port) or self.port == 0:
            return False
        hosts = {self.host, other.host}
        return len(hosts) == 1 or EVERY in hosts or (EVERY_IPV4 in hosts and all(map(_is_ipv4, hosts)))


def zenoh_listener(endpoint: str) -> Listener:
    """`endpoint`: as msgs.session.check_endpoint returns it."""
    scheme, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    protocol: Literal["TCP", "UDP"] = "UDP" if scheme == "quic" else "TCP"
    return Listener("[zenoh] listen", endpoint, _shortest(host.strip("[]")), int(port), protocol)


def mavlink_listener(endpoint: str) -> Listener | None:
    """None for all but tcpin and udpin."""
    named = parse_endpoint(endpoint)
    if not isinstance(named, NetworkEndpoint) or named.kind not in ("tcpin", "udpin"):
        return None
    protocol: Literal["TCP", "UDP"] = "UDP" if named.kind == "udpin" else "TCP"
    return Listener("[mavlink] endpoints", endpoint, _shortest(named.host), named.port, protocol)


def metrics_listener(port: int) -> Listener:
    return Listener("[health] prometheus_port", str(port), "127.0.0.1", port)


def collision(listeners: Iterable[Listener | None]) -> str | None:
    """The first two that exclude each other, as a sentence; None if there are none."""
    for one, other in combinations(filter(None, listeners), 2):
        if one.excludes(other):
            both = f"{one.key} {one.text} and {other.key} {other.text}"
            return f"{both} need the same {one.protocol} port; change one of them"
    return None


def _shortest(host: str) -> str:
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host.lower()
    return str(getattr(address, "ipv4_mapped", None) or address)


def _is_ipv4(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).version == 4
    except ValueError:
        return False
