"""What a picture of a board would tell: the choice of poses and placements of a bench calibration."""
