"""Entry point of the `uavpose-replay` command, which also works if its packages are missing."""

from __future__ import annotations

from importlib import import_module

from msgs.interrupts import end_on_interrupt


def main() -> int:
    """Run `sim_replay.cli`, whose imports require the extra `replay`."""
    end_on_interrupt()
    from edge.errors import InputError
    from msgs.command_line import exit_code

    return exit_code(lambda: int(import_module("sim_replay.cli").main()), InputError, ["replay", "render"])
