"""Golden files: what the daemon made of a few short sequences in lock-step, held field by field."""
