"""How long a command is given that asks for no time of its own.

Each move has its own deadline, from distance over speed (`mastctl.motion.head`); this one is behind
those, for an operation as a whole.
"""

from __future__ import annotations

from mastctl.devices.limits import Limits

LOOKS_S = 120.0  # a pointing's pictures, each of which may be waited for
MARGIN_S = 15.0


def usual_s(limits: Limits, looks: int) -> float:
    """Return how long an operation is given that moves the head, seconds.

    Parameters
    ----------
    limits
        The longest way there is, one axis after the other, and the speed.
    looks
        How often it goes there and looks; 0 for a move without a picture.
    """
    way_rad = sum(high - low for low, high in (limits.pan_rad, limits.tilt_rad))
    way_s = way_rad / limits.speed_rad_per_s
    return max(1, looks) * way_s + looks * LOOKS_S + MARGIN_S
