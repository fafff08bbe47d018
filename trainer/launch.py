"""Entry point of the `uavpose-trainer` command, which also works if its packages are missing."""

from __future__ import annotations

from importlib import import_module

from msgs.interrupts import end_on_interrupt


def main() -> int:
    """Run `trainer.cli`, whose imports require the extra `trainer` and which handles invalid input itself."""
    end_on_interrupt()
    from msgs.command_line import exit_code

    return exit_code(lambda: int(import_module("trainer.cli").main()), (), ["trainer", "render"])
