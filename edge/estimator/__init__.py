"""Frame to poses: windows, network, decoding."""
