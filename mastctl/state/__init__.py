"""What the daemon is doing, in one place, and how each change of it reaches who wants to know."""
