"""Golden files: the daemon's output for a few short sequences in lock-step, compared field by field."""
