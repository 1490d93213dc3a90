"""A survey of the simulated rover with the errors a real one leaves, and the mast file fitted to it."""
