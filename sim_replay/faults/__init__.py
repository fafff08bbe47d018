"""Fault injection into the real daemon: timelines (TOML) of faults and required reactions, and the rig they act on.

`timeline` is the schema, `rig` the processes, `relay` the links between them, `actions` and `expectations` implement
the steps, `judge` checks what must always hold, `run` is the command.
"""
