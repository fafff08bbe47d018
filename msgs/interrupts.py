"""What Ctrl-C does to a command that is still being imported: end it without a traceback, as it ends other programs."""

from __future__ import annotations

import signal


def end_on_interrupt() -> None:
    """From now on Ctrl-C ends the process at once; a shell reports 130. Not if it was started with Ctrl-C ignored.

    Call first of all, in the main thread: an interrupted import raises KeyboardInterrupt where nothing can catch it.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def raise_on_interrupt() -> None:
    """Undo `end_on_interrupt`: Ctrl-C raises KeyboardInterrupt again, so that a command can save its work."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
        signal.signal(signal.SIGINT, signal.default_int_handler)
