"""A survey: the measurements of one calibration (the folder of docs/how-to/calibrate.md)."""
