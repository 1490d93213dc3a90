"""Answers about guided bench calibrations and reports."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Len
from typing_extensions import TypedDict

from mastctl.answers.words import MOST_CELLS, Angles, BenchState, BenchStep, Count, MaybePixel, Pixel

Cells = Annotated[list[Count], Len(MOST_CELLS, MOST_CELLS)]
Pair = Annotated[list[float], Len(2, 2)]


class PlacementAsked(TypedDict):
    """Where a board is asked for, from the head's axes; ``needs_confirmation``: by an operator.

    ``bearing_deg`` to the right of pan zero, ``height_deg`` above the axes, ``turned_deg``: its face, to the
    head's right and upwards.
    """

    name: str
    range_m: float
    bearing_deg: float
    height_deg: float
    turned_deg: Pair
    description: str
    needs_confirmation: bool


class CoverageTold(TypedDict):
    """How many corners were seen in each cell of a camera's picture, 8 in a row, 6 rows."""

    size_px: Annotated[list[Count], Len(2, 2)]
    cells: Cells


class ReasonTold(TypedDict):
    """One reason of a verdict."""

    grade: str
    sentence: str


class VerdictTold(TypedDict):
    """Whether to trust a calibration: ``good``, ``care``, ``bad``, and why."""

    grade: str
    words: str
    reasons: list[ReasonTold]


class ResidualTold(TypedDict):
    """Rms of a camera's corners: fitted, not fitted, and what was promised of those that were not."""

    camera: str
    rms_px: Pixel | None
    check_rms_px: MaybePixel | None
    promised_px: float | None


class BenchResult(TypedDict):
    """The result of a bench calibration.

    ``pointing_...``: corners that were pointed at, measured and promised; ``calibrated_px``, ``counts_px``:
    what the calibration, and the encoders' counts alone, leave of a first pointing, rms an axis.
    """

    verdict: VerdictTold
    cameras: list[ResidualTold]
    pointing_rms_px: Pixel | None
    pointing_promised_px: float | None
    pointings: Count
    calibrated_px: float | None
    counts_px: float | None
    pictures: Count
    placements: Count
    rover_s: float | None
    notes: list[str]


class BenchRunTold(TypedDict):
    """A bench calibration as far as it is known; ``asking`` waits for a placement."""

    name: str
    begun: str
    by: str
    state: BenchState
    step: BenchStep
    code: str | None
    sentence: str
    simulated: bool | None
    by_hand: bool
    wanted_px: float
    board_m: Pair | None
    asked: PlacementAsked | None
    placements: Count
    pictures: Count
    most: Count
    predicted_px: float | None
    target_px: float | None
    counts_px: float | None
    expected_px: float | None
    next_rad: Angles | None
    cameras: dict[str, CoverageTold]
    curve: list[Pair]
    sentences: list[str]
    unread_lines: Count
    result: BenchResult | None
    mast_file: str | None
    report: str | None


class BenchListed(TypedDict):
    """A bench calibration whose folder is there; ``size_mb``: of its pictures."""

    name: str
    begun: str
    by: str
    board: str
    state: Literal["running", "done", "interrupted", "damaged"]
    sentence: str
    pictures: Count
    size_mb: float
    grade: str | None
    mast_file: str | None
    report: str | None


class BenchTold(TypedDict):
    """The bench calibration at work or the last one, those whose folders are there, and packaged boards."""

    run: BenchRunTold | None
    runs: list[BenchListed]
    boards: list[str]
    folder: str
    masts_folder: str
    simulated: bool


class BenchBegun(TypedDict):
    """A bench calibration that has begun or goes on, is answered, or has ended."""

    run: BenchRunTold


class ReportListed(TypedDict):
    """A report that can be read."""

    name: str
    title: str
    written: str


class ReportsTold(TypedDict):
    """The reports, the newest first, and the folder where others may be put."""

    reports: list[ReportListed]
    folder: str
