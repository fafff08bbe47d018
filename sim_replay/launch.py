"""The `uavpose-replay` command, begun where the packages that it needs may be missing."""

from __future__ import annotations

from importlib import import_module

from edge.errors import InputError
from msgs.command_line import exit_code


def main() -> int:
    """Run `sim_replay.cli`, which needs the extra `replay` from its first line on."""
    return exit_code(lambda: int(import_module("sim_replay.cli").main()), InputError, ["replay", "render"])
