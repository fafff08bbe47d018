"""Entry point of the `uavpose-edge` command."""

from __future__ import annotations

from msgs.interrupts import end_on_interrupt


def main() -> int:
    """Run `edge.cli`."""
    end_on_interrupt()
    from edge import cli

    return cli.main()
