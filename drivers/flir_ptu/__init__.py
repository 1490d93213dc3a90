"""Directed Perception / FLIR pan/tilt units (D46, D47, D48E, E46) over their ASCII protocol."""
