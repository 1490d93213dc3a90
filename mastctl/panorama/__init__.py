"""Panoramas: taken by the mast, composed by its calibrated models, and clicked."""
