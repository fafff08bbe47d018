"""Certificates as openssl, an independent reader, judges them, and files that only their owner can read."""

from __future__ import annotations

import re
import resource
import ssl
import stat
import subprocess
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.x509.oid import ExtendedKeyUsageOID, ObjectIdentifier

from msgs.ground import cli
from msgs.ground.errors import InputError
from msgs.ground.keys import init_authority, issue, listing
from msgs.session import TlsFiles
from tests.certificates import redate


def test_openssl_verifies_what_was_issued_and_nothing_of_another_authority(tmp_path: Path) -> None:
    for name in ("ours", "theirs"):
        init_authority(tmp_path / name)
    files = issue(tmp_path / "ours", "uav1", ["10.0.0.7", "uav1.local", "fd00::7"])

    def verified(authority: str, *arguments: str) -> bool:
        command = ["openssl", "verify", "-x509_strict", "-CAfile", str(tmp_path / authority / "ca.pem"), *arguments]
        return subprocess.run([*command, str(files.certificate)], capture_output=True, check=False).returncode == 0

    assert verified("ours", "-purpose", "sslserver", "-verify_ip", "10.0.0.7")
    assert verified("ours", "-purpose", "sslclient", "-verify_hostname", "uav1.local")
    assert verified("ours", "-verify_ip", "fd00::7")
    assert not verified("ours", "-verify_ip", "10.0.0.8")
    assert not verified("theirs")
    text = subprocess.run(
        ["openssl", "x509", "-in", str(files.certificate), "-noout", "-subject"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert text.replace(" ", "").strip() == "subject=CN=uav1"


def test_private_keys_are_their_owner_s_alone_and_match(tmp_path: Path) -> None:
    init_authority(tmp_path)
    files = issue(tmp_path, "uav1")
    for path in (files.private_key, tmp_path / "ca.key"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    files.check()
    ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(files.certificate, files.private_key)
    with pytest.raises(ValueError, match=r"ca\.key is not the PEM key of"):
        TlsFiles(files.root_ca, files.certificate, tmp_path / "ca.key").check()


def test_a_certificate_of_another_authority_or_another_day_is_doubted(tmp_path: Path) -> None:
    for name in ("ours", "theirs"):
        init_authority(tmp_path / name)
        issue(tmp_path / name, "uav1")
    ours, theirs = (tmp_path / name for name in ("ours", "theirs"))
    mixed = TlsFiles(ours / "ca.pem", theirs / "uav1.pem", theirs / "uav1.key")
    mixed.check()
    told = f"{theirs / 'uav1.pem'} is refused by whoever trusts {ours / 'ca.pem'}: unable to get"
    assert (mixed.doubt() or "").startswith(told)
    files = TlsFiles(ours / "ca.pem", ours / "uav1.pem", ours / "uav1.key")
    assert files.doubt() is None
    _, ended = redate(ours, "uav1", begins_days=-9, ends_days=-2)
    assert f"{ours / 'uav1.pem'} expired on {ended:%Y-%m-%d}; today is " in (files.doubt() or "")
    begins, _ = redate(ours, "uav1", begins_days=2, ends_days=9)
    assert f"{ours / 'uav1.pem'} is not valid before {begins:%Y-%m-%d}; today is " in (files.doubt() or "")
    files.check()
    redate(ours, "ca", begins_days=-9, ends_days=-2)  # zenoh asks the authority's certificate for no date
    redate(ours, "uav1", begins_days=-2, ends_days=9)
    assert files.doubt() is None


@pytest.mark.parametrize("use", [ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH])
def test_a_certificate_for_one_end_alone_is_not_doubted(tmp_path: Path, use: ObjectIdentifier) -> None:
    init_authority(tmp_path)
    issue(tmp_path, "uav1")
    redate(tmp_path, "uav1", begins_days=-1, ends_days=9, use=use)
    assert TlsFiles(tmp_path / "ca.pem", tmp_path / "uav1.pem", tmp_path / "uav1.key").doubt() is None


def test_nothing_is_overwritten_and_bad_names_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="`keys init` creates it"):
        issue(tmp_path, "uav1")
    (tmp_path / "another" / "ca.pem").mkdir(parents=True)
    with pytest.raises(InputError, match=r"cannot be read \(Is a directory\)$"):
        issue(tmp_path / "another", "uav1")
    init_authority(tmp_path)
    before = (tmp_path / "ca.key").read_bytes()
    with pytest.raises(InputError, match="already exists"):
        init_authority(tmp_path)
    issue(tmp_path, "uav1")
    with pytest.raises(InputError, match="already exists"):
        issue(tmp_path, "uav1")
    assert (tmp_path / "ca.key").read_bytes() == before
    for name in ("../uav1", "ca", "", "a" * 80, "uav 1"):
        with pytest.raises(InputError, match="is not a valid identity"):
            issue(tmp_path, name)
    for host in ("192.168..1", "10.0.0.300", "1.2.3", "uav1..local", "-uav1"):
        with pytest.raises(InputError, match=f"'{re.escape(host)}' is neither an IP address nor a host name"):
            issue(tmp_path, "uav2", [host])
    with pytest.raises(InputError, match="neither an IP address nor a host name"):
        issue(tmp_path, "uav2", ["10.0.0.7:7447"])
    with pytest.raises(InputError, match="valid for 1 to"):
        issue(tmp_path, "uav2", days=0)
    assert not (tmp_path / "uav2.key").exists()


@pytest.mark.parametrize("room_bytes", [100, 300])  # less than a key, less than a certificate
def test_a_full_disk_leaves_nothing_that_keeps_the_next_attempt_from_writing(tmp_path: Path, room_bytes: int) -> None:
    init_authority(tmp_path)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room_bytes, hard))
    try:
        with pytest.raises(InputError, match="cannot be written: File too large"):
            issue(tmp_path, "uav1")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["ca.key", "ca.pem"]
    issue(tmp_path, "uav1").check()


def test_the_list_says_until_when(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["keys", "list", "--dir", str(tmp_path)]) == 2
    init_authority(tmp_path)
    issue(tmp_path, "uav1", ["10.0.0.7"], days=30)
    last = datetime.now(UTC) + timedelta(days=30)
    assert listing(tmp_path)[1] == f"uav1             valid until {last:%Y-%m-%d}  uav1, 10.0.0.7"
    assert cli.main(["keys", "list", "--dir", str(tmp_path)]) == 0
    assert "contains no certificates" in capsys.readouterr().err


def test_a_folder_that_cannot_be_is_a_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / ("k" * 300)
    for action in (["init"], ["issue", "uav1"], ["list"]):
        assert cli.main(["keys", *action, "--dir", str(folder)]) == 2
        assert "File name too long" in capsys.readouterr().err
