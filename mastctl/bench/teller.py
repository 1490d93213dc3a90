"""What a run says to the person at the bench, and what it asks for."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

from calib.plan.placements import Placement
from mastctl.bench.eyes import Head
from mastctl.errors import MastctlError

COLUMNS, ROWS = 33, 11
"""Of each half of a sketch, signs."""


Step = Literal["search", "pictures", "fit", "check"]
"""What a run does beside asking for placements."""

CELLS = (8, 6)
"""Columns and rows into which a picture is divided to tell where corners were seen."""


class NobodyThere(MastctlError):
    """Nobody answers at the terminal."""

    code = "nobody_there"


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    Attributes
    ----------
    placement
        Where it works.
    pictures, most
        Taken of the camera with most of them, and how many there may be.
    predicted_px, target_px, floor_px
        Rms per axis of a first pointing: what the calibration leaves, may leave, and what counts alone leave.
    next_rad
        The next attitude, pan and tilt.
    expected_px
        What is predicted after it.
    cells
        Of each camera how many corners were seen in each of its picture's `CELLS`, row by row.
    """

    placement: str
    pictures: int
    most: int
    predicted_px: float
    target_px: float
    floor_px: float
    next_rad: tuple[float, float]
    expected_px: float
    cells: Mapping[str, tuple[int, ...]]

    @property
    def coverage(self) -> Mapping[str, float]:
        """Part of each camera's picture in which corners were seen, 0 to 1."""
        return {name: sum(map(bool, counts)) / len(counts) for name, counts in self.cells.items()}

    def words(self) -> str:
        """Return it as a line."""
        seen = ", ".join(f"{name} {100 * part:.0f} %" for name, part in self.coverage.items())
        pan, tilt = (math.degrees(angle) for angle in self.next_rad)
        return (
            f"{self.placement}: {self.pictures} of {self.most} pictures a camera; seen over "
            f"{seen or 'nothing'}; pointing to {px(self.predicted_px)} "
            f"(wanted {px(self.target_px)}); most helps pan {pan:+.0f}, "
            f"tilt {tilt:+.0f} degrees: to {px(self.expected_px)}"
        )


class Teller(Protocol):
    """Who is told how a run goes, and places the board."""

    def say(self, sentence: str) -> None:
        """Tell something, once."""
        ...

    def step(self, step: Step) -> None:
        """Tell what is done from now on."""
        ...

    def progress(self, now: Progress) -> None:
        """Tell how far the run is."""
        ...

    def place(self, name: str, placement: Placement, head: Head) -> None:
        """Have the board placed, and return when it stands."""
        ...

    def stands(self, name: str, placement: Placement | None, head: Head) -> None:
        """Know that a run goes on before a board that was placed so."""
        ...


def px(value: float) -> str:
    """Return pixels as a person reads them."""
    if not math.isfinite(value):
        return "? px"
    return f"{value:.2f} px" if value < 10 else f"{value:.0f} px"


def sketch(placement: Placement, board_m: float = 0.5) -> str:
    """Return a placement drawn with signs: from above, and as the head looking straight ahead sees it."""
    above, ahead = _above(placement, board_m), _ahead(placement)
    head = f"{'from above':<{COLUMNS}}   as the head sees it from pan 0, tilt 0"
    return "\n".join([head, *(f"{a}   {b}".rstrip() for a, b in zip(above, ahead, strict=True))])


def _above(placement: Placement, board_m: float) -> list[str]:
    """The head at the bottom, ahead upwards, a metre as wide as high."""
    canvas = [[" "] * COLUMNS for _ in range(ROWS)]
    bearing = math.radians(placement.bearing_deg)
    up_m, right_m = placement.range_m * math.cos(bearing), placement.range_m * math.sin(bearing)
    # Signs are twice as high as wide.
    scale = min((ROWS - 3) / max(up_m + 0.3, 0.5), (COLUMNS / 2 - 2) / 2 / max(abs(right_m) + 0.4, 0.5))
    middle = COLUMNS // 2

    def put(forward_m: float, aside_m: float, sign: str) -> None:
        row, column = ROWS - 1 - round(forward_m * scale), middle + round(2 * aside_m * scale)
        if 0 <= row < ROWS and 0 <= column < COLUMNS:
            canvas[row][column] = sign

    for part in range(1, 8):
        put(part / 8 * up_m, part / 8 * right_m, ".")
    along = bearing - math.radians(placement.turned_deg[0])
    for k in range(-8, 9):
        aside = k / 16 * board_m
        put(up_m - aside * math.sin(along), right_m + aside * math.cos(along), "#")
    put(0.0, 0.0, "H")
    text = f"{placement.range_m:.1f} m"
    row, column = ROWS - 1 - round(0.45 * up_m * scale), middle + round(0.9 * right_m * scale) + 2
    for k, sign in enumerate(text):
        if 0 <= row < ROWS and column + k < COLUMNS:
            canvas[row][column + k] = sign
    return ["".join(line) for line in canvas]


def _ahead(placement: Placement) -> list[str]:
    """A frame of 120 by 80 degrees with the board in it."""
    inner, rows = COLUMNS - 2, ROWS - 2
    canvas = [[" "] * inner for _ in range(rows)]
    canvas[rows // 2][inner // 2] = "+"
    column = round((placement.bearing_deg / 120.0 + 0.5) * (inner - 1))
    row = round((0.5 - placement.height_deg / 80.0) * (rows - 1))
    left, right = ("[", "]")
    turned, raised = placement.turned_deg
    if turned >= 5:
        left, right = "[", ">"
    elif turned <= -5:
        left, right = "<", "]"
    body = "^^" if raised >= 5 else "vv" if raised <= -5 else "##"
    for k, sign in enumerate(left + body + right):
        at = min(max(column - 2 + k, 0), inner - 1)
        canvas[min(max(row, 0), rows - 1)][at] = sign
    edge = "+" + "-" * inner + "+"
    return [edge, *("|" + "".join(line) + "|" for line in canvas), edge]


class Terminal:
    """A person at a terminal: asked in words and a sketch, told line by line on stderr."""

    def __init__(self, board_m: float) -> None:
        self._board_m = board_m

    def say(self, sentence: str) -> None:
        """Write a line."""
        sys.stderr.write(sentence + "\n")
        sys.stderr.flush()

    def step(self, step: Step) -> None:
        """Say nothing: sentences and progress show it."""

    def progress(self, now: Progress) -> None:
        """Write a line."""
        self.say(now.words())

    def stands(self, name: str, placement: Placement | None, head: Head) -> None:
        """A real board stands where it stands."""

    def place(self, name: str, placement: Placement, head: Head) -> None:
        """Ask for the placement, and wait for Enter.

        Raises
        ------
        NobodyThere
            If nobody can answer.
        """
        self.say(
            f"\nPlacement {name}: put the board {placement.words()}.\n{sketch(placement, self._board_m)}"
        )
        sys.stderr.write("It need not be exact. Enter when it stands still (Ctrl-C: later). ")
        sys.stderr.flush()
        if not sys.stdin.readline():
            raise NobodyThere("no one can place the board: standard input has ended")
