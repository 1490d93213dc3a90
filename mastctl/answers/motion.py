"""Answers where the head is sent, turned or stopped: operations, previews, stops, the track; and the events
of the stream, whose values are answers of routes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NotRequired

from annotated_types import Len
from typing_extensions import TypedDict

from mastctl.answers.keeping import BenchRunRecord
from mastctl.answers.status import (
    Angles,
    Count,
    ErrorAnswer,
    EstopCause,
    FaultAnswer,
    Json,
    LeaseAnswer,
    MastAnswer,
    MaybePixel,
    MeasuredJoints,
    OperationState,
    Pixel,
    Point,
    PoseAnswer,
    Role,
    Seconds,
    StateFacts,
    TrackState,
)
from mastctl.frame_facts import FrameFacts


class Step(TypedDict):
    """One step of an operation: what it was, how it ended, when, seconds of CLOCK_MONOTONIC.

    ``detail`` has units in its names; of a failed step also ``code`` and ``message``.
    """

    name: str
    state: Literal["done", "failed"]
    started_s: float
    duration_s: float
    detail: Json


class Pointing(TypedDict):
    """One pointing, and what was measured after it in a new picture.

    The joint angles that were sent, those that the head read at the new picture's mid-exposure, and the true
    ones then by the mast file's joints. ``aim_px`` is where the target was wanted, ``predicted_px`` where its
    position, mast file and measured angles put it (null out of view), ``target_px`` where the picture shows
    it; ``residual_px`` is target less aim, with one sigma of the match. They are null where nothing was
    clicked that could be found again; ``note`` says why then. One sigma of the prediction and its (2, 2)
    covariance are of what one camera alone knows, null where a pair measured. ``motion_evidence`` says by
    camera whether the new pictures moved as the joints did, and how a later one repeated the measurement.
    """

    commanded_pan_rad: float
    commanded_tilt_rad: float
    measured_pan_rad: float
    measured_tilt_rad: float
    true_pan_rad: float
    true_tilt_rad: float
    camera: str
    frame_id: str
    aim_px: Pixel | None
    predicted_px: Pixel | None
    target_px: Pixel | None
    residual_px: MaybePixel | None
    residual_sigma_px: MaybePixel | None
    predicted_sigma_px: Pixel | None
    predicted_covariance_px2: list[Pixel] | None
    note: str
    motion_evidence: dict[str, Json]


class PointingResult(TypedDict):
    """Position in the rover frame, range from the aiming camera after the last pointing, and all pointings.

    ``range_from`` says how the range is known: ``stereo``; ``given``, ``plane``, ``parallax`` or ``unknown``
    with one camera; empty where nothing was clicked. ``range_interval_m``: with one camera, the ranges that
    are 95 % likely after the last picture; the farther is null for infinity.
    """

    position_m: Point | None
    range_m: float | None
    range_from: str
    range_interval_m: list[float | None] | None
    pointings: list[Pointing]


class OperationListed(PointingResult):
    """An operation without its steps; ``ended_because`` of a jog. Times of CLOCK_MONOTONIC."""

    id: str
    state: OperationState
    request: Json
    created_s: float
    started_s: float | None
    ended_s: float | None
    error: ErrorAnswer | None
    residual_px: MaybePixel | None
    residual_sigma_px: MaybePixel | None
    ended_because: NotRequired[str | None]


class OperationAnswer(OperationListed):
    """``GET /operations/{id}``: the same with its steps."""

    steps: list[Step]


class Operations(TypedDict):
    """``GET /operations``: the newest first."""

    operations: list[OperationListed]


class Started(TypedDict):
    """The id of the operation that was started."""

    id: str


class AimedPixel(TypedDict):
    """Where a target would come."""

    camera: str
    x_px: float
    y_px: float


class Preview(TypedDict):
    """``POST /point/preview``: what a clicked pixel shows in a fresh frame, before anything moves.

    ``other_...``, the match's figures, ``sigma_m``, ``covariance_m2`` and ``range_sigma_m`` (of the clicks,
    not of the mast file) are null where one camera points alone; ``range_interval_m`` where a pair does.
    ``goal_rad`` is null where no move leads there, ``refused`` where the head would be sent.
    """

    camera: str
    frame_id: str
    pixel_px: Pixel
    other_camera: str | None
    other_frame_id: str | None
    other_pixel_px: Pixel | None
    other_sigma_px: Pixel | None
    correlation: float | None
    second: float | None
    across_px: float | None
    position_m: Point
    sigma_m: Point | None
    covariance_m2: Annotated[list[Point], Len(3, 3)] | None
    range_m: float
    range_sigma_m: float | None
    range_from: str
    range_interval_m: list[float | None] | None
    aim: AimedPixel
    goal_rad: Angles | None
    refused: ErrorAnswer | None


class JogAnswer(TypedDict):
    """``POST /jog``: the jog's operation, whether the heartbeat was taken, and what holds an axis."""

    id: str | None
    taken: bool
    held: dict[str, str]


class StopAnswer(TypedDict):
    """``POST /stop``: the head has confirmed it; the operation that was stopped with it."""

    stopped: Literal[True]
    operation: str | None


class EstopAnswer(EstopCause):
    """``POST /estop``: confirmed. ``kept``: a restart would find it; else ``message`` says why not."""

    stopped: Literal[True]
    latched: Literal[True]
    kept: bool
    operation: str | None
    message: NotRequired[str | None]


class ResetAnswer(TypedDict):
    """``POST /reset``: the first cause of the latch that was released, and whether one came since."""

    latched: bool
    released: EstopCause


class CameraPixel(TypedDict):
    """What one camera saw of the target: a verdict of `calib.matching.patch`, or ``no_frame``."""

    frame_id: str
    verdict: str
    reason: str
    x_px: float | None
    y_px: float | None
    sigma_px: MaybePixel
    correlation: float | None


class Handover(TypedDict):
    """The target went from one pair to another, at a range of the new one."""

    from_pair: str
    to_pair: str
    range_m: float


class TrackAnswer(TypedDict):
    """``GET /track``."""

    sequence: Count
    state: TrackState
    reason: str
    id: str | None
    predicted: bool
    operation: str | None
    looks: Count
    misses: Count
    handoffs: list[Handover]
    renewals: Count
    range_m: float | None
    pair: str | None
    pixels: dict[str, CameraPixel]
    chi2: float | None
    renewed: bool
    pose_doubt: str
    position_m: Point | None
    position_in_site_m: Point | None
    covariance_m2: Annotated[list[Point], Len(3, 3)] | None
    pose: PoseAnswer | None
    age_s: Seconds


class PoseTaken(TypedDict):
    """``POST /pose``: the look that follows, if one does, and the track."""

    operation: str | None
    track: TrackAnswer


class HeadAnswer(MeasuredJoints):
    """A reading of the head."""

    moving: bool


class StateAnswer(StateFacts):
    """The daemon's state; ``track`` is the id of the active one."""

    track: str | None
    moving: bool


@dataclass(frozen=True)
class FrameAnswer(FrameFacts):
    """The facts of a camera's newest frame, without its picture."""

    age_s: Seconds


class CommandAnswer(TypedDict):
    """A command as it is recorded, or (``ended``) how the operation ended that it began."""

    number: Count
    time: str
    monotonic_s: float
    command: NotRequired[str]
    who: NotRequired[str]
    role: NotRequired[Role]
    via: NotRequired[str]
    address: NotRequired[str | None]
    request: NotRequired[Json | None]
    lease: NotRequired[str | None]
    again: NotRequired[bool]
    result: NotRequired[str | None]
    message: NotRequired[str | None]
    operation: NotRequired[str | None]
    ended: NotRequired[str | None]
    state: NotRequired[str | None]
    code: NotRequired[str | None]


class Event(TypedDict):
    """One event of ``/events``, with the newest ``value`` of its topic and key, by `EVENT_VALUES`.

    ``key``: of an operation its id, of a fault or a frame the device's name. ``sequence`` grows with each
    event; ``lost``: how many this listener was too slow to get, so far.
    """

    topic: str
    key: str
    sequence: Count
    lost: Count
    value: Any


EVENT_VALUES: Mapping[str, Any] = {
    "state": StateAnswer,
    "joints": HeadAnswer,
    "operation": OperationAnswer,
    "track": TrackAnswer,
    "fault": list[FaultAnswer],
    "frame": FrameAnswer,
    "mast": MastAnswer,
    "command": CommandAnswer,
    "lease": LeaseAnswer,
    "bench": BenchRunRecord,
}
"""What the events of each topic have as their value; of a fault, all that is wrong with the device."""
