"""Answers about bench calibrations and reports."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Len
from typing_extensions import TypedDict

from mastctl.answers.status import MOST_CELLS, Angles, BenchState, BenchStep, Count, Json, MaybePixel

Cells = Annotated[list[Count], Len(MOST_CELLS, MOST_CELLS)]
Pair = Annotated[list[float], Len(2, 2)]


class RequestedPlacement(TypedDict):
    """Where a board is to be placed, from the head's axes; ``needs_confirmation``: by an operator.

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


class Coverage(TypedDict):
    """How many corners were seen in each cell of a camera's image, 8 in a row, 6 rows."""

    size_px: Annotated[list[Count], Len(2, 2)]
    cells: Cells


class VerdictReason(TypedDict):
    """One reason of a verdict."""

    grade: str
    sentence: str


class VerdictAnswer(TypedDict):
    """Whether to trust a calibration: ``good``, ``care``, ``bad``, and why."""

    grade: str
    words: str
    reasons: list[VerdictReason]


class BenchCheck(TypedDict):
    """Rms of corners that were not fitted, as promised, by camera; corners that were pointed at, measured and
    promised."""

    promised_px: dict[str, float]
    pointings: list[Json]
    pointing_rms_px: MaybePixel | None
    pointing_promised_px: float | None


class BenchResult(TypedDict):
    """The result of a bench calibration, as ``mastctl calibrate bench --json`` has it.

    ``rms_px``, ``check_rms_px``: of each camera's corners, fitted and not fitted; ``calibrated_px``,
    ``counts_px``: what the calibration, and the encoders' counts alone, leave of a first pointing, rms an
    axis.
    """

    verdict: VerdictAnswer
    rms_px: dict[str, MaybePixel | None]
    check_rms_px: dict[str, MaybePixel | None]
    check: BenchCheck
    calibrated_px: float | None
    counts_px: float | None
    pictures: Count
    placements: Count


class BenchProgress(TypedDict):
    """How far a bench calibration is.

    ``placements`` at which the board was seen; ``pictures`` of the camera with most; ``predicted_px``,
    ``target_px``, ``counts_px``: rms per axis of a first pointing that the calibration leaves, may leave, and
    that counts alone leave; ``expected_px``: what it leaves after a picture at ``next_rad``.
    """

    placements: Count
    pictures: Count
    predicted_px: float | None
    target_px: float | None
    counts_px: float | None
    expected_px: float | None
    next_rad: Angles | None
    cameras: dict[str, Coverage]


class BenchRunRecord(BenchProgress):
    """A bench calibration as far as it is known; ``waiting`` is for a placement.

    ``most`` pictures of a camera; ``curve``: pictures and ``predicted_px``.
    """

    name: str
    begun: str
    by: str
    board: str
    state: BenchState
    step: BenchStep
    code: str | None
    sentence: str
    simulated: bool
    by_hand: bool
    wanted_px: float
    board_m: Pair | None
    requested: RequestedPlacement | None
    most: Count
    curve: list[Pair]
    sentences: list[str]
    result: BenchResult | None
    mast_file: str | None
    report: str | None


class BenchSummary(TypedDict):
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


class BenchRuns(TypedDict):
    """The bench calibration at work or the last one, those whose folders are there, and packaged boards."""

    run: BenchRunRecord | None
    runs: list[BenchSummary]
    boards: list[str]
    folder: str
    masts_folder: str
    simulated: bool


class BenchAnswer(TypedDict):
    """A bench calibration that has begun or goes on, is answered, or has ended."""

    run: BenchRunRecord
