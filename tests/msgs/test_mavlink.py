"""The dialect against the published checksum and MAVSDK, what is never packed, and reading frames out of bytes."""

from __future__ import annotations

import itertools
import json
import math
import os
import shutil
import socket
import struct
import subprocess
import sys
import threading
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pymavlink
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mavsdk import ComponentType, Configuration, Mavsdk
from mavsdk.plugins.mavlink_direct import MavlinkDirect
from pymavlink.dialects.v20 import ardupilotmega

from msgs import mavlink
from sim_replay.ports import free_port

POSE: dict[str, Any] = {
    "utc_us": 1_700_000_000_123_456,
    "target_id": 2,
    "t_cam_target_m": (1.5, -2.25, 300.125),
    "position_std_m": (0.5, 0.75, 12.0),
    "attitude_std_rad": 0.125,
    "q_cam_target_wxyz": (0.5, 0.5, -0.5, 0.5),
    "q_ned_cam_wxyz": (0.0, 1.0, 0.0, 0.0),
}


def packed_pose(mav: Any, **pose: Any) -> bytes:
    return mavlink.pack(mav, mavlink.target_relative(**pose))


def crc16_mcrf4xx(data: bytes) -> int:
    """The checksum of the MAVLink guide, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0x8408 if crc & 1 else 0)
    return crc


def test_crc_extra_of_the_xml_is_upstreams() -> None:
    sizes = {"uint64_t": 8, "float": 4, "uint8_t": 1}
    message = next(m for m in ET.parse(mavlink.DIALECT_XML).iter("message") if m.get("id") == "511")
    fields = [(f.attrib["type"], f.attrib["name"]) for f in message.iter("field")]
    fields.sort(key=lambda f: sizes[f[0].split("[")[0]], reverse=True)
    data = b"TARGET_RELATIVE "
    for kind, name in fields:
        base, _, count = kind.partition("[")
        data += f"{base} {name} ".encode() + (bytes([int(count[:-1])]) if count else b"")
    crc = crc16_mcrf4xx(data)
    assert (crc & 0xFF) ^ (crc >> 8) == 28
    ours = mavlink.MAVLink_target_relative_message
    assert (ours.id, ours.crc_extra, ours.unpacker.format, ours.unpacker.size) == (511, 28, "<Qfff3ff4f4fBBB", 71)


INCLUDES = "<mavlink><include>common.xml</include><include>uavpose.xml</include><messages/></mavlink>"
READ = """import json, sys, generated
mav = generated.MAVLink(None)
message = mav.decode(bytearray.fromhex(sys.argv[1]))
print(json.dumps([message.get_type(), *(getattr(message, name) for name in sys.argv[2:])]))
"""


@pytest.mark.parametrize("root", ["uavpose.xml", "own.xml"], ids=["by itself", "beside common.xml"])
def test_upstream_s_generator_takes_the_dialect(tmp_path: Path, root: str) -> None:
    shutil.copy(mavlink.DIALECT_XML, tmp_path)
    for name in ("common.xml", "standard.xml", "minimal.xml"):
        shutil.copy(Path(pymavlink.__file__).parent / "dialects" / "v20" / name, tmp_path)
    (tmp_path / "own.xml").write_text(INCLUDES)
    generator = [sys.executable, "-m", "pymavlink.tools.mavgen", "--lang=Python3", "--wire-protocol=2.0"]
    made = subprocess.run(
        [*generator, f"--output={tmp_path / 'generated.py'}", tmp_path / root],
        capture_output=True,
        text=True,
        check=False,
    )
    assert made.returncode == 0, made.stdout + made.stderr
    packed = packed_pose(mavlink.MAVLink(None, srcSystem=1, srcComponent=191), **POSE)
    fields = ["timestamp", "id", "frame", "x", "z", "pos_std", "yaw_std", "q_target", "q_sensor", "type"]
    read = subprocess.run(
        [sys.executable, "-c", READ, packed.hex(), *fields], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    name, timestamp, target_id, frame, x, z, *rest = json.loads(read.stdout)
    assert (name, timestamp, target_id, frame, x, z) == ("TARGET_RELATIVE", POSE["utc_us"], 2, 3, 1.5, 300.125)
    assert rest == [[0.5, 0.75, 12.0], 0.125, [0.5, 0.5, -0.5, 0.5], [0.0, 1.0, 0.0, 0.0], 3]


@pytest.fixture
def ground() -> Iterator[tuple[Mavsdk, int]]:
    """MAVSDK as a ground station listening on a UDP port."""
    port = free_port(socket.SOCK_DGRAM)
    peer = Mavsdk(Configuration.create_with_component_type(ComponentType.GROUND_STATION))
    assert peer.add_any_connection(f"udpin://127.0.0.1:{port}") == 0
    yield peer, port
    peer.destroy()


def test_mavsdk_decodes_target_relative_field_by_field(ground: tuple[Mavsdk, int]) -> None:
    peer, port = ground
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    heartbeat = mavlink.dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    seen, decoded = threading.Event(), threading.Event()
    messages: list[Any] = []
    peer.subscribe_on_new_system(lambda *_: seen.set())
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        while not seen.wait(0.05):
            sender.sendto(mavlink.pack(mav, heartbeat), ("127.0.0.1", port))
        direct = MavlinkDirect(peer.get_systems()[0])
        direct.load_custom_xml(mavlink.DIALECT_XML.read_text())
        direct.subscribe_message("TARGET_RELATIVE", lambda message, _: (messages.append(message), decoded.set()))
        while not decoded.wait(0.05):
            sender.sendto(packed_pose(mav, **POSE), ("127.0.0.1", port))
    assert (messages[0].system_id, messages[0].component_id) == (1, 191)
    fields = json.loads(messages[0].fields_json)
    assert fields == {
        "message_id": 511,
        "message_name": "TARGET_RELATIVE",
        "timestamp": POSE["utc_us"],
        "id": 2,
        "frame": 3,
        "x": 1.5,
        "y": -2.25,
        "z": 300.125,
        "pos_std": [0.5, 0.75, 12.0],
        "yaw_std": 0.125,
        "q_target": [0.5, 0.5, -0.5, 0.5],
        "q_sensor": [0.0, 1.0, 0.0, 0.0],
        "type": 3,
    }


f32 = st.floats(-1e6, 1e6, width=32)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**64 - 1), st.integers(0, 255), st.tuples(f32, f32, f32), st.integers(0, 2**32 - 1))
def test_our_parser_reads_back_what_was_packed(utc_us: int, target_id: int, t: tuple[float, ...], seed: int) -> None:
    q = np.random.default_rng(seed).normal(size=4)
    q = (q / np.linalg.norm(q)).astype(np.float32)
    pose = POSE | {"utc_us": utc_us, "target_id": target_id, "t_cam_target_m": t, "q_cam_target_wxyz": q}
    packet = packed_pose(mavlink.MAVLink(None, 7, 191), **pose)
    (message,) = mavlink.MAVLink(None).parse_buffer(packet)
    assert (message.timestamp, message.id, (message.x, message.y, message.z)) == (utc_us, target_id, t)
    assert np.array_equal(message.q_target, q)
    assert (message.get_srcSystem(), message.get_srcComponent()) == (7, 191)


@pytest.mark.parametrize(
    "change",
    [
        {"t_cam_target_m": (math.nan, 0.0, 1.0)},
        {"t_cam_target_m": (0.0, 1.0)},
        {"t_cam_target_m": (0.0, 0.0, 1e300)},
        {"position_std_m": (1.0, math.inf, 1.0)},
        {"attitude_std_rad": math.nan},
        {"q_cam_target_wxyz": (0.0, 0.0, 0.0, 0.0)},
        {"q_cam_target_wxyz": (math.nan, 0.0, 0.0, 1.0)},
        {"q_ned_cam_wxyz": (1.0, 1.0, 0.0, 0.0)},
        {"utc_us": -1},
        {"target_id": 256},
    ],
)
def test_what_is_no_pose_is_never_packed(change: dict[str, Any]) -> None:
    mav = mavlink.MAVLink(None, 1, 191)
    with pytest.raises(ValueError, match="TARGET_RELATIVE"):
        packed_pose(mav, **(POSE | change))
    assert mav.seq == 0


def test_unknown_own_attitude_is_the_zero_quaternion() -> None:
    packet = packed_pose(mavlink.MAVLink(None, 1, 191), **(POSE | {"q_ned_cam_wxyz": None}))
    (message,) = mavlink.MAVLink(None).parse_buffer(packet)
    assert message.q_sensor == [0.0, 0.0, 0.0, 0.0]


def test_nan_passes_only_where_it_means_unknown() -> None:
    fields = (1, 0, 0, math.nan, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    message = mavlink.dialect.MAVLink_camera_tracking_image_status_message(*fields)
    with pytest.raises(ValueError, match=r"CAMERA_TRACKING_IMAGE_STATUS\.point_x"):
        mavlink.pack(mavlink.MAVLink(None, 1, 100), message)
    assert mavlink.pack(mavlink.MAVLink(None, 1, 100), message, unknown={"point_x"})


def test_sequence_counts_and_wraps() -> None:
    mav, parser = mavlink.MAVLink(None, 1, 191), mavlink.MAVLink(None)
    heartbeat = mavlink.dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    numbers = [parser.parse_buffer(mavlink.pack(mav, heartbeat))[0].get_seq() for _ in range(258)]
    assert numbers == [n % 256 for n in range(258)]


@pytest.mark.parametrize("before", ["", "from pymavlink.dialects.v20 import common"])
def test_a_corrupt_packet_is_refused_whatever_the_environment_says(before: str) -> None:
    script = f"""
{before}
from msgs import mavlink
heartbeat = mavlink.dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
packet = bytearray(mavlink.pack(mavlink.MAVLink(None, 1, 191), heartbeat))
packet[12] ^= 1
try:
    mavlink.MAVLink(None).parse_buffer(packet)
except mavlink.MAVError:
    print("refused")
"""
    run = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | {"MAV_IGNORE_CRC": "0"}, capture_output=True, text=True
    )
    assert run.stdout.strip() == "refused", run.stderr


HEARTBEAT = mavlink.dialect.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3)
TRUNCATED = (b"\xfd", b"\xfe", b"\xfd\xff\x00", b"\xfe\xff", b"\xfd\x00\x02")
JUNK = st.one_of(st.binary(max_size=40), st.sampled_from(TRUNCATED))


def frames_with(junk: list[bytes]) -> bytes:
    """Numbered heartbeats, each behind some junk; what follows the last lets a claimed length run out."""
    mav = mavlink.MAVLink(None, 1, 1)
    return b"".join(piece + mavlink.pack(mav, HEARTBEAT) for piece in junk) + bytes(300)


@given(junk=st.lists(JUNK, max_size=8), cuts=st.lists(st.integers(0, 700), max_size=6))
def test_every_frame_of_a_stream_is_found_whatever_lies_between_and_wherever_it_is_cut(
    junk: list[bytes], cuts: list[int]
) -> None:
    stream, reader = frames_with(junk), mavlink.FrameReader(datagram=False)
    edges = [0, *sorted(min(cut, len(stream)) for cut in cuts), len(stream)]
    found = [m for a, b in itertools.pairwise(edges) for m in reader.feed(stream[a:b])]
    assert [m.get_seq() for m in found] == list(range(len(junk)))


@given(junk=st.lists(JUNK, max_size=8), tail=st.integers(0, 299))
def test_every_frame_of_a_datagram_is_found_and_nothing_is_kept_for_the_next(junk: list[bytes], tail: int) -> None:
    reader = mavlink.FrameReader(datagram=True)
    datagram = frames_with(junk)[: -300 + tail]
    for _ in range(2):
        assert [m.get_seq() for m in reader.feed(datagram)] == list(range(len(junk)))


def test_fourteen_heartbeats_behind_a_truncated_header_are_all_read() -> None:
    mav = mavlink.MAVLink(None, 1, 1)
    datagram = b"\xfd\xff\x00\x00" + b"".join(mavlink.pack(mav, HEARTBEAT) for _ in range(14))
    assert len(mavlink.FrameReader(datagram=True).feed(datagram)) == 14


@pytest.mark.parametrize("before", [b"\xfd\xff\x00", b"\xfe\xff", b"\x00\xfd\xff\x01\x00\xfe\xff"])
def test_no_false_start_in_a_stream_delays_what_follows(before: bytes) -> None:
    """Such as in a message of another dialect, of which ArduPilot sends several a second."""
    mav, reader = mavlink.MAVLink(None, 1, 1), mavlink.FrameReader(datagram=False)
    reader.feed(before)
    for _ in range(3):
        frame = mavlink.pack(mav, HEARTBEAT)
        assert [len(reader.feed(part)) for part in (frame[:5], frame[5:])] == [0, 1]
    assert reader.bad_runs == 1


@given(cuts=st.sets(st.integers(1, 400), max_size=6), before=st.sampled_from([b"", b"\xfe\xff", b"\xfd\xff\x00"]))
def test_what_a_message_carries_is_not_taken_for_messages_wherever_the_stream_is_cut(
    cuts: set[int], before: bytes
) -> None:
    mav, reader = mavlink.MAVLink(None, 1, 1), mavlink.FrameReader(datagram=False)
    frame = mavlink.pack(mav, HEARTBEAT)
    block = list((4 * frame)[:70])
    port = mavlink.dialect.MAVLink_serial_control_message(0, 0, 0, 0, len(block), block).pack(mav)
    tunnel = mavlink.dialect.MAVLink_tunnel_message(0, 0, 0, 128, list((8 * frame)[:128])).pack(mav)
    stream = before + port + frame + tunnel + frame
    ends = [0, *sorted(cut for cut in cuts if cut < len(stream)), len(stream)]
    heard = [message.get_type() for one, two in pairwise(ends) for message in reader.feed(stream[one:two])]
    assert heard == ["SERIAL_CONTROL", "HEARTBEAT", "TUNNEL", "HEARTBEAT"]


@pytest.mark.parametrize("datagram", [True, False])
def test_messages_of_another_dialect_are_not_counted_as_spoilt_bytes(datagram: bool) -> None:
    ardupilot, mav = ardupilotmega.MAVLink(None, 1, 1), mavlink.MAVLink(None, 1, 1)
    reader, heard = mavlink.FrameReader(datagram), 0
    for number in range(256):
        # With a false start inside, whose frame would end there or behind.
        wind = ardupilotmega.MAVLink_wind_message(1.0, struct.unpack("<f", bytes([0xFE, number, 0, 1]))[0], 2.0)
        for frame in (wind.pack(ardupilot), mavlink.pack(mav, HEARTBEAT)):
            heard += len(reader.feed(frame))
    assert (heard, reader.unknown_ids, reader.bad_runs) == (256, 256, 0)


@given(position=st.integers(0, 20), bit=st.integers(0, 7))
def test_a_frame_with_one_bit_wrong_is_no_message(position: int, bit: int) -> None:
    frame = bytearray(mavlink.pack(mavlink.MAVLink(None, 1, 1), HEARTBEAT))
    frame[position] ^= 1 << bit
    reader = mavlink.FrameReader(datagram=True)
    assert reader.feed(bytes(frame)) == []
    assert reader.bad_runs + reader.unknown_ids >= 1


def test_a_flood_of_magic_bytes_is_given_up_and_the_next_frame_read() -> None:
    reader = mavlink.FrameReader(datagram=False)
    assert reader.feed(b"\xfe" * 8192) == []
    assert len(reader.feed(mavlink.pack(mavlink.MAVLink(None, 1, 1), HEARTBEAT))) == 1
