"""A survey: the measurements of one calibration (the folder of contract section 2)."""
