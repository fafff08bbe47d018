"""A process obeys a signal whichever of its threads the kernel hands it to."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from sim_replay.ports import free_endpoint

# Threads that start later inherit the main thread's mask: the first is the only one that can take a signal.
ANOTHER_THREAD_TAKES_IT = """
import signal, sys, threading
threading.Thread(target=threading.Event().wait, daemon=True).start()
signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM, signal.SIGINT, signal.SIGHUP})
"""
WAITS = """
from msgs.signals import stop_on_signals
stop = stop_on_signals()
print("waiting", flush=True)
stop.wait()
"""
ACTS = """
from msgs.signals import on_signals
over = threading.Event()
on_signals({signal.SIGHUP: lambda: print("again", flush=True), signal.SIGTERM: over.set})
print("waiting", flush=True)
over.wait()
"""
ROUTES = """
from msgs.ground.cli import main
sys.exit(main(sys.argv[1:]))
"""
END_S = 60.0


def started(program: str, *arguments: str) -> subprocess.Popen[str]:
    command = ["env", "--default-signal=HUP", sys.executable, "-c", ANOTHER_THREAD_TAKES_IT + program, *arguments]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def line(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_an_event_is_set_while_the_main_thread_sleeps_on_it(number: signal.Signals) -> None:
    with started(WAITS) as process:
        try:
            assert line(process) == "waiting\n"
            process.send_signal(number)
            assert process.wait(END_S) == 0
        finally:
            process.kill()


def test_each_signal_has_its_own_action() -> None:
    with started(ACTS) as process:
        try:
            assert line(process) == "waiting\n"
            for _ in range(3):
                process.send_signal(signal.SIGHUP)
                assert line(process) == "again\n"
            process.terminate()
            assert process.wait(END_S) == 0
        finally:
            process.kill()


def test_the_router_ends_when_another_thread_takes_the_signal(tmp_path: Path) -> None:
    endpoint, config = free_endpoint(), tmp_path / "router.toml"
    config.write_text(f'listen = ["{endpoint}"]\n')
    with started(ROUTES, "router", "--config", str(config)) as process:
        try:
            assert line(process).startswith(f"listening on {endpoint}")
            process.terminate()
            assert process.wait(END_S) == 0
        finally:
            process.kill()
