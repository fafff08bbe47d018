"""Flights that were filmed or recorded, made into scenes that can be flown: a video with telemetry, or MCAP."""
