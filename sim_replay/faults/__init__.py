"""Faults, played on the real daemon: timelines (TOML) of what breaks and what must follow, and the rig they act on.

`timeline` is the schema, `rig` the processes, `relay` the links between them, `actions` and `expectations` what a step
does, `judge` what must hold all the time, `run` the command.
"""
