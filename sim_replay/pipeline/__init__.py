"""`uavpose-replay bench-pipeline`: the daemon on a replayed camera for minutes, held to its budgets."""
