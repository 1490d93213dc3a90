"""Following a target in the daemon: rover poses, the pair that looks, the looks, the track's state."""
