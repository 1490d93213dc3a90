"""The bench calibration that drives the head: it finds a board, chooses poses, asks for placements."""
