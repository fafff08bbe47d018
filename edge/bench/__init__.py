"""`uavpose-edge bench`: inference times on this machine, above all as ratios. Start at `command.py`."""
