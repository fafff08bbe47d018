"""The simulated autopilot as a process, met over a real UDP socket by the plain pymavlink parser."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from msgs.mavlink import MAVLink, dialect, pack, target_relative
from sim_replay.autopilot import COMPONENT_ID, SYSTEM_ID
from sim_replay.telemetry import COLUMNS, Telemetry, TelemetryError, read_telemetry, write_telemetry
from tests.waiting import WITHIN_S


def turning_flight() -> Telemetry:
    """Six seconds of a banked turn at 50 Hz, from a second before frame 0."""
    t_s = np.arange(-1.0, 5.0, 0.02)
    attitude = Rotation.from_euler("ZYX", np.stack([0.3 * t_s, 0.05 * np.sin(t_s), 0.5 + 0 * t_s], axis=1))
    x, y, z, w = attitude.as_quat().T
    ramp = np.outer(t_s, [25.0, 3.0, -1.0])
    constant = np.tile([0.01, 0.14, 0.26, 25.0, 3.0, -1.0, 47.0, 8.0, 500.0], (len(t_s), 1))
    rates, velocity, globe = constant[:, :3], constant[:, 3:6], constant[:, 6:]
    return Telemetry((t_s * 1e9).round().astype(np.int64), np.column_stack([w, x, y, z, rates, ramp, velocity, globe]))


class Daemon:
    """The other end of the link: a socket and the parser, nothing of the daemon's code."""

    def __init__(self, folder: Path, flight: Telemetry | None = None) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(5.0)
        self.mav = MAVLink(None, srcSystem=SYSTEM_ID, srcComponent=191)
        self.start_at_ns = time.monotonic_ns() + 1_500_000_000
        write_telemetry(folder / "telemetry.csv", flight or turning_flight())
        endpoint = f"127.0.0.1:{self.socket.getsockname()[1]}"
        arguments = ["--telemetry", str(folder / "telemetry.csv"), "--endpoint", endpoint]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "sim_replay.autopilot", *arguments, "--start-at-ns", str(self.start_at_ns)],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self.process.stdout is not None
        ready = json.loads(self.process.stdout.readline())
        self.address = ("127.0.0.1", ready["port"])

    def messages(self) -> Iterator[tuple[int, Any]]:
        """(monotonic ns of arrival, message) for ever; socket.timeout ends a test that waits in vain."""
        while True:
            datagram, sender = self.socket.recvfrom(65535)
            arrival_ns = time.monotonic_ns()
            assert sender == self.address
            for message in MAVLink(None).parse_buffer(datagram) or []:
                yield arrival_ns, message

    def first(self, name: str) -> Any:
        return next(message for _, message in self.messages() if message.get_type() == name)

    def send(self, message: Any) -> None:
        self.send_bytes(pack(self.mav, message))

    def send_bytes(self, data: bytes) -> None:
        self.socket.sendto(data, self.address)

    def stop(self) -> list[dict[str, Any]]:
        self.process.send_signal(signal.SIGTERM)
        out, _ = self.process.communicate(timeout=5)
        return [json.loads(line) for line in out.splitlines()]

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        self.socket.close()


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    with closing(Daemon(tmp_path)) as peer:
        yield peer


def boot_offset_ns(daemon: Daemon) -> int:
    """Monotonic time of the autopilot's boot, by one TIMESYNC exchange."""
    sent_ns = time.monotonic_ns()
    daemon.send(dialect.MAVLink_timesync_message(0, sent_ns))
    arrival_ns, reply = next((at, m) for at, m in daemon.messages() if m.get_type() == "TIMESYNC")
    assert reply.ts1 == sent_ns
    return (sent_ns + arrival_ns) // 2 - reply.tc1


def test_it_is_an_ardupilot_plane(daemon: Daemon) -> None:
    heartbeat = daemon.first("HEARTBEAT")
    assert (heartbeat.type, heartbeat.autopilot) == (dialect.MAV_TYPE_FIXED_WING, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA)
    assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (SYSTEM_ID, COMPONENT_ID)


def test_attitude_and_position_are_the_telemetrys_at_their_own_boot_time(daemon: Daemon) -> None:
    flight = turning_flight()
    truth = Slerp(flight.t_ns * 1e-9, Rotation.from_quat(flight.values[:, :4], scalar_first=True))
    boot_at_ns = boot_offset_ns(daemon)
    attitudes = positions = 0
    for _, message in daemon.messages():
        if message.get_type() not in ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED"):
            continue
        t_s = (boot_at_ns + message.time_boot_ms * 1_000_000 - daemon.start_at_ns) * 1e-9
        if t_s < -0.9:
            continue
        if message.get_type() == "LOCAL_POSITION_NED":
            # Stamps are whole milliseconds: 25 m/s makes 2.5 cm of one. The exchange that tells the boot time errs by
            # some more where cores are short; a sample's period, 20 ms, would be 0.5 m.
            np.testing.assert_allclose([message.x, message.y, message.z], np.outer(t_s, [25, 3, -1])[0], atol=0.25)
            positions += 1
        else:
            sent = Rotation.from_quat([message.q1, message.q2, message.q3, message.q4], scalar_first=True)
            assert np.rad2deg((truth([t_s])[0].inv() * sent).magnitude()) < 0.2
            attitudes += 1
        if attitudes >= 50:
            break
    assert positions >= 10


def test_a_speed_that_a_message_has_no_room_for_is_told_as_the_largest(tmp_path: Path) -> None:
    flight = turning_flight()
    flight.values[:, 10:13] = (400.0, -400.0, 3.0)  # as a fast own ship has it at several times its speed
    with closing(Daemon(tmp_path, flight)) as daemon:
        for _, message in daemon.messages():
            if message.get_type() == "GLOBAL_POSITION_INT" and message.vz == 300:
                break
        assert (message.vx, message.vy) == (32767, -32767)
        local = next(one for _, one in daemon.messages() if one.get_type() == "LOCAL_POSITION_NED" and one.vz == 3.0)
        assert (local.vx, local.vy) == (400.0, -400.0)


def test_it_sets_intervals_with_an_acknowledgement_and_denies_what_it_lacks(daemon: Daemon) -> None:
    def ask(message_id: int, interval_us: float) -> int:
        command = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
        target = (SYSTEM_ID, COMPONENT_ID, command, 0, message_id, interval_us)
        daemon.send(dialect.MAVLink_command_long_message(*target, 0, 0, 0, 0, 0))
        return int(daemon.first("COMMAND_ACK").result)

    assert ask(dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 100_000) == dialect.MAV_RESULT_ACCEPTED
    assert ask(dialect.MAVLINK_MSG_ID_RAW_IMU, 100_000) == dialect.MAV_RESULT_DENIED
    stamps_ms = []
    for _, message in daemon.messages():
        if message.get_type() == "ATTITUDE_QUATERNION":
            stamps_ms.append(message.time_boot_ms)
        if len(stamps_ms) == 8:
            break
    assert 80 < np.median(np.diff(stamps_ms)) < 120


def test_it_records_valid_target_poses_and_refuses_the_rest_by_reason(daemon: Daemon) -> None:
    def target(utc_us: int) -> bytes:
        pose = target_relative(
            utc_us=utc_us,
            target_id=0,
            t_cam_target_m=(1.0, 2.0, 300.0),
            position_std_m=(1.0, 1.0, 9.0),
            attitude_std_rad=0.1,
            q_cam_target_wxyz=(1.0, 0.0, 0.0, 0.0),
            q_ned_cam_wxyz=None,
        )
        return pack(daemon.mav, pose)

    daemon.first("HEARTBEAT")
    for utc_us in (1_000_000, 2_000_000, 2_000_000):
        daemon.send_bytes(target(utc_us))
    not_finite = bytearray(target(3_000_000))
    not_finite[10 + 8 : 10 + 12] = np.float32(np.nan).tobytes()
    crc = dialect.x25crc(bytes(not_finite[1:-2]))
    crc.accumulate(bytes([28]))
    not_finite[-2:] = crc.crc.to_bytes(2, "little")
    daemon.send_bytes(bytes(not_finite))
    daemon.send_bytes(np.random.default_rng(3).bytes(10_000))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(target(4_000_000), daemon.address)
    boot_offset_ns(daemon)  # its answer says that all the above was read
    *records, summary = daemon.stop()
    assert [record["capture_utc_us"] for record in records] == [1_000_000, 2_000_000]
    assert records[0]["t_cam_target_m"] == [1.0, 2.0, 300.0]
    assert summary["received"] == {"TARGET_RELATIVE": 2, "TIMESYNC": 1}
    refused = summary["refused"]
    assert refused["TARGET_RELATIVE is not newer than the last"] == 1
    assert refused["TARGET_RELATIVE is not finite"] == 1
    assert refused["sender is not the daemon"] == 1
    assert refused["not MAVLink"] >= 1


def test_a_full_disk_is_told_in_a_sentence(tmp_path: Path) -> None:
    write_telemetry(tmp_path / "telemetry.csv", turning_flight())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as link:
        link.bind(("127.0.0.1", 0))
        arguments = ["--telemetry", str(tmp_path / "telemetry.csv"), "--endpoint", f"127.0.0.1:{link.getsockname()[1]}"]
        arguments += ["--start-at-ns", "0", "--messages", "/dev/full"]
        command = [sys.executable, "-m", "sim_replay.autopilot", *arguments]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as autopilot:
            assert autopilot.stdout is not None
            port = json.loads(autopilot.stdout.readline())["port"]
            asked = pack(MAVLink(None, srcSystem=SYSTEM_ID), dialect.MAVLink_timesync_message(0, 1))
            link.sendto(asked, ("127.0.0.1", port))
            _, said = autopilot.communicate(timeout=WITHIN_S)
    assert (autopilot.returncode, said) == (2, "/dev/full: cannot be written: No space left on device\n")


def test_telemetry_survives_the_file_and_rests_outside_it(tmp_path: Path) -> None:
    flight = turning_flight()
    write_telemetry(tmp_path / "telemetry.csv", flight)
    again = read_telemetry(tmp_path / "telemetry.csv")
    np.testing.assert_array_equal(again.t_ns, flight.t_ns)
    np.testing.assert_allclose(again.values, flight.values, atol=1e-3)
    before = again.at(int(flight.t_ns[0]) - 10**9)
    np.testing.assert_allclose(before.t_ned_body_m, [-25.0, -3.0, 1.0], atol=1e-3)
    assert not before.v_ned_body_mps.any()
    assert not before.rates_body_radps.any()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("t_ns,lat_deg\n0,1\n", "column q_ned_body_w is missing"),
        (",".join(COLUMNS) + "\n0,1,0,0,oops" + ",0" * 12 + "\n", "line 2"),
        (",".join(COLUMNS) + 2 * ("\n5,1" + ",0" * 15) + "\n", "must rise"),
        (",".join(COLUMNS) + "\n5" + ",0" * 16 + "\n6" + ",0" * 16 + "\n", "unit length"),
    ],
)
def test_telemetry_that_cannot_be_used_is_told_in_a_sentence(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "telemetry.csv"
    path.write_text(text)
    with pytest.raises(TelemetryError, match=complaint) as raised:
        read_telemetry(path)
    assert str(path) in str(raised.value)
