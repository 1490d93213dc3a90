"""A rig of one's own: what is plugged in, and the files that describe it."""
