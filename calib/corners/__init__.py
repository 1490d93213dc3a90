"""Corners of boards in images: which, where to a few hundredths of a pixel, and how surely."""

from calib.corners.find import CornersNotFound, find_corners

__all__ = ["CornersNotFound", "find_corners"]
