"""Converts filmed or recorded flights to scenes that can be flown: a video with telemetry, or MCAP."""
