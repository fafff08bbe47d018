"""Train, evaluate and export MF-UAVPose6D."""
