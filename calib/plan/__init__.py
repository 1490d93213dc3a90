"""The choice of poses and placements of a bench calibration, by the information of their images."""
