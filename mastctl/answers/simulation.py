"""Answers about a simulated rover: where it truly stands, boards before it, its time, its faults."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from annotated_types import Len
from typing_extensions import TypedDict

from mastctl.answers.kinds import Pixel, Point, Quaternion


class TruePose(TypedDict):
    """Where a simulated rover truly stands."""

    position_m: Point
    quaternion: Quaternion


class BoardPose(TypedDict):
    """A board before a simulated rover: what it is, and rover_from_board."""

    board: dict[str, Any]
    position_m: Point
    quaternion: Quaternion
    bow_m: Annotated[list[float], Len(2, 2)]


class BoardList(TypedDict):
    """The boards before a simulated rover, by name."""

    boards: dict[str, BoardPose]


class SimulationTime(TypedDict):
    """A simulated rover's time, seconds, and its speed, where it has one."""

    now_s: float
    speed: float | Literal["max"]


class FaultSet(TypedDict):
    """A fault that is switched on; ``end_s`` is null for one without an end."""

    device: str
    word: str
    parameters: dict[str, float]
    begin_s: float
    end_s: float | None


class FaultsSet(TypedDict):
    """The faults that are switched on."""

    faults: list[FaultSet]


class FaultParameter(TypedDict):
    """A parameter of a fault word: its default and its bounds; null for one without an end."""

    default: float | None
    least: float
    most: float | None


class FaultWord(TypedDict):
    """A fault word: its effect, in one sentence, and its parameters; the unit is in the name."""

    effect: str
    parameters: dict[str, FaultParameter]


class FaultWordList(TypedDict):
    """The fault words of each simulated device."""

    devices: dict[str, dict[str, FaultWord]]


class PointTruth(TypedDict):
    """Where a point of the simulated scene truly is: in the site, in the rover frame of a frame, and in it.

    ``pixel_px`` is null where the camera could not see it, all three where the pixel shows the sky.
    """

    position_in_site_m: Point | None
    position_m: Point | None
    pixel_px: Pixel | None
