"""The daemon on the companion computer: frames in, target poses out over zenoh and MAVLink."""
