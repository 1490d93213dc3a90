"""The kernel with virtual cameras that the camera tests run on: building it, and booting it.

Only the standard library is used, so that it works before .venv is there.
"""
