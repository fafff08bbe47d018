"""The daemon's own TCP listeners: of two on one port, the second would not open. Pure."""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations

from edge.links.mavlink_endpoints import NetworkEndpoint, parse_endpoint

EVERY_IPV4, EVERY = "0.0.0.0", "::"  # Linux serves IPv4 on the latter too


@dataclass(frozen=True)
class Listener:
    key: str  # of the configuration, as `[section] key`
    text: str  # its value
    host: str  # an address in its shortest form, or a name
    port: int

    def excludes(self, other: Listener) -> bool:
        """Whether only one of the two can be open. Names are not resolved: only the same one counts as the same."""
        if self.port != other.port or self.port == 0:
            return False
        hosts = {self.host, other.host}
        return len(hosts) == 1 or EVERY in hosts or (EVERY_IPV4 in hosts and all(map(_is_ipv4, hosts)))


def zenoh_listener(endpoint: str) -> Listener | None:
    """None for quic, which takes no TCP port. `endpoint`: as msgs.session.check_endpoint returns it."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.partition("?")[0].partition("#")[0].rpartition(":")
    return None if protocol == "quic" else Listener("[zenoh] listen", endpoint, _shortest(host.strip("[]")), int(port))


def mavlink_listener(endpoint: str) -> Listener | None:
    """None for all but tcpin."""
    named = parse_endpoint(endpoint)
    if not isinstance(named, NetworkEndpoint) or named.kind != "tcpin":
        return None
    return Listener("[mavlink] endpoints", endpoint, _shortest(named.host), named.port)


def metrics_listener(port: int) -> Listener:
    return Listener("[health] prometheus_port", str(port), "127.0.0.1", port)


def collision(listeners: Iterable[Listener | None]) -> str | None:
    """The first two that exclude each other, as a sentence; None if there are none."""
    for one, other in combinations(filter(None, listeners), 2):
        if one.excludes(other):
            return f"{one.key} {one.text} and {other.key} {other.text} need the same TCP port; change one of them"
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
