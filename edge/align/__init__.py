"""`uavpose-edge align`: how the camera is mounted and how late its stamps are, from motion. Start at `command.py`."""
