"""The daemon on the companion computer: frames in, target poses out over zenoh and MAVLink."""

import os

# Left to itself, ONNX Runtime gives the machine a number, keeps it on disk, and tells its maker of every session over
# whatever link there is. It reads this when it is loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
