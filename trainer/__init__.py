"""Train, evaluate and export MF-UAVPose6D."""

import os

# ONNX Runtime would tell its maker of every session; it reads this when it is loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
