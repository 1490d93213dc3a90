"""Servo simulators at the level of bytes: what a real driver talks to over a pseudo terminal or TCP."""
