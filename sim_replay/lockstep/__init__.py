"""Replay in lock-step: the daemon's time is the sequence's, so that the same sequence gives the same outputs."""
