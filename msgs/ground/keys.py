"""A small certificate authority for zenoh over TLS and QUIC: EC P-256, one certificate per identity.

The common name is the identity used by the router's access rules. Certificates are valid for both ends of a link
(extended key usage: server and client), since a zenoh peer both listens and connects.
"""

from __future__ import annotations

import ipaddress
import os
import re
from collections.abc import Sequence
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from msgs.ground.errors import InputError
from msgs.session import TlsFiles

AUTHORITY = "ca"
DAYS_MAX = 36500
_IDENTITY = re.compile(r"[A-Za-z][A-Za-z0-9_.-]{0,62}")
_LABEL = "[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?"
# Clocks of vehicles without a network may lag.
_BACKDATED = timedelta(days=1)


def init_authority(folder: Path, days: int = 3650) -> tuple[Path, Path]:
    """Create `ca.pem` and `ca.key` (mode 0600) in `folder`; returns (certificate, key).

    Raises InputError if one exists already or cannot be written.
    """
    certificate_path, key_path = folder / f"{AUTHORITY}.pem", folder / f"{AUTHORITY}.key"
    _require_new(key_path, certificate_path)
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "uavpose authority")])
    usage = x509.KeyUsage(
        digital_signature=False, content_commitment=False, key_encipherment=False, data_encipherment=False,
        key_agreement=False, key_cert_sign=True, crl_sign=True, encipher_only=False, decipher_only=False,
    )  # fmt: skip
    builder = (
        _builder(name, name, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    _write_both(key_path, key, certificate_path, builder.sign(key, hashes.SHA256()))
    return certificate_path, key_path


def issue(folder: Path, identity: str, hosts: Sequence[str] = (), days: int = 825) -> TlsFiles:
    """Create `<identity>.pem` and `.key` (mode 0600) in `folder`, signed by the authority there.

    `hosts` are the DNS names and IP addresses under which others will reach it. Raises InputError if the authority is
    missing, the identity exists, or a name is invalid.
    """
    if not _IDENTITY.fullmatch(identity) or identity == AUTHORITY:
        raise InputError(f"'{identity}' is not a valid identity: a letter, then letters, digits, '_', '-' or '.'")
    files = TlsFiles(folder / f"{AUTHORITY}.pem", folder / f"{identity}.pem", folder / f"{identity}.key")
    authority, authority_key = _read_authority(folder)
    _require_new(files.private_key, files.certificate)
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, identity)])
    names = [_alternative_name(host) for host in dict.fromkeys((identity, *hosts))]
    both_ends = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
    builder = (
        _builder(name, authority.subject, key.public_key(), days)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(both_ends, critical=False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key()),
            critical=False,
        )
    )
    _write_both(files.private_key, key, files.certificate, builder.sign(authority_key, hashes.SHA256()))
    return files


def listing(folder: Path) -> list[str]:
    """A line for each certificate in `folder`: identity, last day, hosts. Raises InputError if there are none."""
    lines = []
    try:
        paths = sorted(path for path in folder.iterdir() if path.suffix == ".pem")
    except FileNotFoundError:
        paths = []
    except OSError as error:
        raise InputError(f"{folder}: cannot be read: {error.strerror}") from error
    for path in paths:
        try:
            certificate = x509.load_pem_x509_certificate(path.read_bytes())
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read as a certificate: {error}") from error
        until = certificate.not_valid_after_utc
        state = "valid until" if until > datetime.now(UTC) else "EXPIRED on"
        try:
            names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
            hosts = ", ".join(str(one.value) for one in names)
        except x509.ExtensionNotFound:
            hosts = ""
        lines.append(f"{path.stem:16} {state} {until:%Y-%m-%d}  {hosts}".rstrip())
    if not lines:
        raise InputError(f"{folder}: contains no certificates; `keys init` creates the authority")
    return lines


def _builder(
    subject: x509.Name, issuer: x509.Name, public_key: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    if not 1 <= days <= DAYS_MAX:
        raise InputError(f"a certificate can be valid for 1 to {DAYS_MAX} days, not {days}")
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + timedelta(days=days))
    )


def _alternative_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    # Only digits and dots: a mistyped address, which no certificate would ever match.
    if not re.fullmatch(rf"{_LABEL}(\.{_LABEL})*", host) or not re.search(r"[A-Za-z_]", host):
        raise InputError(f"'{host}' is neither an IP address nor a host name")
    return x509.DNSName(host)


def _read_authority(folder: Path) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    certificate_path, key_path = folder / f"{AUTHORITY}.pem", folder / f"{AUTHORITY}.key"
    try:
        certificate = x509.load_pem_x509_certificate(certificate_path.read_bytes())
        key = serialization.load_pem_private_key(key_path.read_bytes(), password=None)
    except OSError as error:
        how = "; `keys init` creates it" if isinstance(error, FileNotFoundError) else ""
        raise InputError(f"{error.filename}: cannot be read ({error.strerror}){how}") from error
    except ValueError as error:
        raise InputError(f"{folder}: {AUTHORITY}.pem or {AUTHORITY}.key is not a PEM file: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or key.public_key() != certificate.public_key():
        raise InputError(f"{key_path}: is not the key of {certificate_path.name}")
    return certificate, key


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _require_new(*paths: Path) -> None:
    for path in paths:
        if os.path.lexists(path):  # an inaccessible path is reported on writing
            raise InputError(f"{path}: already exists; move it away first, so that no key is lost")


def _write_both(
    key_path: Path, key: ec.EllipticCurvePrivateKey, certificate_path: Path, certificate: x509.Certificate
) -> None:
    """Both files or, as on a full disk, neither: what is left behind would keep the next attempt from writing."""
    with ExitStack() as unfinished:
        _write_new(key_path, _pem(key), 0o600, unfinished)
        _write_new(certificate_path, certificate.public_bytes(serialization.Encoding.PEM), 0o644, unfinished)
        unfinished.pop_all()


def _write_new(path: Path, data: bytes, mode: int, unfinished: ExitStack) -> None:
    """Create the file with its mode: a key must not be readable to others even for a moment."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        unfinished.callback(path.unlink)
        with open(descriptor, "wb") as file:
            file.write(data)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
