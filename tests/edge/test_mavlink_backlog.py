"""Slow, cut and standing lines: what could not go out in time does not go out later."""

from __future__ import annotations

import contextlib
import os
import pty
import socket
import time
import tty
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from edge import clock
from edge.links import mavlink_messages as words
from edge.links.mavlink_endpoints import NetworkEndpoint, SerialEndpoint
from edge.links.mavlink_packing import Letter, Packer
from edge.links.mavlink_peer import Endpoint
from edge.links.mavlink_recognition import Recognition
from edge.links.mavlink_vehicle import Vehicle
from edge.links.transports.medium import BEHIND_NS, PENDING_MAX, WAITING_MAX_NS, Outbox, Received
from edge.links.transports.serial_port import SerialPort
from edge.links.transports.tcp import TcpServer
from msgs.mavlink import dialect
from tests.waiting import until

TICK_NS = 10_000_000


class Line:
    """Takes so many bytes a tick, and none while it is cut."""

    def __init__(self, per_tick: int) -> None:
        self.per_tick, self.room, self.out = per_tick, 0, bytearray()

    def write(self, data: bytes) -> int:
        if not self.room:
            raise BlockingIOError
        count = min(self.room, len(data))
        self.out += data[:count]
        self.room -= count
        return count


def message(number: int, length: int) -> bytes:
    return number.to_bytes(4, "big") + length.to_bytes(2, "big") + bytes(length - 6)


@given(
    st.integers(1, 400),
    st.lists(st.lists(st.integers(12, 280), max_size=4), min_size=1, max_size=120),
    st.integers(0, 60),
    st.integers(0, 60),
)
def test_what_comes_out_is_whole_in_order_and_not_old(
    per_tick: int, puts: list[list[int]], cut_from: int, cut_for: int
) -> None:
    outbox, line, put_ns, refused, number = Outbox(), Line(per_tick), {}, 0, 0
    begun_ns: dict[int, int] = {}
    read = 0
    for tick in range(len(puts) + 120):
        now_ns = tick * TICK_NS
        for length in puts[tick] if tick < len(puts) else []:
            put_ns[number] = now_ns
            refused += not outbox.put(message(number, length), now_ns)
            number += 1
        line.room = 0 if cut_from <= tick < cut_from + cut_for else line.per_tick
        outbox.flush(line.write, 10**9, now_ns)
        while len(line.out) - read >= 6:
            known = int.from_bytes(line.out[read : read + 4], "big")
            begun_ns.setdefault(known, now_ns)
            length = int.from_bytes(line.out[read + 4 : read + 6], "big")
            if len(line.out) - read < length:
                break
            read += length
    numbers = list(begun_ns)
    assert numbers == sorted(numbers)
    # Six bytes of a message are its number, and may themselves take a few ticks, or wait for the end of a cut.
    slack_ns = (6 // per_tick + 1 + cut_for) * TICK_NS
    assert all(begun_ns[n] - put_ns[n] <= WAITING_MAX_NS + slack_ns for n in numbers)
    after_cut = [n for n in numbers if put_ns[n] >= (cut_from + cut_for) * TICK_NS]
    assert all(begun_ns[n] - put_ns[n] <= WAITING_MAX_NS + (6 // per_tick + 1) * TICK_NS for n in after_cut)
    assert len(numbers) + outbox.expired + refused == number


def test_after_a_cut_nothing_of_what_was_said_meanwhile_comes_out() -> None:
    outbox, line = Outbox(), Line(10**6)
    for tick in range(500):
        outbox.put(message(tick, 60), tick * TICK_NS)
        outbox.flush(line.write, 10**9, tick * TICK_NS)
    line.room = line.per_tick
    outbox.flush(line.write, 10**9, 499 * TICK_NS)
    first = int.from_bytes(line.out[:4], "big")
    # The first may have been begun before the line stood still; a message that is begun is ended.
    second = int.from_bytes(line.out[60:64], "big")
    assert first == 0
    assert second >= 499 - WAITING_MAX_NS // TICK_NS
    assert len(line.out) + 60 * outbox.expired == 500 * 60


def test_no_more_is_handed_on_than_there_is_room_for() -> None:
    outbox, line = Outbox(), Line(10**6)
    line.room = line.per_tick
    while outbox.put(message(0, 100), 0):
        pass
    outbox.flush(line.write, 450, 0)
    assert len(line.out) == 500  # a message is not cut for it
    outbox.flush(line.write, -5, 0)
    assert len(line.out) == 500
    outbox.flush(line.write, 10**9, 0)
    assert len(line.out) == PENDING_MAX // 100 * 100


def test_a_connection_whose_far_end_does_not_answer_is_parted_with_what_it_holds() -> None:
    server = TcpServer(NetworkEndpoint("tcpin", "127.0.0.1", 0, "tcpin:127.0.0.1:0"))
    with contextlib.closing(server), socket.socket() as caller:
        caller.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)  # full soon: nothing more is acknowledged
        caller.connect(("127.0.0.1", server.port))
        caller.send(b"hello")
        heard: list[Received] = []
        until(lambda: heard, lambda: heard.extend(filter(None, [server.receive()])), what="the caller")
        peer = heard[0].sender
        assert server.send(bytes(100), peer)

        def tell() -> None:
            server.send(bytes(250), peer)
            server.tick(time.monotonic_ns())

        until(lambda: not server.reaches(peer), tell, what="the end of the connection")


def test_every_message_that_a_serial_line_does_not_take_is_counted(stepped: int) -> None:
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    device = os.ttyname(theirs)
    port = SerialPort(SerialEndpoint(device, 57600, f"serial:{device}:57600"))
    with contextlib.closing(port):
        port.tick(stepped)
        os.close(theirs)
        os.set_blocking(ours, False)
        sent, length, refused, dropped, read = 600, 280, 0, 0, 0
        for number in range(sent):  # nobody reads: the line is full before the end
            clock.step_to(stepped + number * TICK_NS)
            refused += not port.send(message(number, length), (device,))
            if number % 5 == 0:
                port.tick(clock.monotonic_ns())
                dropped += port.dropped()
        clock.step_to(stepped + sent * TICK_NS + 2 * WAITING_MAX_NS)

        def accounted() -> bool:
            nonlocal read, dropped
            with contextlib.suppress(BlockingIOError):
                read += len(os.read(ours, 65536))
            port.tick(clock.monotonic_ns())  # a message that was begun is ended
            dropped += port.dropped()
            return read // length + refused + dropped == sent

        until(accounted, what="all messages")
    os.close(ours)
    assert 0 < read < sent * length


def test_what_a_connection_still_holds_at_its_end_is_counted() -> None:
    server = TcpServer(NetworkEndpoint("tcpin", "127.0.0.1", 0, "tcpin:127.0.0.1:0"))
    with contextlib.closing(server), socket.create_connection(("127.0.0.1", server.port)) as caller:
        caller.send(b"hello")
        heard: list[Received] = []
        until(lambda: heard, lambda: heard.extend(filter(None, [server.receive()])), what="the caller")
        peer = heard[0].sender
        while server.send(bytes(250), peer):  # nobody reads: then no more fits
            pass
        assert server.dropped() == 0
        caller.close()  # with unread data: a reset
        until(lambda: not server.reaches(peer), lambda: server.receive(), what="the end of the connection")
        assert server.dropped() >= PENDING_MAX // 250
        assert server.dropped() == 0


@pytest.mark.parametrize("targets", [2, 4])
def test_on_a_line_too_slow_for_all_poses_answers_come_out_all_the_same(targets: int) -> None:
    """57600 baud, thirty frames a second: what is sent with frames yields, each kind alike."""
    outbox, line, frame_ns = Outbox(), Line(57), 33_000_000
    put_ns: dict[int, int] = {}
    numbers: dict[str, list[int]] = {"answer": [], "pose": [], "box": []}

    def put(kind: str, length: int, now_ns: int) -> None:
        put_ns[number := len(put_ns)] = now_ns
        numbers[kind].append(number)
        outbox.put(message(number, length), now_ns, yields=kind != "answer")

    for now_ns in range(0, 20_000_000_000, TICK_NS):
        if now_ns % frame_ns < TICK_NS:
            for _ in range(targets):
                put("pose", 83, now_ns)
        if now_ns % 100_000_000 < TICK_NS:
            put("box", 61, now_ns)
        if now_ns % 200_000_000 < TICK_NS:
            put("answer", 28, now_ns)
        line.room = line.per_tick
        outbox.flush(line.write, 10**9, now_ns)
    read, out = 0, set()
    while read + 6 <= len(line.out):
        out.add(int.from_bytes(line.out[read : read + 4], "big"))
        read += int.from_bytes(line.out[read + 4 : read + 6], "big")
    came = {kind: len(out.intersection(of_kind)) / len(of_kind) for kind, of_kind in numbers.items()}
    assert came["answer"] > 0.98, "the last may still wait"
    assert min(came["pose"], came["box"]) > 0.3
    assert len(line.out) > 0.9 * 57 * 2_000, "the line is not idle"


def test_what_is_sent_with_frames_yields_to_answers(stepped: int) -> None:
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    device = os.ttyname(theirs)
    port = SerialPort(SerialEndpoint(device, 57600, f"serial:{device}:57600"))
    vehicle = Vehicle(None, {})
    endpoint = Endpoint(port, [], Counter(), Recognition(vehicle, None, None, Counter()), Packer(0, None))
    text = Letter(dialect.MAVLink_statustext_message(4, b"x" * 50, 0, 0), 1, 191)
    answer = Letter(dialect.MAVLink_command_ack_message(2004, 0, 0, 0, 255, 190), 1, 100)
    box = Letter(words.idle_image_status(), 1, 100, words.IMAGE_STATUS_UNKNOWN)
    with contextlib.closing(port):
        endpoint.tick(stepped)
        os.close(theirs)
        assert endpoint.send(box), "nothing waits yet"
        while endpoint.send(text):  # nobody reads: the line is full, and so is what waits for it
            pass
        clock.step_to(stepped + 2 * WAITING_MAX_NS)
        assert endpoint.send(text)
        clock.step_to(stepped + 2 * WAITING_MAX_NS + 2 * BEHIND_NS)
        assert [endpoint.send(letter) for letter in (box, answer)] == [False, True]
    os.close(ours)
