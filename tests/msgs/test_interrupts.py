"""Ctrl-C while a command is still importing its modules."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

# Interrupts itself where the import of a module begins, as a person may at any moment.
INTERRUPTED = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path, target=None):
        if name == {module!r}:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
sys.argv = ["uavpose", "--help"]
from {entry} import main
sys.exit(main())
"""
ENTRIES = [
    ("edge.launch", "edge.cli"),
    ("msgs.ground.launch", "msgs.ground.cli"),
    ("trainer.launch", "msgs.command_line"),
    ("sim_replay.launch", "msgs.command_line"),
]


def ended(entry: str, module: str, at_ctrl_c: signal.Handlers) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", INTERRUPTED.format(entry=entry, module=module)],
        capture_output=True,
        text=True,
        timeout=60,
        preexec_fn=lambda: signal.signal(signal.SIGINT, at_ctrl_c),
    )


@pytest.mark.parametrize(("entry", "module"), ENTRIES)
def test_a_command_that_is_interrupted_while_it_starts_says_nothing(entry: str, module: str) -> None:
    done = ended(entry, module, signal.SIG_DFL)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_a_command_in_the_background_of_a_script_still_ignores_ctrl_c() -> None:
    done = ended("edge.launch", "edge.cli", signal.SIG_IGN)
    assert (done.returncode, done.stderr) == (0, "")
    assert "usage: uavpose-edge" in done.stdout
