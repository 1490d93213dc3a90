"""Patches of pictures carried from camera to camera, found again to a fraction of a pixel, and followed."""
