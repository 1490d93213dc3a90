"""The pointing experiment through real devices: a kernel's capture nodes and a servo bus on a serial line.

The simulated world (`world`) draws what the cameras see into the HDMI outputs of the kernel's vivid driver,
from where a real capture node hands it to the daemon, and turns with simulated servos that the real SDK
drives over a pseudo terminal. `hil_tests/vm/test_closed_loop.py` runs all of it.
"""
