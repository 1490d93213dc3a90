"""The ringing of a mast after its head has moved: one second-order mode an axis, as a pure function of time.

The load hangs on its motor through something elastic (mast, bearings, gears), so the angle x by which it is
ahead of the motor obeys

    x'' + 2 ζ ω x' + ω² x = -g a(t)

with the motor's acceleration a. A profile's acceleration is constant in pieces, so x is a sum of answers to
steps (and, where an axis seizes, to a jump in velocity), each in closed form. Neither the encoder nor the
play of the gears notices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from drivers.sim.motion import Motion

STILL_RAD = 1e-8
"""What is left of a step's answer below this is none: 3e-5 px at a focal length of 3441 px."""


@dataclass(frozen=True)
class Ringing:
    """A mode.

    Attributes
    ----------
    frequency_hz
        Natural frequency ω/2π, above zero.
    damping
        ζ, between 0 and 1, both excluded.
    gain
        g: 1 if all of the load takes part, as on a motor that turns it through a spring.
    """

    frequency_hz: float
    damping: float
    gain: float

    def ahead_rad(self, motion: Motion, time_s: float) -> float:
        """Return by how much the load is ahead of where the gears put it, radians."""
        omega = math.tau * self.frequency_hz
        decay = self.damping * omega
        damped = omega * math.sqrt(1 - self.damping**2)
        left, acceleration = 0.0, 0.0
        for shock in motion.shocks(time_s):
            step, acceleration = shock.acceleration_rad_per_s2 - acceleration, shock.acceleration_rad_per_s2
            by_step, by_jump = step / omega**2, shock.jump_rad_per_s / damped
            envelope = math.exp(-decay * (time_s - shock.time_s))
            if self.gain * (2 * abs(by_step) + abs(by_jump)) * envelope < STILL_RAD:
                continue
            phase = damped * (time_s - shock.time_s)
            swing = by_step * (math.cos(phase) + decay / damped * math.sin(phase))
            left += envelope * (swing - by_jump * math.sin(phase))
        return self.gain * (left - acceleration / omega**2)
