"""Vehicles on a bad radio: the daemon's zenoh session and the ground's router with a relay between them that is slow,
lossy and interrupted.

`channel` models a radio's effect on a packet, `relay` applies it on loopback, `vehicle` is the sending process,
`trial` plays one link and checks each pose that the ground would show, `fleet` connects many vehicles to one router,
`run` has the commands.
"""
