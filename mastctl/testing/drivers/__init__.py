"""Acceptance of a pan/tilt or camera driver: ``pytest --pyargs mastctl.testing.drivers --head DRIVER``."""
