"""Replay in lock-step: the daemon runs on the sequence's time, so that the same sequence gives the same outputs."""
