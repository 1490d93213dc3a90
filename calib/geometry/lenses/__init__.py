"""Lenses that are not of the CAHV family: OpenCV's, Kannala and Brandt's, mrcal's splines."""
