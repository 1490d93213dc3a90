"""The states and kinds of numbers that answers are made of, and the form of every refusal."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired

from annotated_types import Ge, Len
from typing_extensions import TypedDict  # that of `typing` is not described before Python 3.12

Role = Literal["view", "operate", "admin"]
"""Each may do what those before it may: view only reads, operate drives the rover, admin sets it up."""
Word = Literal[
    "starting", "ready", "moving", "tracking", "holding", "stopping", "stopped", "fault", "closing"
]
"""The daemon's state."""
WELL: frozenset[Word] = frozenset({"ready", "moving", "tracking", "holding"})
"""States in which a command is carried out."""
OperationState = Literal["queued", "running", "done", "failed", "stopped"]
TrackState = Literal["idle", "starting", "tracking", "lost", "stopped"]
BenchState = Literal["running", "waiting", "done", "interrupted"]
BenchStep = Literal["begin", "place", "search", "pictures", "check", "fit", "over"]
MOST_CELLS = 48
"""Of a camera's picture, 8 in a row, 6 rows: where corners are counted."""

Pixel = Annotated[list[float], Len(2, 2)]
Point = Annotated[list[float], Len(3, 3)]
MaybePixel = Annotated[list[float | None], Len(2, 2)]
"""With null for what could not be measured."""
Angles = Annotated[list[float], Len(2, 2)]
Quaternion = Annotated[list[float], Len(4, 4)]
Seconds = Annotated[float, Ge(0.0)]
Count = Annotated[int, Ge(0)]
Json = dict[str, Any]


class ErrorTold(TypedDict):
    """Why something was refused: a word for programs, a sentence for people, more where there is more."""

    code: str
    message: str
    detail: NotRequired[Json | None]


class ErrorBody(TypedDict):
    """Every answer that is not a success."""

    error: ErrorTold
