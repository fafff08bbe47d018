"""`uavpose-replay matrix`: sequences at several speeds, with and without faults, in one table."""
