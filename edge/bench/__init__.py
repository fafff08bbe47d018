"""`uavpose-edge bench`: what inference takes on this machine, in ratios first. `command.py` reads top-down."""
