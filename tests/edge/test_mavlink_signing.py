"""Signing both ways: what pymavlink and the guide's algorithm accept, and what forgers and listeners achieve."""

from __future__ import annotations

import hashlib
import os
import stat
import subprocess
import sys
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from edge.config import load_config
from edge.errors import InputError
from edge.links.signing import RESERVED_AHEAD, TIMESTAMP_MAX, Signing, open_signing, timestamp_of
from edge.links.signing_key import load_key, write_new_key
from msgs.mavlink import FrameReader, MAVLink, dialect, pack

from .mavlink_peer import SYSTEM_ID, Peer, Udp, alone, hear, linked, meet
from .reports import TRACKING
from .reports import make_report as report
from .reports import make_track as track

KEY = bytes(range(32))
NOW_NS = 1_800_000_000_000_000_000  # UTC


def signing(key: bytes = KEY, saved: int = 0, utc_ns: Any = time.time_ns) -> Signing:
    return Signing(key, saved, lambda stamp: None, utc_ns)


def signed_frame(stamp: int, key: bytes = KEY, link: int = 0, system: int = SYSTEM_ID) -> bytes:
    """A heartbeat signed by the guide's algorithm, with hashlib alone."""
    mav = MAVLink(None, system, 1)
    mav.signing.secret_key, mav.signing.sign_outgoing = b"\0" * 32, True
    frame = pack(mav, dialect.MAVLink_heartbeat_message(1, 3, 0, 0, 4, 3))[:-13]
    body = frame + bytes([link]) + stamp.to_bytes(6, "little")
    return body + hashlib.sha256(key + body).digest()[:6]


def parsed(frame: bytes) -> Any:
    (message,) = FrameReader(datagram=True).feed(frame)
    return message


def test_both_ways_over_the_link_with_pymavlink_verifying() -> None:
    with linked(signing=signing()) as (link, own_ship), Peer(link.ports[0], key=KEY) as peer:
        verifier = MAVLink(None)
        verifier.signing.secret_key = KEY
        meet(link, peer)
        hear(own_ship, peer, Rotation.identity())
        peer.received.clear()
        link.publish(report(track(time.monotonic_ns())))
        peer.named("TARGET_RELATIVE")
        for message in peer.received:
            assert verifier.decode(bytearray(message.get_msgbuf())).get_signed()


def test_nothing_unsigned_or_signed_with_another_key_is_believed_or_answered() -> None:
    with (
        linked(signing=signing()) as (link, own_ship),
        Peer(link.ports[0]) as unsigned,
        Peer(link.ports[0], key=bytes(32)) as forger,
        Peer(link.ports[0], key=KEY) as peer,
    ):
        unsigned.heartbeat()
        forger.heartbeat()
        meet(link, peer)
        # From the autopilot's own address too.
        attitude = dialect.MAVLink_attitude_quaternion_message(peer.boot_ms(), 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        peer.wire.send(unsigned.packed(attitude))
        peer.wire.send(forger.packed(attitude))
        peer.settle(lambda: link.counters().get("refused_signature") == 2, "refusal of the forged")
        assert link.counters()["refused_unsigned"] == 2
        assert own_ship.at(time.monotonic_ns()) is None


@pytest.mark.parametrize(
    ("key", "said"), [(None, "that does not sign"), (bytes(32), "that signs with another key")], ids=["none", "another"]
)
def test_why_an_autopilot_that_is_heard_is_not_believed_is_told(
    caplog: pytest.LogCaptureFixture, key: bytes | None, said: str
) -> None:
    with linked(signing=signing()) as (link, _), Peer(link.ports[0], key=key) as peer:
        for _ in range(4):
            peer.heartbeat()
        peer.settle(lambda: said in caplog.text, "the reason")
        assert link.counters().get("received_HEARTBEAT", 0) == 0
    assert caplog.text.count("an autopilot is heard") == 1


def test_a_recorded_message_played_again_is_refused() -> None:
    with linked(signing=signing()) as (link, _), Peer(link.ports[0], key=KEY) as peer:
        meet(link, peer)
        stop = dialect.MAVLink_command_long_message(SYSTEM_ID, 100, 2010, 0, *[0.0] * 7)
        recorded = peer.packed(stop)
        peer.wire.send(recorded)
        peer.named("COMMAND_ACK")
        peer.wire.send(recorded)
        peer.settle(lambda: link.counters().get("refused_replay") == 1, "refusal")
        assert link.counters()["received_COMMAND_LONG"] == 1


class Relay:
    """Hears the autopilot's signed frames and plays each on from an address of its own, `held_s` later."""

    def __init__(self, port: int, held_s: float) -> None:
        self.wire, self.held_s = Udp(port), held_s
        self._heard: deque[tuple[float, bytes]] = deque()

    def hear(self, frame: bytes) -> None:
        self._heard.append((time.monotonic(), frame))

    def play(self) -> None:
        while self._heard and time.monotonic() - self._heard[0][0] >= self.held_s:
            self.wire.send(self._heard.popleft()[1])


class Overheard:
    """The autopilot's way to the link, with the relay listening."""

    def __init__(self, port: int, relay: Relay) -> None:
        self._wire, self._relay, self.there = Udp(port), relay, False

    def send(self, data: bytes) -> None:
        self._relay.hear(data)
        if self.there:
            self._wire.send(data)

    def receive(self) -> bytes:
        return self._wire.receive()

    def close(self) -> None:
        self._wire.close()
        self._relay.wire.close()


def test_who_holds_back_what_the_autopilot_signed_is_heeded_until_it_is_heard_itself() -> None:
    """As after a restart of ours, or while the autopilot's own way was cut: the relay comes first, and is authentic."""
    with linked(signing=signing()) as (link, own_ship):
        link.set_health(TRACKING)
        relay = Relay(link.ports[0], held_s=6.0)
        wire = Overheard(link.ports[0], relay)
        upside_down, level = Rotation.from_euler("x", np.pi), Rotation.identity()
        with Peer(wire, key=KEY) as peer:

            def fly() -> None:
                # It flies upside down until the link hears it, and what the relay holds tells that for long.
                peer.attitude(level if wire.there else upside_down)
                relay.play()

            def tilt_rad() -> float | None:
                now = own_ship.at(time.monotonic_ns())
                return None if now is None else float(Rotation.from_matrix(now.R_ned_body).magnitude())

            peer.settle(lambda: tilt_rad() == pytest.approx(np.pi, abs=1e-3), "what is long over", fly)
            wire.there = True
            peer.settle(lambda: tilt_rad() == pytest.approx(0.0, abs=1e-3), "what is now", fly)
            peer.named("TIMESYNC", fly)
            played = link.counters()["refused_address"]

            def fly_level() -> None:
                fly()
                assert tilt_rad() in (None, pytest.approx(0.0, abs=1e-3))

            peer.settle(lambda: link.counters()["refused_address"] > played + 50, "refusal of the relay", fly_level)


def test_who_is_only_quicker_than_the_autopilot_does_not_take_its_place() -> None:
    """A relay that plays at once what it hears on its way would otherwise have us speak to it instead."""
    with linked(signing=signing()) as (link, _), Peer(link.ports[0], key=KEY) as peer:
        meet(link, peer)
        relay = Udp(link.ports[0])
        beat = dialect.MAVLink_heartbeat_message(dialect.MAV_TYPE_FIXED_WING, peer.autopilot, 0, 0, 4, 3)
        began = time.monotonic()

        def relay_and_forge() -> None:
            relay.send(frame := peer.packed(beat))
            peer.wire.send(frame)
            relay.send(signed_frame(timestamp_of(time.time_ns()) + 1_000_000, key=bytes(32)))
            peer.attitude(Rotation.identity())

        peer.settle(lambda: time.monotonic() - began > 4.0, "four seconds", relay_and_forge)
        assert alone(relay)
        assert peer.named("TIMESYNC", relay_and_forge)
        relay.close()


def test_a_forged_timestamp_from_the_far_future_does_not_block_the_stream() -> None:
    one = signing(utc_ns=lambda: NOW_NS)
    now = timestamp_of(NOW_NS)
    assert one.refusal(parsed(signed_frame(now))) is None
    assert one.refusal(parsed(signed_frame(TIMESTAMP_MAX, key=bytes(32)))) == "signature"
    assert one.refusal(parsed(signed_frame(now + 1))) is None
    assert one.next_timestamp() < now + 10


@given(flipped=st.integers(0, 12 * 8 - 1), stamp=st.integers(0, 1_000_000))
def test_every_bit_of_the_signature_block_counts(flipped: int, stamp: int) -> None:
    one = signing(utc_ns=lambda: NOW_NS)
    frame = bytearray(signed_frame(timestamp_of(NOW_NS) + stamp))
    frame[-1 - flipped // 8] ^= 1 << flipped % 8
    assert one.refusal(parsed(bytes(frame))) == "signature"
    assert one.next_timestamp() <= timestamp_of(NOW_NS) + 1


def test_streams_rise_each_for_itself_and_new_ones_start_no_earlier_than_a_minute_ago() -> None:
    one = signing(utc_ns=lambda: NOW_NS)
    now = timestamp_of(NOW_NS)
    assert one.refusal(parsed(signed_frame(now + 50))) is None
    assert one.refusal(parsed(signed_frame(now + 50))) == "replay"
    assert one.refusal(parsed(signed_frame(now + 49))) == "replay"
    assert one.refusal(parsed(signed_frame(now + 49, link=1))) is None
    assert one.refusal(parsed(signed_frame(now + 49, system=7))) is None
    assert one.refusal(parsed(signed_frame(now - 59 * 100_000, system=8))) is None
    assert one.refusal(parsed(signed_frame(now - 61 * 100_000, system=9))) == "replay"


def test_a_computer_without_the_time_stamps_after_what_it_heard() -> None:
    one = signing(utc_ns=lambda: 0)  # 1970
    heard = timestamp_of(NOW_NS)
    assert one.refusal(parsed(signed_frame(heard))) is None
    assert one.next_timestamp() > heard, "else the autopilot would refuse it"


def test_a_computer_without_the_time_takes_no_stream_older_than_what_it_heard() -> None:
    one = signing(utc_ns=lambda: 0)
    heard = timestamp_of(NOW_NS)
    assert one.refusal(parsed(signed_frame(heard))) is None
    assert one.refusal(parsed(signed_frame(heard - 61 * 100_000, system=9))) == "replay"
    assert one.refusal(parsed(signed_frame(heard - 59 * 100_000, system=9))) is None


@given(clock_ns=st.lists(st.integers(0, 4 * 10**18), min_size=1, max_size=20))
def test_own_timestamps_rise_whatever_the_wall_clock_does_and_keep_up_with_it(clock_ns: list[int]) -> None:
    readings = iter(clock_ns)
    saves: list[int] = []
    one = Signing(KEY, 0, saves.append, lambda: next(readings))
    last = 0
    for utc_ns in clock_ns:
        stamp = one.next_timestamp()
        assert stamp > last
        assert timestamp_of(utc_ns) <= stamp <= saves[-1]
        last = stamp


def test_a_restart_repeats_no_timestamp_even_without_a_clock(tmp_path: Path) -> None:
    key, state = tmp_path / "key", tmp_path / "state"
    write_new_key(key)
    used = [open_signing(key, state, lambda: NOW_NS).next_timestamp()]
    for _ in range(3):
        # No battery keeps the time: after power-up it is 1970.
        one = open_signing(key, state, lambda: 0)
        stamps = [one.next_timestamp() for _ in range(3)]
        assert stamps[0] > used[-1]
        used += stamps
    assert used[-1] - used[0] < 4 * RESERVED_AHEAD
    state.write_bytes(b"\xff torn")
    assert open_signing(key, state, lambda: NOW_NS).next_timestamp() == timestamp_of(NOW_NS)


def test_a_power_cut_that_takes_the_last_save_with_it_has_no_timestamp_repeated() -> None:
    now_ns = NOW_NS
    saves: list[tuple[int, int]] = []  # when, and what
    one = Signing(KEY, 0, lambda stamp: saves.append((now_ns, stamp)), lambda: now_ns)
    one.next_timestamp()
    for now_ns in range(NOW_NS + 5 * 10**9, NOW_NS + 300 * 10**9, 10**8):
        stamp = one.next_timestamp()
        assert stamp <= max(saved for when_ns, saved in saves if when_ns <= now_ns - 5 * 10**9)


def test_an_autopilot_that_knows_the_time_is_believed_however_often_the_link_begins_anew(tmp_path: Path) -> None:
    key, state = tmp_path / "key", tmp_path / "state"
    write_new_key(key)
    used = 0
    for _ in range(6):
        one = open_signing(key, state, time.time_ns)
        with linked(signing=one) as (link, _), Peer(link.ports[0], key=load_key(key)) as peer:
            meet(link, peer)
            stamps = [int.from_bytes(bytes(m.get_msgbuf())[-12:-6], "little") for m in peer.received]
        assert used < min(stamps)
        used = max(stamps)


@pytest.mark.parametrize("clock_ns", [NOW_NS, 0], ids=["with the time", "without"])
def test_crashes_in_a_row_neither_repeat_a_timestamp_nor_shut_out_an_autopilot(tmp_path: Path, clock_ns: int) -> None:
    """Each crash leaves a minute reserved, and an autopilot counts on from what it hears of us."""
    key, state = tmp_path / "key", tmp_path / "state"
    write_new_key(key)
    secret, used = load_key(key), open_signing(key, state, lambda: NOW_NS).next_timestamp()
    for _ in range(5):
        one = open_signing(key, state, lambda: clock_ns)
        assert one.refusal(parsed(signed_frame(used + 1, key=secret))) is None
        assert one.next_timestamp() > used + 1
        used = one.next_timestamp()
    one = open_signing(key, state, lambda: clock_ns)
    restarted = parsed(signed_frame(timestamp_of(NOW_NS), key=secret))
    assert one.refusal(restarted) is None
    assert one.next_timestamp() > used


def test_a_state_from_a_time_to_come_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    key, state = tmp_path / "key", tmp_path / "state"
    write_new_key(key)
    open_signing(key, state, lambda: NOW_NS).next_timestamp()
    open_signing(key, state, lambda: NOW_NS + 10**9)
    assert not caplog.messages, "a restart is no wrong clock"
    open_signing(key, state, lambda: NOW_NS - 30 * 86400 * 10**9)
    (told,) = caplog.messages
    assert f"{state} is 30.0 days ahead of this computer's clock" in told


def test_a_state_that_cannot_be_saved_does_not_stop_the_link(tmp_path: Path) -> None:
    write_new_key(tmp_path / "key")
    one = open_signing(tmp_path / "key", tmp_path / "absent" / "state", time.time_ns)
    assert one.next_timestamp() < one.next_timestamp()


def test_keygen_writes_a_key_for_its_owner_alone_and_never_over_another(tmp_path: Path) -> None:
    out = tmp_path / "mavlink.key"
    command = [sys.executable, "-m", "edge.cli", "keygen", "--out", str(out)]
    made = subprocess.run(command, capture_output=True, text=True, preexec_fn=lambda: os.umask(0))
    assert made.returncode == 0, made.stderr
    assert stat.S_IMODE(out.stat().st_mode) == 0o600
    key = load_key(out)
    assert len(set(key)) > 10
    again = subprocess.run(command, capture_output=True, text=True)
    assert (again.returncode, again.stderr) == (2, f"{out} exists; a key is never overwritten\n")
    assert load_key(out) == key


@pytest.mark.parametrize("spoil", ["open", "short", "absent"])
def test_a_key_file_that_does_not_do_is_a_sentence_that_names_file_and_key(tmp_path: Path, spoil: str) -> None:
    key = tmp_path / "mavlink.key"
    write_new_key(key)
    if spoil == "open":
        key.chmod(0o640)
    elif spoil == "short":
        key.write_bytes(b"password")
    else:
        key.unlink()
    with pytest.raises(InputError, match=str(key)):
        load_key(key)
    config = tmp_path / "flight.toml"
    config.write_text('[camera]\ntype = "sequence"\npath = "."\n[mavlink]\nsigning_key = "mavlink.key"\n')
    with pytest.raises(InputError, match=rf"^{config}:5: \[mavlink\] signing_key: signing key {key} .*[^\n]$"):
        load_config(config)


def test_a_key_from_the_wire_is_not_taken() -> None:
    with linked(signing=signing()) as (link, _), Peer(link.ports[0], key=KEY) as peer:
        meet(link, peer)
        peer.send(dialect.MAVLink_setup_signing_message(SYSTEM_ID, 191, [7] * 32, 2**48 - 1))
        peer.settle(lambda: link.counters().get("refused_message_id") == 1, "refusal")
        peer.command(2010)
        assert peer.named("COMMAND_ACK").command == 2010
