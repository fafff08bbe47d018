"""What `uavpose-edge doctor` says of the file that keeps the newest signing timestamp, and of who does not sign."""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from edge import doctor_links
from edge.config import MavlinkSettings
from edge.doctor_links import signing_finding
from edge.links.signing import timestamp_of
from edge.links.signing_key import write_new_key
from msgs.mavlink import MAVLink, dialect

from .mavlink_peer import DEADLINE_S

NO_ROOT_KEEPS = """
import encodings.utf_8_sig
import os
from pathlib import Path
from edge.config import load_config
from edge.doctor_links import signing_finding
from edge.links.signing_key import write_new_key
if os.geteuid() == 0:  # who may everything
    os.setgroups([])
    os.setgid(65534)
    os.setuid(65534)
write_new_key(Path("key"))
print(signing_finding(load_config(Path("config.toml")).config.mavlink.signing_state).line())
"""


def test_a_signing_timestamp_in_a_folder_that_may_not_be_entered_is_a_fault_and_no_traceback() -> None:
    with tempfile.TemporaryDirectory() as name:  # whoever is not root may enter this one
        folder = Path(name).resolve()
        folder.chmod(0o777)
        (folder / "home").mkdir(mode=0o000)
        (folder / "config.toml").write_text(
            '[camera]\ntype = "sequence"\npath = "scene"\n'
            '[mavlink]\nsigning_key = "key"\nsigning_state = "home/mavlink.timestamp"\n'
        )
        done = subprocess.run([sys.executable, "-c", NO_ROOT_KEEPS], capture_output=True, text=True, cwd=folder)
        assert f"WRONG  signing      {folder}/home/mavlink.timestamp cannot be written" in done.stdout, done.stderr


def test_a_signing_timestamp_that_cannot_be_kept_is_a_fault(tmp_path: Path) -> None:
    kept = tmp_path / "mavlink.timestamp"
    assert signing_finding(kept).verdict == "good"
    kept.write_text("5")
    assert signing_finding(kept).verdict == "good"
    for lost in (tmp_path / "none" / "mavlink.timestamp", Path("/proc/mavlink.timestamp"), tmp_path):
        found = signing_finding(lost)
        assert (found.verdict, str(lost) in found.says) == ("wrong", True)
        assert "signing_state" in found.advice
    kept.write_text(str(timestamp_of(time.time_ns() + 3 * 86400 * 10**9)))
    found = signing_finding(kept)
    assert (found.verdict, "3.0 days ahead" in found.says, "clock" in found.advice) == ("poor", True, True)


def test_refusals_are_told_where_no_heartbeat_is_accepted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of an autopilot that does not sign; it is listened to until the first refusal, not for four seconds."""
    wait = doctor_links._wait
    monkeypatch.setattr(doctor_links, "_wait", lambda look, _: wait(look, lambda told: "refused_unsigned" in told))
    monkeypatch.setattr(doctor_links, "HEARING_S", DEADLINE_S)
    write_new_key(tmp_path / "key")
    beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, 3, 0, 0, 4, 3).pack(MAVLink(None, 1, 1))
    with socket.socket(type=socket.SOCK_DGRAM) as autopilot, ThreadPoolExecutor() as pool:
        autopilot.bind(("127.0.0.1", 0))
        autopilot.settimeout(DEADLINE_S)
        pool.submit(lambda: autopilot.sendto(beat, autopilot.recvfrom(300)[1]))
        endpoints = [f"udpout:127.0.0.1:{autopilot.getsockname()[1]}"]
        keys = {"signing_key": tmp_path / "key", "signing_state": tmp_path / "mavlink.timestamp"}
        (found,) = doctor_links._mavlink(MavlinkSettings(endpoints=endpoints, **keys))
    assert found.verdict == "wrong"
    assert found.says == f"{endpoints[0]}: no heartbeat within {DEADLINE_S:.0f} s (refused_unsigned 1)"
    assert "signing_key" in found.advice
