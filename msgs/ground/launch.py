"""Entry point of the `uavpose-ground` command."""

from __future__ import annotations

from msgs.interrupts import end_on_interrupt


def main() -> int:
    """Run `msgs.ground.cli`."""
    end_on_interrupt()
    from msgs.ground import cli

    return cli.main()
