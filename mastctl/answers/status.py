"""The present state of a daemon, and what all answers are made of: states, kinds of numbers, refusals."""

from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired

from annotated_types import Ge, Len
from typing_extensions import TypedDict  # that of `typing` is not described before Python 3.12

Role = Literal["view", "operate", "admin"]
"""Each may do what those before it may: view only reads, operate drives the rover, admin sets it up."""
ServiceState = Literal[
    "starting", "ready", "moving", "tracking", "holding", "stopping", "stopped", "fault", "closing"
]
"""The daemon's state."""
WELL: frozenset[ServiceState] = frozenset({"ready", "moving", "tracking", "holding"})
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


class ErrorAnswer(TypedDict):
    """Why something was refused: a word for programs, a sentence for people, more where there is more."""

    code: str
    message: str
    detail: NotRequired[Json | None]


class ErrorBody(TypedDict):
    """Every answer that is not a success."""

    error: ErrorAnswer


class LiveAnswer(TypedDict):
    """``GET /health/live``; ``token_folder``: where the daemon reads tokens, for callers on its machine."""

    live: Literal[True]
    token_folder: NotRequired[str]


class ReadyAnswer(TypedDict):
    """``GET /health/ready`` where commands are carried out: the state with its reason."""

    ready: Literal[True]
    state: ServiceState
    reason: str


class MeasuredJoints(TypedDict):
    """The head's joints as last measured, radians; ``measured_s`` of CLOCK_MONOTONIC.

    ``true_...`` by the mast file's ``joints``; ``..._approach``: from which side an axis came, 1 from smaller
    readings, -1 from larger, 0 not known.
    """

    pan_rad: float
    tilt_rad: float
    true_pan_rad: float
    true_tilt_rad: float
    pan_approach: float
    tilt_approach: float
    measured_s: float
    age_s: Seconds


class AxisAnswer(TypedDict):
    """How an axis of the head moves; ``count_rad`` null where unknown."""

    count_rad: float | None
    one_sided: bool


class BoxAnswer(TypedDict):
    """Where the head must not be: [lowest, highest] of each joint, radians."""

    name: str
    pan_rad: Angles
    tilt_rad: Angles


class SoftLimits(TypedDict):
    """[lowest, highest] of each joint, radians, the fastest speed, rad/s, and where the head must not be."""

    pan_rad: Angles
    tilt_rad: Angles
    speed_rad_per_s: float
    margin_rad: float
    acceleration_rad_per_s2: float | None
    keep_out: list[BoxAnswer]


class Sun(TypedDict):
    """The direction that no head camera looks into; ``left_s``: how long that holds, null for good."""

    direction: Point
    frame: Literal["site", "rover"]
    half_angle_rad: float
    left_s: Seconds | None
    active: bool


class SunAnswer(TypedDict):
    """``GET /limits/sun``; null where none was stated. ``boxes``: joint angles within its cone."""

    sun: Sun | None
    boxes: list[BoxAnswer]


class CameraAnswer(TypedDict):
    """A camera's newest frame; all null before the first."""

    frame_id: str | None
    sequence: int | None
    exposure_s: float | None
    age_s: Seconds | None


class CameraSettingAnswer(TypedDict):
    """A setting of a camera; ``step`` 0: any value between the bounds; ``refusal``: why it cannot change."""

    name: str
    value: float | None
    minimum: float
    maximum: float
    step: float
    unit: str
    automatic: bool
    refusal: str | None


class SensorModeAnswer(TypedDict):
    """Which pixels of its sensor a camera's pictures show; ``crop_px`` is x, y, width, height."""

    size_px: Annotated[list[Count], Len(2, 2)]
    sensor_px: Annotated[list[Count], Len(2, 2)] | None
    crop_px: Annotated[list[Count], Len(4, 4)] | None
    flip: Literal["none", "horizontal", "vertical", "both"]


class CameraSettingsAnswer(TypedDict):
    """The settings of a camera; ``fixed``: an operation keeps them as they are; ``sensor_mode`` as it was
    opened; ``notes``: a sentence for each setting that became another than requested."""

    camera: str
    settings: list[CameraSettingAnswer]
    fixed: bool
    sensor_mode: SensorModeAnswer | None
    notes: list[str]


class FaultAnswer(TypedDict):
    """A fault of a device in plain words, since when, and the event that ends it."""

    device: str
    code: str
    message: str
    until: str
    for_s: Seconds


class PoseAnswer(TypedDict):
    """Where the rover stands in the site; ``time_s`` by the sender's clock."""

    position_m: Point
    quaternion: Quaternion
    time_s: float | None
    age_s: Seconds


class TrackBrief(TypedDict):
    """The track in a word."""

    state: TrackState
    reason: str
    id: str | None


class MastAnswer(TypedDict):
    """A mast file: its name on disk, the mast's, and the SHA-256 of its bytes."""

    file: str
    name: str
    digest: str


class SentinelAnswer(TypedDict):
    """``GET /sentinel``: what its looks say together; ``none`` without a reference. Times as ISO 8601."""

    level: Literal["none", "good", "unsure", "bad"]
    sentence: str
    looks: Count
    since: str | None
    last_look: str | None
    age_s: Seconds | None
    reference: str | None


class CalibrationAnswer(TypedDict):
    """Whether the mast file is still valid, by all evidence; ``since`` (ISO 8601) where it is not."""

    verdict: Literal["good", "drifts", "few", "unknown"]
    sentence: str
    pointings: Count
    since: str | None


class LastResidual(TypedDict):
    """The last measured residual, with one sigma, and the operation that measured it."""

    residual_px: Pixel
    residual_sigma_px: Pixel
    operation: str


class ControlAnswer(TypedDict):
    """The client that steers, by a lease or an operation; ``until`` by the wall clock, null while it runs."""

    holder: str
    kind: Literal["lease", "operation"]
    for_s: Seconds | None
    until: str | None


class LeaseAnswer(TypedDict):
    """``GET /lease``: the client that steers, or null."""

    control: ControlAnswer | None


class LeaseRuns(TypedDict):
    """How long a lease runs on, and when it ends by the wall clock."""

    holder: str
    for_s: Seconds
    until: str


class LeaseGranted(LeaseRuns):
    """A lease that commands carry as ``Mastctl-Lease``."""

    lease_id: str


class EstopCause(TypedDict):
    """The emergency stop that is latched: why, by whom, when (ISO 8601, UTC)."""

    reason: str
    name: str
    at: str


class StateFacts(TypedDict):
    """The daemon's state: its word, the reason, since when, and the facts it rests on."""

    state: ServiceState
    reason: str
    state_for_s: Seconds
    operation: str | None
    target: Json | None
    last_residual: LastResidual | None
    estop: EstopCause | None
    estops: list[EstopCause]


class Status(StateFacts):
    """``GET /status``."""

    simulated: bool
    hardware: str
    moving: bool
    joints: MeasuredJoints | None
    axes: dict[str, AxisAnswer]
    limits: SoftLimits
    pose: PoseAnswer | None
    track: TrackBrief
    control: ControlAnswer | None
    stop_socket: str | None
    calibration: CalibrationAnswer
    sentinel: SentinelAnswer
    cameras: dict[str, CameraAnswer]
    faults: list[FaultAnswer]
    mast: MastAnswer
    former_mast: MastAnswer | None
    version: str
    now_s: float
    uptime_s: Seconds
