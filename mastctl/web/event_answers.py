"""What the event stream tells, as /openapi.json describes it: by the models of the routes' answers."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, RootModel

from mastctl.commands.caller import Role
from mastctl.web.answer import Told
from mastctl.web.answers import (
    Count,
    FaultTold,
    Joints,
    Json,
    LeaseTold,
    MastTold,
    OperationTold,
    Seconds,
    StandingTold,
    TrackTold,
)
from mastctl.web.bench_answers import BenchRunTold


class HeadTold(Joints):
    """A reading of the head."""

    moving: bool


class StateTold(StandingTold):
    """What the daemon is doing; ``track`` is the id of the active one."""

    track: str | None
    moving: bool


class FrameTold(Told):
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
    age_s: Seconds


class CommandTold(Told):
    """A command as it is recorded, or (``ended``) how the operation ended that it began."""

    number: Count
    time: str
    monotonic_s: float
    command: str
    who: str
    role: Role
    via: str
    address: str | None = None
    request: Json | None = None
    lease: str | None = None
    again: bool = False
    result: str | None = None
    message: str | None = None
    operation: str | None = None
    ended: str | None = None
    state: str | None = None
    code: str | None = None


class _Event(Told):
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
    value: BenchRunTold


Kinds = (
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


class Event(RootModel[Annotated[Kinds, Field(discriminator="topic")]]):
    """One event of ``/events``."""
