"""What the simulated pan/tilt units are made of: one table, in half steps, the manuals' own unit.

Sources: PTU-D46 User's Manual 2.14.0 (D46-17: resolution, limits, speed bounds, defaults), PTU-D300 User's
Manual 2.18.0, E Series Command Reference 4.00; D46-70 from its quarter of the D46-17's step (the marketed
0.003° is its eighth step); D48E from its eighth step of 23.142857", of which 27067 make 174°. Where a manual
gives no figure for a model, the D46-17's is scaled by the step, and the tilt range of the -70 units and of
the E46 is -80° to +31°.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

STEPS = MappingProxyType({"F": 2.0, "H": 1.0, "Q": 0.5, "E": 0.25, "A": 0.25})
"""Step modes and their step in half steps: full, half, quarter, eighth, auto (counted in eighths)."""


@dataclass(frozen=True)
class PtuModel:
    """One kind of unit; positions and speeds in half steps.

    Attributes
    ----------
    version
        What ``V`` answers.
    half_step_arcsec
        One half step of either axis, arc seconds.
    pan, tilt
        Lowest and highest position that a reset finds.
    fastest, slowest
        Largest and smallest speed, a second.
    speed, acceleration, base_speed
        Defaults.
    step_mode
        As delivered: a key of ``STEPS``.
    e_series
        Answers as an E series unit: a line feed in front of every answer, no echo at power-up, six decimals,
        the commands B, CEC, PCE and the banner over TCP.
    unsure_arcsec
        What it takes for its half step before its first reset; None when it knows.
    """

    version: str
    half_step_arcsec: float
    pan: tuple[int, int]
    tilt: tuple[int, int]
    fastest: int
    slowest: int = 31
    speed: int = 1000
    acceleration: int = 2000
    base_speed: int = 57
    step_mode: str = "H"
    e_series: bool = False
    unsure_arcsec: float | None = None


_D46 = "Pan-Tilt Controller v2.12.1d1(C14/E), (C)2003 Directed Perception, Inc., All Rights Reserved"
_D47 = "Pan-Tilt Controller v2.14.0(D47-C14/E), (C)2006 Directed Perception, Inc., All Rights Reserved"
_D48 = "Pan-Tilt Controller v3.2.2(D48-C14/E), (C)2010 FLIR Commercial Systems, Inc., All Rights Reserved"
_E46 = "Pan-Tilt Controller v3.2.2(E46-C14/E), (C)2011 FLIR Commercial Systems, Inc., All Rights Reserved"

# 185.142857" is 1296/7": 2000 half steps to 102.857°.
_STEP_17, _STEP_70, _STEP_48 = 1296 / 7, 324 / 7, 648 / 7
_17 = {"half_step_arcsec": _STEP_17, "pan": (-3090, 3090), "tilt": (-907, 604), "fastest": 2902}
_70 = {
    "half_step_arcsec": _STEP_70,
    "pan": (-12366, 12366),
    "tilt": (-6222, 2411),
    "fastest": 5600,
    "speed": 4000,
    "acceleration": 8000,
    "base_speed": 228,
}

MODELS: Mapping[str, PtuModel] = MappingProxyType(
    {
        "d46_17": PtuModel(_D46, **_17),  # type: ignore[arg-type]
        "d46_70": PtuModel(_D46, **_70),  # type: ignore[arg-type]
        "d47": PtuModel(_D47, **_17),  # type: ignore[arg-type]
        "d48e": PtuModel(
            _D48,
            _STEP_48,
            pan=(-6767, 6767),
            tilt=(-3500, 1166),
            fastest=3800,
            speed=2000,
            acceleration=4000,
            step_mode="E",
            e_series=True,
        ),
        "e46_17": PtuModel(_E46, **_17, e_series=True, unsure_arcsec=_STEP_17),  # type: ignore[arg-type]
        "e46_70": PtuModel(_E46, **_70, e_series=True, unsure_arcsec=_STEP_17),  # type: ignore[arg-type]
    }
)
"""Units by name."""
