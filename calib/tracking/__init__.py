"""One target followed while the rover moves."""
