"""Vehicles on a bad radio: the daemon's zenoh session and the ground's router with a relay between them that is slow,
lossy and interrupted.

`channel` says what a radio does to a packet, `relay` does it on loopback, `vehicle` is the process that sends, `trial`
plays one link and looks at each pose that the ground would show, `fleet` puts many vehicles on one router, `run` the
commands.
"""
