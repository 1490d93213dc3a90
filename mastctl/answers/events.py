"""The events of the stream: the answers of the routes, where a route gives the same."""

from __future__ import annotations

from typing import Literal, NotRequired

from typing_extensions import TypedDict

from mastctl.answers.bench import BenchRunRecord
from mastctl.answers.kinds import Count, Json, Role, Seconds
from mastctl.answers.motion import OperationTold, TrackTold
from mastctl.answers.status import FaultTold, LeaseTold, MastTold, MeasuredJoints, StandingTold


class HeadTold(MeasuredJoints):
    """A reading of the head."""

    moving: bool


class StateTold(StandingTold):
    """The daemon's state; ``track`` is the id of the active one."""

    track: str | None
    moving: bool


class FrameTold(TypedDict):
    """The facts of a camera's newest frame, without its picture."""

    frame_id: str
    camera: str
    sequence: Count
    mid_exposure_s: float
    exposure_s: float
    pan_rad: float
    tilt_rad: float
    moving: bool
    mast_digest: str
    true_pan_rad: float
    true_tilt_rad: float
    pan_approach: float
    tilt_approach: float
    settings: dict[str, float | None]
    age_s: Seconds


class CommandTold(TypedDict):
    """A command as it is recorded, or (``ended``) how the operation ended that it began."""

    number: Count
    time: str
    monotonic_s: float
    command: str
    who: str
    role: Role
    via: str
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


class _Event(TypedDict):
    """``sequence`` grows with each event; ``lost``: how many this listener was too slow to get, so far."""

    key: str
    sequence: Count
    lost: Count


class StateEvent(_Event):
    """The state changed."""

    topic: Literal["state"]
    value: StateTold


class JointsEvent(_Event):
    """The head was read."""

    topic: Literal["joints"]
    value: HeadTold


class OperationEvent(_Event):
    """An operation began, made a step, or ended; ``key`` is its id."""

    topic: Literal["operation"]
    value: OperationTold


class TrackEvent(_Event):
    """The track changed."""

    topic: Literal["track"]
    value: TrackTold


class FaultEvent(_Event):
    """All that is wrong with one device now; ``key`` is its name."""

    topic: Literal["fault"]
    value: list[FaultTold]


class FrameEvent(_Event):
    """A camera took a picture; ``key`` is its name."""

    topic: Literal["frame"]
    value: FrameTold


class MastEvent(_Event):
    """Another mast file is in use."""

    topic: Literal["mast"]
    value: MastTold


class CommandEvent(_Event):
    """A command was carried out or refused, or what it began has ended."""

    topic: Literal["command"]
    value: CommandTold


class LeaseEvent(_Event):
    """The lease changed hands, or was renewed."""

    topic: Literal["lease"]
    value: LeaseTold


class BenchEvent(_Event):
    """A bench calibration went on, asks for a placement, or has ended."""

    topic: Literal["bench"]
    value: BenchRunRecord


Event = (
    StateEvent
    | JointsEvent
    | OperationEvent
    | TrackEvent
    | FaultEvent
    | FrameEvent
    | MastEvent
    | CommandEvent
    | LeaseEvent
    | BenchEvent
)
"""One event of ``/events``, distinguished by its ``topic``."""
