"""For all tests: properties have no deadline on a busy machine, and the end tells how long each fault was felt."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Callable, Generator

import pytest
from hypothesis import settings

settings.register_profile("any machine", deadline=None)
settings.load_profile("any machine")
# A shell that runs the tests in the background has Ctrl-C ignored, and all that is started here would ignore it too.
signal.signal(signal.SIGINT, signal.default_int_handler)
# Images for containers often forbid bytecode: then each of the hundreds of processes compiles what it imports anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# NumPy's and SciPy's threads spin when they are started, in each of those processes; no matrix here is large enough
# for more than one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

RECOVERY = "recovery"  # the user property in which a test leaves a line for the closing report


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """What is imported and collected stays to the end: to look for garbage in it took a third of the collection."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    lines = [
        str(text)
        for outcome in ("passed", "failed")
        for report in terminalreporter.getreports(outcome)
        if report.when == "call"
        for name, text in report.user_properties
        if name == RECOVERY
    ]
    if lines:
        terminalreporter.write_sep("=", "faults, and how long until all was well again")
        for line in sorted(lines):
            terminalreporter.write_line(line)


@pytest.fixture
def tell_recovery(record_property: Callable[[str, object], None]) -> Callable[[str], None]:
    """Called with a line, has the closing report show it, also from a worker of xdist."""
    return lambda line: record_property(RECOVERY, line)
