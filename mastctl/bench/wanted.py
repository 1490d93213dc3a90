"""What a bench is to reach, and when it stops trying."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

FEWEST_LOOKS = 8
"""Of a placement: fewer leave the board's own place, and so what it tells, to chance."""

TURN_S = 1.5
"""Between two looks, for the head to get there."""


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

    def will_take(self, picture_s: Mapping[str, float], pointing: Collection[str], choice_s: float) -> str:
        """Return in words how long a run takes.

        Parameters
        ----------
        picture_s
            Of each camera, how long a picture and finding its corners take, seconds.
        pointing
            The cameras of which each look takes a picture; of the others only where they may see the board.
        choice_s
            How long it takes to choose where to look next, seconds.
        """
        fewest = self.placements[0] * FEWEST_LOOKS + self.checks
        least_s = choice_s + TURN_S + sum(picture_s[name] for name in pointing)
        most_s = choice_s + TURN_S + sum(picture_s.values())
        slowest = max(picture_s, key=picture_s.__getitem__)
        return (
            f"{fewest} to {self.pictures} looks will take {_minutes(fewest * least_s)} to "
            f"{_minutes(self.pictures * most_s)} minutes here: one of all {len(picture_s)} cameras "
            f"{most_s:.1f} s ({slowest} {picture_s[slowest]:.1f} s, the choice of the next "
            f"{choice_s:.1f} s), "
            f"of {', '.join(pointing)} alone {least_s:.1f} s; --cameras leaves others out"
        )


def _minutes(seconds: float) -> str:
    return f"{seconds / 60.0:.2g}" if seconds < 600.0 else f"{seconds / 60.0:.0f}"
