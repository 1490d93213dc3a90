"""What lies between an encoder and the load: the encoder's own error, and the play of the gears."""

from __future__ import annotations

import cmath
import math
from collections.abc import Sequence

Harmonics = Sequence[tuple[float, float]]
"""Cosine and sine parts, radians, of the first, second, ... harmonic over a turn."""


def shaft_rad(read_rad: float, harmonics_rad: Harmonics) -> float:
    """Return where a shaft truly is whose encoder reads an angle.

    A disc that sits off its centre is wrong by the first harmonic, one that is oval by the second.
    """
    if not harmonics_rad:
        return read_rad
    once_round = cmath.exp(1j * read_rad)
    wave = 0j
    for cosine, sine in reversed(harmonics_rad):
        wave = (wave + complex(cosine, -sine)) * once_round
    return read_rad + wave.real


def load_after_rad(
    before_rad: float, to_rad: float, gap_rad: float, turnover_rad: float, friction: float
) -> float:
    """Return where the load ends when the shaft has turned one way from within the gap.

    Gravity pulls with sin(turnover - load) of its largest torque, downwards below the turnover. Beyond
    ``friction`` of it the load hangs on the flank that it is pulled to; within, it stays until a flank takes
    it along.

    Parameters
    ----------
    before_rad, to_rad
        The load before, and the shaft now.
    gap_rad
        Full width of the play.
    turnover_rad
        Load angle at which the centre of mass is straight above the axis.
    friction
        Part of the largest torque of gravity that friction holds; 1: all of it.
    """
    load = min(max(before_rad, to_rad - gap_rad / 2), to_rad + gap_rad / 2)
    if friction >= 1.0:
        return load
    torque = math.sin(turnover_rad - load)
    if abs(torque) <= friction:
        return load
    return to_rad - math.copysign(gap_rad / 2, torque)
