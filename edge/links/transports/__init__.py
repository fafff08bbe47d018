"""How MAVLink's bytes travel: one file a medium behind one interface."""

from __future__ import annotations

from edge.links.errors import LinkError
from edge.links.mavlink_endpoints import SerialEndpoint, parse_endpoint
from edge.links.transports.medium import Transport
from edge.links.transports.serial_port import SerialPort
from edge.links.transports.tcp import TcpClient, TcpServer
from edge.links.transports.udp import Udp, UdpCaller


def open_transport(text: str) -> Transport:
    """The transport of an endpoint. What can only be there later, a server, its name or a device, is waited for.

    Raises LinkError if the text is no endpoint, or what is to be listened on is no address of ours or is taken.
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
