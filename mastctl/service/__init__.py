"""What a daemon holds: devices, loops, state, the mast file in use."""
