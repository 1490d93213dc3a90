"""From measurements to a rig: starts, least squares, outliers, covariance."""
