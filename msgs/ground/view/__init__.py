"""`uavpose-ground view`: what vehicles tell, drawn by Rerun.

`drawing` is the geometry, `scene` turns samples into Rerun entities, `layout` says where they are shown, `recorded`
reads MCAP files, `command` opens a viewer, serves a browser or writes a file.
"""
