"""zenoh session settings: the UAV is a peer, the ground station a router, its tools are clients.

Discovery is off, timestamps are on (cached topics need them), and the lease is short enough that an outage is detected
within seconds.
"""

from __future__ import annotations

import json
import re
import ssl
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import zenoh

from msgs import topics

LEASE_MS = 2000
# How long a peer that accepts a connection and then stays silent can block opening (or closing) a session.
OPEN_TIMEOUT_MS = 4000
# QUIC retransmits after 1, 3 and 7 s. A router handles one QUIC handshake at a time, and waits 30 s for one that the
# other end abandoned if the close packet was lost. On a bad radio, giving up sooner would therefore block the router.
QUIC_OPEN_TIMEOUT_MS = 10_000
RETRY_PERIOD_MS = 200
RETRY_PERIOD_MAX_MS = 500
# zenoh's default of 2 is too small: on a busy machine both may still be being sent, and poses of the same frame are
# then dropped.
POSE_BATCHES = 4
# zenoh drops a sample that comes earlier than a period after the last one it passed. Given the cap itself, it would
# drop each frame that a camera of just that rate delivers a little early, nearly every second one. With this factor,
# frames may come early by a sixth of their period; a higher one would send more than a narrow link is meant to carry.
CAP_SLACK = 1.2
# Rates on a link whose poses are capped: enough for a human operator.
TF_RATE_MAX_HZ = 5.0
DETECTIONS_RATE_MAX_HZ = 2.0
SECURE = ("tls", "quic")
CALLING = "calling"  # name of the thread that opens a session for a caller that must not block
_NO_CHECK_TIME = 0x200000  # OpenSSL's X509_V_FLAG_NO_CHECK_TIME, which the ssl module does not define
_ENDPOINT = re.compile(r"(tcp|tls|quic)/((\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+):(\d{1,5}))([?#].*)?")


@dataclass(frozen=True)
class TlsFiles:
    """PEM files for mutual TLS on `tls/` and `quic/` endpoints; one certificate for listening and connecting."""

    root_ca: Path
    certificate: Path
    private_key: Path

    def check(self) -> None:
        """Raises ValueError, naming the file, if they are unusable: zenoh reports that late or never."""
        for path in (self.root_ca, self.certificate, self.private_key):
            try:
                path.read_bytes()
            except OSError as error:
                raise ValueError(f"{path} cannot be read: {error.strerror}") from error
        if self.private_key.stat().st_mode & 0o077:
            raise ValueError(f"{self.private_key} is open to other users; chmod 600 it")
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        try:
            context.load_verify_locations(self.root_ca)
        except ssl.SSLError as error:
            raise ValueError(f"{self.root_ca} holds no certificate in PEM") from error
        try:
            # Without any password, OpenSSL would ask for one at the terminal.
            context.load_cert_chain(self.certificate, self.private_key, password=b"")
        except ssl.SSLError as error:
            said = f"{self.private_key} is not the PEM key of {self.certificate}, or is encrypted"
            raise ValueError(said) from error

    def doubt(self) -> str | None:
        """Why peers may refuse files that pass `check`, as a sentence: issued by another CA, or not valid today.

        Only a warning: the two ends may use different CAs, or our clock may be wrong.
        """
        try:
            own = self._vouched_for()
        except ssl.SSLError as error:
            why = error.verify_message if isinstance(error, ssl.SSLCertVerificationError) else error.reason
            return f"{self.certificate} is refused by whoever trusts {self.root_ca}: {why}"
        # The CA's own dates are not checked: zenoh trusts the configured CA whatever its dates.
        begins_s, ends_s = (ssl.cert_time_to_seconds(own[key]) for key in ("notBefore", "notAfter"))
        now_s = time.time()
        if now_s < begins_s:
            return f"{self.certificate} is not valid before {_day(begins_s)}; today is {_day(now_s)}"
        if now_s > ends_s:
            return f"{self.certificate} expired on {_day(ends_s)}; today is {_day(now_s)}"
        return None

    def another_than(self, name: str) -> str | None:
        """Whose certificate it is, as a sentence, if its common name is not `name`: a router that goes by names then
        drops, without a word, what is sent under this one."""
        try:
            subject = self._vouched_for().get("subject", ())
        except ssl.SSLError:
            return None  # which `doubt` tells
        names = [value for part in subject for key, value in part if key == "commonName"]
        if name in names:
            return None
        whose = f"that of {', '.join(names)}" if names else "nobody's"
        return f"{self.certificate} is {whose}, not {name}'s: a router with [access] drops what {name} sends"

    def _vouched_for(self) -> Mapping[str, Any]:
        """The certificate as seen by a peer that trusts root_ca. Raises ssl.SSLError if that peer would accept it
        neither from a server nor from a client.

        The ssl module verifies only during a handshake, so one is performed in memory.
        """
        try:
            return self._handshake(own_is_server=True)
        except ssl.SSLError as refused:
            with suppress(ssl.SSLError):
                return self._handshake(own_is_server=False)
            raise refused from None

    def _handshake(self, *, own_is_server: bool) -> Mapping[str, Any]:
        """The own certificate as verified by the other end."""
        server, client = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER), ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        client.check_hostname = False
        client.verify_mode = ssl.CERT_NONE
        verifier = client if own_is_server else server
        verifier.verify_mode = ssl.CERT_REQUIRED
        verifier.load_verify_locations(self.root_ca)
        # Like zenoh, accept an intermediate CA's certificate as root_ca.
        verifier.verify_flags |= ssl.VerifyFlags.VERIFY_X509_PARTIAL_CHAIN | _NO_CHECK_TIME
        for context in (server, client):
            context.load_cert_chain(self.certificate, self.private_key)
        to_client, to_server = ssl.MemoryBIO(), ssl.MemoryBIO()
        connecting = client.wrap_bio(to_client, to_server)
        listening = server.wrap_bio(to_server, to_client, server_side=True)
        waiting = [connecting, listening]
        while waiting:
            for end in tuple(waiting):
                with suppress(ssl.SSLWantReadError):
                    end.do_handshake()
                    waiting.remove(end)
        return (connecting if own_is_server else listening).getpeercert() or {}


def _day(utc_s: float) -> str:
    return datetime.fromtimestamp(utc_s, UTC).strftime("%Y-%m-%d")


def check_endpoint(endpoint: str, *, tls: bool) -> str:
    """Return a valid zenoh endpoint; raises ValueError with a complete message for any other.

    Plain UDP is not allowed: a declaration lost on it is never repeated.
    """
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or int(match[4]) > 65535:
        raise ValueError(f"'{endpoint}' is not tcp/HOST:PORT, tls/HOST:PORT or quic/HOST:PORT")
    if match[1] in SECURE and not tls:
        raise ValueError(f"'{endpoint}' needs tls: root_ca, certificate and private_key")
    return endpoint


def with_datagrams(endpoint: str) -> str:
    """Adds zenoh's `mixed_rel=1` to a `quic/` endpoint: poses travel as datagrams, commands as a stream.

    Both ends must agree, or they never connect and neither reports why. All our endpoints therefore set it; specify
    `mixed_rel=0` to connect to a foreign router that does not.
    """
    if not endpoint.startswith("quic/") or "mixed_rel=" in endpoint:
        return endpoint
    address, hash_mark, settings = endpoint.partition("#")
    return f"{address}{';' if '?' in address else '?'}mixed_rel=1{hash_mark}{settings}"


def _without_brackets(endpoint: str) -> str:
    """To call an IPv6 address over `tls/` or `quic/`: zenoh looks for the brackets in the certificate too, finds none
    valid, and never connects. Without them it connects."""
    return re.sub(r"^(tls|quic)/\[([^]]*)]", r"\1/\2", endpoint)


def peer_config(
    listen: Sequence[str],
    connect: Sequence[str],
    *,
    tls: TlsFiles | None = None,
    pose_rate_max_hz: float | None = None,
) -> zenoh.Config:
    """The daemon's session: opens whether or not anything listens at `connect`, and keeps retrying.

    `pose_rate_max_hz` limits the rate of each target's poses, odometry and directions on quic, tls and udp links, to at
    most CAP_SLACK times this; the own ship's transforms and the detections, also sent with each frame, are limited
    further.
    Plain tcp, for tools on board, is not limited. Raises zenoh.ZError for a malformed endpoint.
    """
    config = _config("peer", listen, connect, tls)
    _insert(config, "connect/timeout_ms", -1)
    _insert(config, "connect/exit_on_failure", False)
    retry = {"period_init_ms": RETRY_PERIOD_MS, "period_max_ms": RETRY_PERIOD_MAX_MS, "period_increase_factor": 2}
    _insert(config, "connect/retry", retry)
    if pose_rate_max_hz is not None:
        _insert(config, "downsampling", [_thinned_by_radio(pose_rate_max_hz)])
    _insert(config, "access_control", _no_pictures_by_radio())
    return config


def router_config(
    listen: Sequence[str], *, tls: TlsFiles | None = None, access_control: Mapping[str, Any] | None = None
) -> zenoh.Config:
    """The ground station's session, to which UAVs and tools connect; `access_control` is zenoh's section of that
    name."""
    config = _config("router", listen, [], tls)
    _insert(config, "scouting/delay", 0)  # it looks for nobody, and otherwise opens half a second later
    if access_control is not None:
        _insert(config, "access_control", access_control)
    return config


def client_config(connect: Sequence[str], *, tls: TlsFiles | None = None) -> zenoh.Config:
    """A tool's session. Opening it raises zenoh.ZError if no endpoint answers: immediately if nothing listens there,
    over QUIC after QUIC_OPEN_TIMEOUT_MS."""
    return _config("client", [], connect, tls)


def reason_of(error: zenoh.ZError) -> str:
    """What went wrong, without the location in zenoh's source that follows it."""
    return str(error).partition(" at /")[0].strip()


def _thinned_by_radio(pose_rate_max_hz: float) -> dict[str, Any]:
    """zenoh's downsampling rules for tls, quic and udp links."""
    rates_hz = {
        "target/detections": min(pose_rate_max_hz, DETECTIONS_RATE_MAX_HZ),
        "tf": min(pose_rate_max_hz, TF_RATE_MAX_HZ),
    }
    # zenoh counts per rule, not per key: in a rule for all targets, the first of each frame would use it up.
    for number in range(topics.TARGETS_MAX):
        for name in ("pose", "odom", "direction"):
            rates_hz[f"target/t{number}/{name}"] = CAP_SLACK * pose_rate_max_hz
    rules = [{"key_expr": f"*/*/{name}/**", "freq": rate_hz} for name, rate_hz in rates_hz.items()]
    return {"flows": ["egress"], "messages": ["put"], "link_protocols": ["quic", "tls", "udp"], "rules": rules}


def _no_pictures_by_radio() -> dict[str, Any]:
    """zenoh's access control section that denies images on tls and quic links and allows everything else."""
    rule = {
        "id": "pictures",
        "permission": "deny",
        "flows": ["egress"],
        "messages": ["put"],
        "key_exprs": ["*/*/image/compressed/**"],
    }
    radio = {"id": "radio", "link_protocols": list(SECURE)}
    policy = {"rules": [rule["id"]], "subjects": [radio["id"]]}
    return {
        "enabled": True,
        "default_permission": "allow",
        "rules": [rule],
        "subjects": [radio],
        "policies": [policy],
    }


def _config(mode: str, listen: Sequence[str], connect: Sequence[str], tls: TlsFiles | None) -> zenoh.Config:
    listen = [with_datagrams(one) for one in listen]
    connect = [_without_brackets(with_datagrams(one)) for one in connect]
    config = zenoh.Config()
    _insert(config, "mode", mode)
    # An empty list instead of this table would keep zenoh's default of listening on all interfaces.
    _insert(config, "listen/endpoints", {"router": listen, "peer": listen, "client": []})
    _insert(config, "connect/endpoints", connect)
    _insert(config, "scouting/multicast/enabled", False)
    _insert(config, "scouting/gossip/enabled", False)
    _insert(config, "timestamping/enabled", True)
    _insert(config, "transport/link/tx/lease", LEASE_MS)
    _insert(config, "transport/link/tx/queue/size/real_time", POSE_BATCHES)
    by_quic = any(endpoint.startswith("quic/") for endpoint in connect)
    _insert(config, "transport/unicast/open_timeout", QUIC_OPEN_TIMEOUT_MS if by_quic else OPEN_TIMEOUT_MS)
    _insert(config, "transport/shared_memory/enabled", False)
    if tls is not None:
        settings = {
            "root_ca_certificate": str(tls.root_ca),
            "listen_certificate": str(tls.certificate),
            "listen_private_key": str(tls.private_key),
            "connect_certificate": str(tls.certificate),
            "connect_private_key": str(tls.private_key),
            "enable_mtls": True,
        }
        for name, value in settings.items():
            _insert(config, f"transport/link/tls/{name}", value)
    return config


def _insert(config: zenoh.Config, key: str, value: object) -> None:
    config.insert_json5(key, json.dumps(value))
