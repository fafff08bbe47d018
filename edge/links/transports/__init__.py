"""Transports of MAVLink's bytes: one file per medium behind one interface."""

from __future__ import annotations

from edge.links.errors import LinkError
from edge.links.mavlink_endpoints import SerialEndpoint, parse_endpoint
from edge.links.transports.medium import Transport
from edge.links.transports.serial_port import SerialPort
from edge.links.transports.tcp import TcpClient, TcpServer
from edge.links.transports.udp import Udp, UdpCaller


def open_transport(text: str) -> Transport:
    """The transport of an endpoint. A server, host name or device that is not available yet is retried later.

    Raises LinkError if the text is not an endpoint, or the address to listen on is not ours or is in use.
    """
    try:
        endpoint = parse_endpoint(text)
    except ValueError as error:
        raise LinkError(f"MAVLink endpoint {error}") from error
    if isinstance(endpoint, SerialEndpoint):
        return SerialPort(endpoint)
    if endpoint.kind == "tcpin":
        return TcpServer(endpoint)
    if endpoint.kind == "tcpout":
        return TcpClient(endpoint)
    return UdpCaller(endpoint) if endpoint.kind == "udpout" else Udp(endpoint)
