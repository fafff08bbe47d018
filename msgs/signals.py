"""Signal handling in a separate thread, so that a process reacts whatever its main thread is blocked on."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Mapping


def on_signals(actions: Mapping[signal.Signals, Callable[[], object]]) -> None:
    """From now on call an action for each of these signals, in the thread `signals`, in the order of their arrival.

    Python runs signal handlers in the main thread only. If the kernel delivers the signal to another thread, e.g. one
    of zenoh's, a main thread that waits for a lock never wakes up to run the handler; the wake-up descriptor, however,
    is written immediately by whichever thread received it. Unlike a handler, an action may take locks.

    Call once, in the main thread; raises ValueError in another.
    """
    heard, told = os.pipe()
    os.set_blocking(told, False)
    signal.set_wakeup_fd(told, warn_on_full_buffer=False)
    for number in actions:
        signal.signal(number, lambda *_: None)  # without a handler, the wake-up descriptor is not written
    threading.Thread(target=_obey, args=(heard, dict(actions)), name="signals", daemon=True).start()


def stop_on_signals() -> threading.Event:
    """An event that SIGTERM, SIGINT (Ctrl-C) and SIGHUP (the terminal is gone) set; SIGHUP not if it was ignored at the
    start, as by nohup. Like `on_signals`, call once, in the main thread."""
    stop = threading.Event()
    actions: dict[signal.Signals, Callable[[], object]] = {signal.SIGTERM: stop.set, signal.SIGINT: stop.set}
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        terminals = [number for number in (1, 2) if os.isatty(number)]

        def hang_up() -> None:
            # What is still said would otherwise raise an error, before the command has saved its work.
            nowhere = os.open(os.devnull, os.O_WRONLY)
            for number in terminals:
                os.dup2(nowhere, number)
            stop.set()

        actions[signal.SIGHUP] = hang_up
    on_signals(actions)
    return stop


def _obey(heard: int, actions: Mapping[signal.Signals, Callable[[], object]]) -> None:
    while numbers := os.read(heard, 64):
        for number in numbers:
            if number in actions:  # other code in the process may have installed handlers too
                actions[signal.Signals(number)]()
