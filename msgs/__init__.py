"""What crosses the wire: topics, payloads, the MAVLink dialect, the model contract."""
