"""What the API answers, as /openapi.json describes it.

The answers are made from the service's own records; these models describe them and cost nothing when one is
given. That both agree is asked of every answer that the tests get.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from mastctl.commands.caller import Role
from mastctl.motion.track import TrackState
from mastctl.state.standing import Word
from mastctl.web.answer import ErrorTold, Told

Pixel = Annotated[list[float], Field(min_length=2, max_length=2)]
Point = Annotated[list[float], Field(min_length=3, max_length=3)]
MaybePixel = Annotated[list[float | None], Field(min_length=2, max_length=2)]
"""With null for what could not be measured."""
Angles = Annotated[list[float], Field(min_length=2, max_length=2)]
Seconds = Annotated[float, Field(ge=0.0)]
Count = Annotated[int, Field(ge=0)]
Json = dict[str, Any]


class Joints(Told):
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


class BoxTold(Told):
    """Where the head must not be: [lowest, highest] of each joint, radians."""

    name: str
    pan_rad: Angles
    tilt_rad: Angles


class SoftLimits(Told):
    """[lowest, highest] of each joint, radians, the fastest speed, rad/s, and where the head must not be."""

    pan_rad: Angles
    tilt_rad: Angles
    speed_rad_per_s: float
    margin_rad: float
    acceleration_rad_per_s2: float | None
    keep_out: list[BoxTold]


class Sun(Told):
    """The direction that no head camera looks into; ``left_s``: how long that holds, null for good."""

    direction: Point
    frame: Literal["site", "rover"]
    half_angle_rad: float
    left_s: Seconds | None
    holds: bool


class LiveTold(Told):
    """``GET /health/live``."""

    live: Literal[True]


class ReadyTold(Told):
    """``GET /health/ready`` where commands are carried out: the state with its reason."""

    ready: Literal[True]
    state: Word
    reason: str


class SunTold(Told):
    """``GET /limits/sun``; null where none was told. ``boxes``: of joints, within its cone while it holds."""

    sun: Sun | None
    boxes: list[BoxTold]


class SentinelTold(Told):
    """``GET /sentinel``: what its looks say together; ``none`` without a reference.

    ``reference``, ``last_look`` and ``since`` (of a change) as ISO 8601.
    """

    level: Literal["none", "good", "unsure", "bad"]
    sentence: str
    looks: Count
    since: str | None
    last_look: str | None
    age_s: Seconds | None
    reference: str | None


class LastResidual(Told):
    """The last measured residual, with one sigma, and the operation that measured it."""

    residual_px: Pixel
    residual_sigma_px: Pixel
    operation: str


class MastTold(Told):
    """A mast file: its name on disk, the mast's, and the SHA-256 of its bytes."""

    file: str
    name: str
    digest: str


class CameraTold(Told):
    """A camera's newest frame; all null before the first."""

    frame_id: str | None
    sequence: int | None
    exposure_s: float | None
    age_s: Seconds | None


class FaultTold(Told):
    """What is wrong with a device, in plain words, for how long, and what takes it back."""

    device: str
    code: str
    message: str
    until: str
    for_s: Seconds


class PoseTold(Told):
    """Where the rover stands in the site; ``time_s`` by the sender's clock."""

    position_m: Point
    quaternion: Annotated[list[float], Field(min_length=4, max_length=4)]
    time_s: float | None
    age_s: Seconds


class TrackWord(Told):
    """The track in a word."""

    state: TrackState
    reason: str
    id: str | None


class ControlTold(Told):
    """Who steers, by a lease or by what runs; ``until`` by the wall clock, null for as long as it runs."""

    holder: str
    kind: Literal["lease", "operation"]
    for_s: Seconds | None
    until: str | None


class LeaseTold(Told):
    """``GET /lease``: who steers; null for nobody."""

    control: ControlTold | None


class LeaseGranted(Told):
    """A lease that commands carry as ``Mastctl-Lease``."""

    lease_id: str
    holder: str
    for_s: Seconds
    until: str


class EstopHeld(Told):
    """The emergency stop that is latched: why, by whom, when (ISO 8601, UTC)."""

    reason: str
    name: str
    at: str


class CalibrationTold(Told):
    """Whether residuals are as the mast file predicts; ``since`` (ISO 8601, UTC) where they are not."""

    verdict: Literal["good", "drifts", "few", "unknown"]
    sentence: str
    pointings: Count
    since: str | None


class CameraMountTold(Told):
    """A configured camera: where it looks, by its frame's axes, and how much it sees.

    ``azimuth_rad`` (to the right), ``elevation_rad`` (up) of the optical axis; ``width_rad``, ``height_rad``
    of its picture's middle row and column; of a stereo pair ``pair``, ``eye`` and the ``partner``.
    """

    on: Literal["head", "rover"]
    size_px: Annotated[list[int], Field(min_length=2, max_length=2)]
    azimuth_rad: float
    elevation_rad: float
    width_rad: float
    height_rad: float
    pair: str | None
    eye: Literal["left", "right"] | None
    partner: str | None


class RigTold(Told):
    """``GET /rig``: the configured cameras by the mast file in use, its date, its neighbours.

    ``made`` as the file's provenance says it; ``written_s``: when the file was, seconds since 1970 (UTC).
    """

    digest: str
    made: str | None
    written_s: float | None
    cameras: dict[str, CameraMountTold]
    mast_files: list[str]


class TurnedTold(Told):
    """How far a camera seems turned, by the axes of the frame that it is mounted on."""

    turn_rad: Point
    sigma_rad: Point
    log10_evidence: float


class MeasuredTold(Told):
    """A pointing that counts: where, the residual, the part that joints do not explain, its predicted sigma.

    ``time_s`` since 1970 (UTC); ``square``: of ``off_px`` over all that is expected, 2 on average.
    """

    time_s: float
    operation: str
    confirmed: bool
    mast_digest: str
    source: str
    partner: str
    camera: str
    from_rad: Angles
    to_rad: Angles
    position_m: Point
    range_m: float
    residual_px: Pixel
    off_px: Pixel
    sigma_px: Pixel
    match_sigma_px: Pixel
    count_rad: Angles
    square: float


class CalibrationHealthTold(CalibrationTold):
    """``GET /calibration/health``: the verdict, its figures, the newest pointings that count, and what the
    drift sentinel's looks say."""

    times_expected: float | None
    log10_evidence: float | None
    log10_threshold: float
    false_alarms_per_day: float
    cameras: dict[str, TurnedTold]
    not_kept: str | None
    newest: list[MeasuredTold]
    sentinel: SentinelTold | None


class StandingTold(Told):
    """What the daemon is doing: the state's word, why, for how long, and what it rests on."""

    state: Word
    reason: str
    state_for_s: Seconds
    operation: str | None
    target: Json | None
    last_residual: LastResidual | None
    estop: EstopHeld | None
    estops: list[EstopHeld]


class AxisTold(Told):
    """How an axis of the head moves; ``count_rad`` null where nobody knows."""

    count_rad: float | None
    one_sided: bool


class Status(StandingTold):
    """``GET /status``."""

    simulated: bool
    hardware: str
    moving: bool
    joints: Joints | None
    axes: dict[str, AxisTold]
    limits: SoftLimits
    pose: PoseTold | None
    track: TrackWord
    control: ControlTold | None
    stop_socket: str | None
    calibration: CalibrationTold | None
    sentinel: SentinelTold | None
    cameras: dict[str, CameraTold]
    faults: list[FaultTold]
    mast: MastTold
    former_mast: MastTold | None
    version: str
    now_s: float
    uptime_s: Seconds


class StepTold(Told):
    """One step of an operation; ``detail`` has units in its names."""

    name: str
    state: Literal["done", "failed"]
    started_s: float
    duration_s: float
    detail: Json


class PointingTold(Told):
    """One pointing, and what was measured after it in a new picture."""

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


class OperationListed(Told):
    """An operation without its steps; ``ended_because`` of a jog. Times of CLOCK_MONOTONIC."""

    id: str
    state: Literal["queued", "running", "done", "failed", "stopped"]
    request: Json
    created_s: float
    started_s: float | None
    ended_s: float | None
    error: ErrorTold | None
    residual_px: MaybePixel | None
    residual_sigma_px: MaybePixel | None
    position_m: Point | None
    range_m: float | None
    range_from: str
    range_interval_m: list[float | None] | None
    pointings: list[PointingTold]
    ended_because: str | None = None


class OperationTold(OperationListed):
    """``GET /operations/{id}``: the same with its steps."""

    steps: list[StepTold]


class Operations(Told):
    """``GET /operations``: the newest first."""

    operations: list[OperationListed]


class Started(Told):
    """What was started: the id of its operation."""

    id: str


class AimTold(Told):
    """Where a target would come."""

    camera: str
    x_px: float
    y_px: float


class RefusedTold(Told):
    """Why the head would not be sent."""

    code: str
    message: str


class PreviewTold(Told):
    """``POST /point/preview``: what a clicked pixel shows, before anything moves."""

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
    range_m: float
    range_sigma_m: float | None
    range_from: str
    range_interval_m: list[float | None] | None
    aim: AimTold
    goal_rad: Angles | None
    refused: RefusedTold | None


class StopTold(Told):
    """``POST /stop``: the head has confirmed it; the operation that was stopped with it."""

    stopped: Literal[True]
    operation: str | None


class EstopTold(EstopHeld):
    """``POST /estop``: confirmed. ``kept``: a restart would find it; else ``message`` says why not."""

    stopped: Literal[True]
    latched: Literal[True]
    kept: bool
    operation: str | None
    message: str | None = None


class ResetTold(Told):
    """``POST /reset``: the emergency stop that was released, and those that are ``left``."""

    latched: bool
    released: EstopHeld
    left: list[EstopHeld]


class HistoryEvent(Told):
    """Something that happened, and whether it is well."""

    age_s: Seconds
    kind: Literal["state", "fault", "command"]
    words: str
    well: bool


class HistoryTold(Told):
    """``GET /history``: oldest first; one number a sample, of the axes that tell their temperature °C."""

    age_s: list[Seconds]
    pan_rad: list[float]
    tilt_rad: list[float]
    temperatures_c: dict[str, list[float | None]]
    events: list[HistoryEvent]


class RecordingListed(Told):
    """A recording on the disk: a run, what a fault kept, or the ring; size in 10⁶ bytes, its files' names."""

    name: str
    kind: Literal["run", "kept", "ring"]
    size_mb: float
    files: Count
    names: list[str]


class RecorderTold(Told):
    """What is recorded now. ``dropped``: messages not written, by topic; ``fault``: what is wrong."""

    recording: bool
    ring_s: Seconds
    run: str | None
    file: str | None
    size_mb: float
    dropped: dict[str, Count]
    fault: str | None
    folder: str


class Recordings(Told):
    """``GET /recordings``; ``free_mb``: of the disk, 10⁶ bytes, null if it does not say."""

    recordings: list[RecordingListed]
    recorder: RecorderTold
    free_mb: float | None


class RecordingDeleted(Told):
    """``DELETE /recordings/{name}``: those that are left."""

    recordings: list[RecordingListed]


class RecordingEnded(Told):
    """``POST /recordings/stop``: the run, its file on the daemon's machine, what it lacks."""

    run: str
    file: str
    size_mb: float
    dropped: dict[str, Count]


class JogTold(Told):
    """``POST /jog``: the jog's operation, whether the heartbeat was taken, and what holds an axis."""

    id: str | None
    taken: bool
    held: dict[str, str]


class EyeTold(Told):
    """What one eye told of the target; pixel and sigma are null without a good verdict."""

    frame_id: str
    verdict: str
    reason: str
    x_px: float | None
    y_px: float | None
    sigma_px: MaybePixel
    correlation: float | None


class HandoffTold(Told):
    """The target went from one pair to another, at a range of the new one."""

    from_pair: str
    to_pair: str
    range_m: float


class OffsetTold(Told):
    """What hand-offs from ``source`` to ``camera`` tell by more than chance: found less predicted."""

    source: str
    camera: str
    handoffs: Count
    left_out: Count
    offset_px: Pixel
    sigma_px: Pixel
    sigmas: float
    sentence: str


class SelfCheck(Told):
    """How the mast file in use agrees with the hand-offs."""

    handoffs: Count
    offsets: list[OffsetTold]


class TrackTold(Told):
    """``GET /track``, and each event of ``GET /track/stream``."""

    sequence: Count
    state: TrackState
    reason: str
    id: str | None
    predicted: bool
    operation: str | None
    looks: Count
    misses: Count
    handoffs: list[HandoffTold]
    renewals: Count
    range_m: float | None
    pair: str | None
    pixels: dict[str, EyeTold]
    chi2: float | None
    renewed: bool
    pose_doubt: str
    position_m: Point | None
    position_in_site_m: Point | None
    covariance_m2: Annotated[list[Point], Field(min_length=3, max_length=3)] | None
    pose: PoseTold | None
    age_s: Seconds
    self_check: SelfCheck


class PoseTaken(Told):
    """``POST /pose``: the look that follows, if one does, and the track."""

    operation: str | None
    track: TrackTold


class MastsTold(Told):
    """``POST /mast``: the mast file in use, and the one before it."""

    mast: MastTold
    former_mast: MastTold | None


class ChangeTold(Told):
    """What two configurations say differently: the key, and what was and is there; null for nothing."""

    key: str
    before: Any
    after: Any


class ReloadTold(Told):
    """``POST /reload``: what changed, the mast file in use, and sentences that say what to know of it."""

    changed: list[ChangeTold]
    mast: MastTold
    notes: list[str]


class StandTold(Told):
    """Where a simulated rover truly stands."""

    position_m: Point
    quaternion: Annotated[list[float], Field(min_length=4, max_length=4)]


class BoardStands(Told):
    """A board before a simulated rover: what it is, and rover_from_board."""

    board: dict[str, Any]
    position_m: Point
    quaternion: Annotated[list[float], Field(min_length=4, max_length=4)]
    bow_m: Annotated[list[float], Field(min_length=2, max_length=2)]


class BoardsTold(Told):
    """The boards before a simulated rover, by name."""

    boards: dict[str, BoardStands]


class TimeTold(Told):
    """A simulated rover's time, seconds, and its speed, where it has one."""

    now_s: float
    speed: float | Literal["max"]


class FaultSet(Told):
    """A fault that is switched on; ``end_s`` is null for one without an end."""

    device: str
    word: str
    parameters: dict[str, float]
    begin_s: float
    end_s: float | None


class FaultsSet(Told):
    """The faults that are switched on."""

    faults: list[FaultSet]


class PlaceTold(Told):
    """A place of the head, radians as it reads them."""

    pan_rad: float
    tilt_rad: float


class PlacesTold(Told):
    """The places that are kept, by name; ``home`` is always among them."""

    places: dict[str, PlaceTold]


class ParameterTold(Told):
    """A parameter of a fault word: its usual value and its bounds; null for one without an end."""

    usual: float | None
    least: float
    most: float | None


class WordTold(Told):
    """A fault word: what it does, in one sentence, and its parameters; the unit is in the name."""

    does: str
    parameters: dict[str, ParameterTold]


class WordsTold(Told):
    """The fault words of each simulated device."""

    devices: dict[str, dict[str, WordTold]]


class TruthTold(Told):
    """Where a point of the simulated scene truly is: in the site, in the rover frame of a frame, and in it.

    ``pixel_px`` is null where the camera could not see it, all three where the pixel shows the sky.
    """

    position_in_site_m: Point | None
    position_m: Point | None
    pixel_px: Pixel | None


class SessionTold(Told):
    """``GET /session``: who asks, what it may do, and by which way it came.

    ``ends_in_s`` of a page's session; ``needs_token``: whether the daemon asks for one at all.
    """

    name: str
    role: Role
    via: str
    ends_in_s: Seconds | None
    needs_token: bool


class LoggedOut(Told):
    """``POST /logout``."""

    logged_out: Literal[True]
