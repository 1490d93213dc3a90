"""Patches of pictures carried from camera to camera, and found again to a fraction of a pixel."""
