"""`uavpose-ground view`: shows the vehicles' messages in Rerun.

`drawing` has the geometry, `scene` turns samples into Rerun entities, `layout` arranges the views, `recorded` reads
MCAP files, `viewer` opens a window or serves browsers, `saving` writes a file, `command` combines them.
"""
