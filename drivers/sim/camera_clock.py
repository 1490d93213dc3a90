"""When a free-running camera exposes, and what its own clock says about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from drivers.errors import BadOptions
from drivers.sim.section import check_bounds, filled

_BOUNDS: Mapping[str, tuple[float, float]] = {
    "offset_s": (0.0, 1.0),
    "drift_ppm": (-500.0, 500.0),
    "stamped_late_s": (-1.0, 1.0),
}

_ROUNDING_S = 1e-9
"""A frame stamped at the asked moment is not after it, whatever rounding does on the way."""


@dataclass(frozen=True)
class ClockSettings:
    """One camera's entry in the ``clocks`` section of a simulation.

    Attributes
    ----------
    offset_s
        How much later than the others' its first frame is exposed.
    drift_ppm
        How much too fast its clock runs, which paces its frames.
    own_stamps
        Whether that clock stamps them too; else the host's does, as the kernel's for V4L2 cameras.
    stamped_late_s
        How much later than the exposure its stamps are; the negative of it is what the camera's ``offset_s``
        in a configuration should be.
    """

    offset_s: float = 0.0
    drift_ppm: float = 0.0
    own_stamps: bool = True
    stamped_late_s: float = 0.0


def clock_settings(values: Any) -> dict[str, ClockSettings]:
    """Return what a configuration says of cameras' clocks, by name. Raises BadOptions."""
    if not isinstance(values, Mapping):
        raise BadOptions(f"simulation.clocks is {values!r}, expected keys and values by camera's name")
    clocks: dict[str, ClockSettings] = {}
    for name, entry in values.items():
        own: ClockSettings = filled(ClockSettings(), entry, f"simulation.clocks.{name}")
        check_bounds(own, _BOUNDS, f"simulation.clocks.{name}")
        clocks[str(name)] = own
    return clocks


class CameraClock:
    """Turns true times into stamps and back; both agree at ``start_s`` but for ``stamped_late_s``."""

    def __init__(self, settings: ClockSettings, start_s: float) -> None:
        self._pace = 1 + 1e-6 * settings.drift_ppm
        self._drift = 1e-6 * settings.drift_ppm if settings.own_stamps else 0.0
        self._late_s = settings.stamped_late_s
        self._start_s = start_s
        self.first_s = start_s + settings.offset_s
        """When frame 0 is exposed."""

    def true_period_s(self, period_s: float) -> float:
        """Return how long a period by this clock truly is."""
        return period_s / self._pace

    def stamp_s(self, true_s: float) -> float:
        """Return what stands on a frame of a moment."""
        return true_s + ((true_s - self._start_s) * self._drift + self._late_s)

    def true_s(self, stamp_s: float) -> float:
        """Return the moment that a stamp means, and a nanosecond for rounding."""
        since_s = stamp_s - self._late_s - self._start_s
        return stamp_s - (since_s * self._drift / (1 + self._drift) + self._late_s) + _ROUNDING_S
