"""Whoever reads the daemon's log, or does not: it flies on."""

from __future__ import annotations

import fcntl
import io
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

from edge.links.zenoh_commands import LOGGED_AT_ONCE
from edge.logs import LINES_WAITING, PatientStream
from msgs.client import connect
from sim_replay.ports import free_port
from tests.waiting import until

from .flying import flying, toml

RELOADS = 25  # each is two lines of the log and more, of which forty fill the pipe


def test_a_log_that_nobody_reads_keeps_the_daemon_from_nothing(tmp_path: Path, toy_model: Path, swaying: Path) -> None:
    port = free_port()
    with (
        flying(tmp_path, toml(swaying, toy_model, port)) as flight,
        connect(f"tcp/127.0.0.1:{port}") as ground,
    ):
        assert flight.process.stderr is not None
        fcntl.fcntl(flight.process.stderr, fcntl.F_SETPIPE_SZ, 4096)
        done = 0
        while done < RELOADS:
            (reply,) = ground.get("uavpose/@v1/uav1/cmd/reload", timeout=20.0)
            assert reply.ok is not None, "no answer"
            said = reply.ok.payload.to_bytes()
            assert b"nothing has changed" in said or b"under way" in said
            done += b"nothing has changed" in said
        flight.process.terminate()
        assert flight.process.wait(timeout=60) == 0


def test_a_flood_of_commands_fills_no_log(tmp_path: Path, toy_model: Path, swaying: Path) -> None:
    port = free_port()
    with (
        flying(tmp_path, toml(swaying, toy_model, port)) as flight,
        connect(f"tcp/127.0.0.1:{port}") as ground,
    ):
        began = time.monotonic()
        for _ in range(200):
            (reply,) = ground.get("uavpose/@v1/uav1/cmd/loop", timeout=20.0)
            assert reply.ok is not None
        flood_s = time.monotonic() - began
        flight.process.terminate()
        flight.until("stopped: ")
    told = sum("command over zenoh" in line for line in flight.lines)
    assert 1 <= told <= LOGGED_AT_ONCE + flood_s + 1


LOGS_A_FAULT = """
import logging, os, sys
from edge.logs import set_up_logging
if sys.argv[1] == "journal":
    opened = os.fstat(2)
    os.environ["JOURNAL_STREAM"] = f"{opened.st_dev}:{opened.st_ino}"
set_up_logging()
logging.getLogger("camera").info("open")
try:
    raise ValueError("torn")
except ValueError:
    logging.getLogger("camera").exception("failed")
logging.shutdown()
"""


def test_the_journal_is_told_how_grave_each_line_is_and_a_terminal_when_it_was() -> None:
    def logged(reader: str) -> list[str]:
        command = [sys.executable, "-c", LOGS_A_FAULT, reader]
        return subprocess.run(command, capture_output=True, text=True, check=True).stderr.splitlines()

    journal, terminal = logged("journal"), logged("terminal")
    assert journal[0] == "<6>INFO camera: open"
    assert journal[1] == "<3>ERROR camera: failed"
    assert journal[-1] == "<3>ValueError: torn"
    assert terminal[0].endswith(" INFO camera: open")
    assert terminal[0][:4].isdecimal()


LOGS_TO_NOBODY = """
import logging, os
from edge.logs import set_up_logging
set_up_logging()
logging.getLogger("camera").error("lost")
print(os.open(os.devnull, os.O_RDONLY) > 2)
"""


def test_where_standard_error_is_closed_nothing_that_is_opened_later_takes_its_place() -> None:
    command = ["sh", "-c", 'exec "$@" 2>&-', "sh", sys.executable, "-c", LOGS_TO_NOBODY]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    assert done.stdout == "True\n"


def test_what_a_slow_reader_missed_is_told_to_it() -> None:
    read_end, write_end = os.pipe()
    fcntl.fcntl(write_end, fcntl.F_SETPIPE_SZ, 4096)
    with open(write_end, "w", encoding="utf-8") as pipe:
        stream = PatientStream(pipe)
        for k in range(2 * LINES_WAITING):
            stream.write(f"line {k:05d} {'.' * 80}\n")
        got = io.StringIO()

        def read() -> None:
            while data := os.read(read_end, 4096):
                got.write(data.decode())

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        until(lambda: got.getvalue().count("line ") >= LINES_WAITING, what="what waited")
        stream.write("the last\n")
        until(lambda: got.getvalue().endswith("the last\n"), what="the last line")
    reader.join()
    os.close(read_end)
    lines = got.getvalue().splitlines()
    # More than once, if the pipe took a line while others were lost still.
    told = sum(int(line.split()[0]) for line in lines if line.endswith("nobody read it"))
    written = [line for line in lines if line.startswith("line ")]
    assert told + len(written) == 2 * LINES_WAITING
    assert written == sorted(written)
