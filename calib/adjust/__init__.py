"""Least squares on all that was measured: unknowns, solver, blunders, what changed, how sure it is."""
