"""Signals heard by a thread of their own, so that a process obeys whatever its main thread is waiting for."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Mapping


def on_signals(actions: Mapping[signal.Signals, Callable[[], object]]) -> None:
    """From now on call an action for each of these signals, in the thread `signals`, in the order of their arrival.

    Python runs a handler in the main thread alone. When the kernel gives the signal to another thread, as it may to
    any of zenoh's, a main thread that sleeps in a lock never wakes to run it; the wake-up descriptor is written at
    once, by whichever thread it was. An action may take locks, which a handler must not.

    For the main thread of a process, once; raises ValueError in another.
    """
    heard, told = os.pipe()
    os.set_blocking(told, False)
    signal.set_wakeup_fd(told, warn_on_full_buffer=False)
    for number in actions:
        signal.signal(number, lambda *_: None)  # without a handler nothing is written
    threading.Thread(target=_obey, args=(heard, dict(actions)), name="signals", daemon=True).start()


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM and SIGINT (Ctrl-C) set. As `on_signals`: in the main thread, once."""
    stop = threading.Event()
    on_signals(dict.fromkeys((signal.SIGTERM, signal.SIGINT), stop.set))
    return stop


def _obey(heard: int, actions: Mapping[signal.Signals, Callable[[], object]]) -> None:
    while numbers := os.read(heard, 64):
        for number in numbers:
            if number in actions:  # other code of the process may have handlers of its own
                actions[signal.Signals(number)]()
