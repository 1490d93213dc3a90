"""What a run tells a program that follows it: one JSON object a line, each of one of these kinds.

Whoever tells makes these records, and whoever hears reads a line as one of them or not at all. Numbers that
are not finite are told as null; what a line may hold is bounded, since another process writes it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, TypeAdapter
from pydantic.dataclasses import dataclass

from mastctl.answers import MOST_CELLS
from mastctl.errors import one_line

Step = Literal["search", "pictures", "fit", "check"]
"""What a run does beside asking for placements."""

CELLS = (8, MOST_CELLS // 8)
"""Columns and rows into which a picture is divided to tell where corners were seen."""

LONGEST_SENTENCE = 400

_STRICT = ConfigDict(strict=True)

Words = Annotated[str, AfterValidator(lambda words: one_line(words, LONGEST_SENTENCE))]
Number = Annotated[float, Field(allow_inf_nan=False)]
Maybe = Annotated[
    float | None, BeforeValidator(lambda x: None if isinstance(x, float) and not math.isfinite(x) else x)
]
"""A number, or null where there is none."""

Count = Annotated[int, Field(ge=0, lt=1 << 40)]
Pair = tuple[Number, Number]


@dataclass(frozen=True, config=_STRICT)
class BenchBegins:
    """The run begins: the board's width and height, cameras with their pictures' sizes, the folder of what is
    seen, and whether the rover is simulated."""

    board_m: Pair
    cameras: dict[Words, tuple[Count, Count]]
    folder: str
    simulated: bool
    event: Literal["begun"] = "begun"


@dataclass(frozen=True, config=_STRICT)
class BenchSays:
    """A sentence for the person."""

    sentence: Words
    event: Literal["said"] = "said"


@dataclass(frozen=True, config=_STRICT)
class BenchSteps:
    """What is done from now on."""

    step: Step
    event: Literal["step"] = "step"


@dataclass(frozen=True, config=_STRICT)
class PlacementLine:
    """Where a board is asked for.

    Attributes
    ----------
    name
        Of the placement.
    range_m, bearing_deg, height_deg, turned_deg
        As of `calib.plan.placements.Placement`.
    description
        The same for a person.
    needs_confirmation
        Whether an operator has to confirm that it stands.
    """

    name: Words
    range_m: Number
    bearing_deg: Number
    height_deg: Number
    turned_deg: Pair
    description: Words
    needs_confirmation: bool


@dataclass(frozen=True, config=_STRICT)
class BenchAsks(PlacementLine):
    """A placement is asked for."""

    event: Literal["place"] = "place"

    @property
    def asked(self) -> PlacementLine:
        """The placement alone."""
        return PlacementLine(**{field.name: getattr(self, field.name) for field in fields(PlacementLine)})


@dataclass(frozen=True, config=_STRICT)
class BenchStands:
    """The board of a placement stands."""

    name: Words
    event: Literal["stands"] = "stands"


@dataclass(frozen=True, config=_STRICT)
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
    next_rad
        The next attitude, pan and tilt.
    expected_px
        What is predicted after it.
    cells
        Of each camera how many corners were seen in each of its picture's `CELLS`, row by row.
    """

    placement: Words
    pictures: Count
    most: Count
    predicted_px: Maybe
    target_px: Maybe
    counts_px: Maybe
    next_rad: Pair
    expected_px: Maybe
    cells: dict[str, Annotated[tuple[Count, ...], Field(min_length=MOST_CELLS, max_length=MOST_CELLS)]]
    event: Literal["progress"] = "progress"

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


@dataclass(frozen=True, config=_STRICT)
class ReasonLine:
    """One test's outcome."""

    grade: Words
    sentence: Words


@dataclass(frozen=True, config=_STRICT)
class VerdictLine:
    """Whether to trust it, and why."""

    grade: Words
    words: Words
    reasons: tuple[ReasonLine, ...]


@dataclass(frozen=True, config=_STRICT)
class CheckLine:
    """What the end of a bench showed, as far as a program shows it."""

    promised_px: dict[str, Maybe] = Field(default_factory=dict)
    pointings: tuple[Any, ...] = ()
    pointing_rms_px: Pair | None = None
    pointing_promised_px: Maybe = None


@dataclass(frozen=True, config=_STRICT)
class ResultLine:
    """Of what the command tells with ``--json``, what a program shows."""

    verdict: VerdictLine
    rms_px: dict[Words, Pair | None]
    check_rms_px: dict[str, Pair | None]
    calibrated_px: Maybe
    counts_px: Maybe
    pictures: Count
    placements: Count
    rover_seconds: Maybe
    gauges: tuple[Words, ...]
    notes: tuple[Words, ...]
    check: CheckLine | None = None


@dataclass(frozen=True, config=_STRICT)
class BenchEnds:
    """It is over, and this came of it."""

    result: ResultLine
    event: Literal["done"] = "done"


@dataclass(frozen=True, config=_STRICT)
class BenchFails:
    """It is over, and nothing came of it."""

    code: Words
    message: Words
    event: Literal["failed"] = "failed"


BenchLine = (
    BenchBegins | BenchSays | BenchSteps | BenchAsks | BenchStands | BenchProgress | BenchEnds | BenchFails
)
LINES: TypeAdapter[BenchLine] = TypeAdapter(Annotated[BenchLine, Field(discriminator="event")])


def px(value: float | None) -> str:
    """Return pixels as a person reads them."""
    if value is None or not math.isfinite(value):
        return "? px"
    return f"{value:.2f} px" if value < 10 else f"{value:.0f} px"
