"""Train, evaluate and export MF-UAVPose6D."""

import os

# Disables ONNX Runtime's telemetry; read when it is loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
