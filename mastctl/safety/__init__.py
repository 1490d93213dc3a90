"""What must hold when all else fails: the latched stop, its own socket, the folder in which state is kept."""
