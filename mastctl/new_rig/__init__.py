"""New simulated rigs: from a few numbers, or the twin of a calibrated one."""
