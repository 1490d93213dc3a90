"""What a run reports to the person at the bench, and how it requests a placement."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

from calib.plan.placements import Placement
from mastctl.answers import MOST_CELLS, BenchStep
from mastctl.errors import MastctlError

CELLS = (8, MOST_CELLS // 8)
"""Columns and rows into which an image is divided to count where corners were seen."""


class NoOperator(MastctlError):
    """No operator answers at the terminal."""

    code = "no_operator"


@dataclass(frozen=True)
class BenchProgress:
    """How far a run is.

    Attributes
    ----------
    placement
        Where it works.
    pictures, most
        Taken of the camera with most of them, and how many there may be.
    predicted_px, target_px, counts_px
        Rms per axis of a first pointing: what the calibration leaves, may leave, and what counts alone leave.
        Not finite where it is not known.
    next_rad, expected_px
        The next attitude, pan and tilt, and what is predicted after it.
    cells
        Of each camera how many corners were seen in each of its image's `CELLS`, row by row.
    """

    placement: str
    pictures: int
    most: int
    predicted_px: float
    target_px: float
    counts_px: float
    next_rad: tuple[float, float]
    expected_px: float
    cells: Mapping[str, tuple[int, ...]]

    def sentence(self) -> str:
        """Return it as a line for a terminal."""
        seen = ", ".join(
            f"{name} {100 * sum(map(bool, counts)) / len(counts):.0f} %"
            for name, counts in self.cells.items()
        )
        pan, tilt = (math.degrees(angle) for angle in self.next_rad)
        return (
            f"{self.placement}: {self.pictures} of {self.most} pictures a camera; seen over "
            f"{seen or 'nothing'}; pointing to {px(self.predicted_px)} "
            f"(wanted {px(self.target_px)}); most helps pan {pan:+.0f}, "
            f"tilt {tilt:+.0f} degrees: to {px(self.expected_px)}"
        )


class Reporter(Protocol):
    """Shows the operator how a run goes, and has the board placed."""

    def say(self, sentence: str) -> None:
        """Show a sentence."""
        ...

    def step(self, step: BenchStep) -> None:
        """Show what is done from now on."""
        ...

    def progress(self, now: BenchProgress) -> None:
        """Show how far the run is."""
        ...

    def place(self, name: str, placement: Placement) -> None:
        """Request a placement, and return when the board stands there."""
        ...


def px(value: float | None) -> str:
    """Return pixels as a person reads them."""
    if value is None or not math.isfinite(value):
        return "? px"
    return f"{value:.2f} px" if value < 10 else f"{value:.0f} px"
