"""What a bench is to reach, and when it stops trying."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Wanted:
    """What a run is to reach, and when it stops trying.

    Attributes
    ----------
    pointing_px
        Rms per axis of a first pointing that the calibration may leave, on paper.
    pictures
        Of a camera, at most; the check's are among them.
    placements
        Fewest and most.
    checks
        Looks that are not fitted.
    """

    pointing_px: float = 0.2
    pictures: int = 60
    placements: tuple[int, int] = (2, 4)
    checks: int = 5

    def at_least_px(self, floor_px: float) -> float:
        """Return what the calibration may leave: as asked, or what counts leave anyway."""
        return max(self.pointing_px, floor_px)
