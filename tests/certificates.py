"""Certificates of other days and uses."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.x509.oid import ObjectIdentifier


def redate(
    folder: Path, identity: str, *, begins_days: float, ends_days: float, use: ObjectIdentifier | None = None
) -> tuple[datetime, datetime]:
    """Have the authority in `folder` sign an identity's certificate again, for days from now on; both dates.

    `use`: the one extended use that it then has; None: as before.
    """
    path = folder / f"{identity}.pem"
    authority = serialization.load_pem_private_key((folder / "ca.key").read_bytes(), password=None)
    old = x509.load_pem_x509_certificate(path.read_bytes())
    begins, ends = (datetime.now(UTC) + timedelta(days=days) for days in (begins_days, ends_days))
    extensions = [
        x509.Extension(one.oid, one.critical, x509.ExtendedKeyUsage([use]))
        if use is not None and isinstance(one.value, x509.ExtendedKeyUsage)
        else one
        for one in old.extensions
    ]
    builder = x509.CertificateBuilder(
        old.issuer, old.subject, old.public_key(), old.serial_number, begins, ends, extensions
    )
    path.write_bytes(builder.sign(authority, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
    return begins, ends
