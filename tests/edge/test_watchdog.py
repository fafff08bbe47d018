"""The watchdog and a host that stands still: it ends a loop that is stuck, not one that was suspended with it."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from typing import IO

LIMIT_S = 1.0
FLYING = f"""
import sys, threading, time
from edge.watchdog import Watchdog

stick, watchdog = threading.Event(), Watchdog({LIMIT_S}, print)
threading.Thread(target=lambda: (sys.stdin.read(), stick.set()), daemon=True).start()
with watchdog.armed():
    while not stick.wait(0.01):
        watchdog.beat(time.monotonic_ns())
        print("turn", flush=True)
    threading.Event().wait()
"""


def turns(said: IO[str], count: int) -> bool:
    return all(said.readline() == "turn\n" for _ in range(count))


def test_a_loop_that_was_suspended_with_its_process_flies_on_and_one_that_is_stuck_is_ended() -> None:
    pipe = subprocess.PIPE
    with subprocess.Popen([sys.executable, "-c", FLYING], text=True, stdin=pipe, stdout=pipe, stderr=pipe) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        assert turns(process.stdout, 20)
        for _ in range(2):
            process.send_signal(signal.SIGSTOP)
            time.sleep(2.0 * LIMIT_S)
            process.send_signal(signal.SIGCONT)
            assert turns(process.stdout, 50), "ended though it was not stuck"
        process.stdin.close()
        assert process.wait(timeout=60) == 70


SLOW_START = f"""
import time
from edge.watchdog import Watchdog

watchdog = Watchdog({LIMIT_S}, print)
with watchdog.armed():
    time.sleep({0.5 * LIMIT_S})
    watchdog.beat(time.monotonic_ns())
"""

SPEECHLESS = """
import threading
from edge.watchdog import Watchdog

forever = threading.Event()
with Watchdog(0.1, lambda sentence: forever.wait()).armed():
    forever.wait()
"""


def test_a_first_turn_that_takes_long_is_not_counted_from_before_it() -> None:
    assert subprocess.run([sys.executable, "-c", SLOW_START], timeout=60, check=False).returncode == 0


def test_last_words_that_nobody_takes_do_not_keep_a_stuck_process_from_ending() -> None:
    assert subprocess.run([sys.executable, "-c", SPEECHLESS], timeout=60, check=False).returncode == 70
