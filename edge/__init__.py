"""The daemon on the companion computer: frames in, target poses out over zenoh and MAVLink."""

import os

# Disables ONNX Runtime's telemetry, which would store an id of the machine on disk and report every session to its
# vendor over any available link. It is read when the library is loaded.
os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
