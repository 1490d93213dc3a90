"""Between the scene's light and a frame's bytes: what a simulated camera makes of it."""
