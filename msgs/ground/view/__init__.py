"""`uavpose-ground view`: what vehicles tell, drawn by Rerun.

`drawing` is the geometry, `scene` turns samples into Rerun entities, `layout` says where they are shown, `recorded`
reads MCAP files, `viewer` opens a window or serves browsers, `saving` writes a file, `command` puts them together.
"""
