"""From a frame to poses: windows, network, decoding."""
