"""Boards to calibrate with: what is printed on them, their files, and their dots and corners in images."""
