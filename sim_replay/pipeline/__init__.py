"""`uavpose-replay bench-pipeline`: measures the daemon for minutes on a replayed camera, against its budgets."""
