# Made by tools/client_answers.py; what is to be changed is changed in mastctl/web/answers.py.
"""What a daemon answers, as a type checker reads it; made from what /openapi.json says."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict


class AimTold(TypedDict):
    """Where a target would come."""

    camera: str
    x_px: float
    y_px: float


class AxisTold(TypedDict):
    """How an axis of the head moves; ``count_rad`` null where nobody knows."""

    count_rad: float | None
    one_sided: bool


class BenchBegun(TypedDict):
    """A bench calibration that has begun or goes on, is answered, or has ended."""

    run: BenchRunTold


class BenchEvent(TypedDict):
    """A bench calibration went on, asks for a placement, or has ended."""

    key: str
    sequence: int
    lost: int
    topic: Literal["bench"]
    value: BenchRunTold


class BenchListed(TypedDict):
    """A bench calibration whose folder is there; ``size_mb``: of its pictures."""

    name: str
    begun: str
    by: str
    board: str
    state: Literal["running", "done", "interrupted", "damaged"]
    sentence: str
    pictures: int
    size_mb: float
    grade: str | None
    mast_file: str | None
    report: str | None


class BenchResult(TypedDict):
    """What came of a bench calibration.

    ``pointing_...``: corners that were pointed at, measured and promised; ``calibrated_px``, ``counts_px``:
    what the calibration, and the encoders' counts alone, leave of a first pointing, rms an axis.
    """

    verdict: VerdictTold
    cameras: list[ResidualTold]
    pointing_rms_px: list[float] | None
    pointing_promised_px: float | None
    pointings: int
    calibrated_px: float | None
    counts_px: float | None
    pictures: int
    placements: int
    rover_s: float | None
    notes: list[str]


class BenchRunTold(TypedDict):
    """A bench calibration as far as it is known; ``asking`` waits for a placement."""

    name: str
    begun: str
    by: str
    state: Literal["running", "asking", "done", "interrupted"]
    step: Literal["begin", "place", "search", "pictures", "check", "fit", "over"]
    code: str | None
    sentence: str
    simulated: bool | None
    by_hand: bool
    wanted_px: float
    board_m: list[float] | None
    asked: PlacementAsked | None
    placements: int
    pictures: int
    most: int
    predicted_px: float | None
    target_px: float | None
    floor_px: float | None
    expected_px: float | None
    next_rad: list[float] | None
    cameras: dict[str, CoverageTold]
    curve: list[list[float]]
    sentences: list[str]
    odd: int
    result: BenchResult | None
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


class BoardStands(TypedDict):
    """A board before a simulated rover: what it is, and rover_from_board."""

    board: dict[str, Any]
    position_m: list[float]
    quaternion: list[float]
    bow_m: list[float]


class BoardsTold(TypedDict):
    """The boards before a simulated rover, by name."""

    boards: dict[str, BoardStands]


class BoxTold(TypedDict):
    """Where the head must not be: [lowest, highest] of each joint, radians."""

    name: str
    pan_rad: list[float]
    tilt_rad: list[float]


class CalibrationHealthTold(TypedDict):
    """``GET /calibration/health``: the verdict, its figures, the newest pointings that count, and what the
    drift sentinel's looks say.
    """

    verdict: Literal["good", "drifts", "few", "unknown"]
    sentence: str
    pointings: int
    since: str | None
    times_expected: float | None
    log10_evidence: float | None
    log10_threshold: float
    false_alarms_per_day: float
    cameras: dict[str, TurnedTold]
    not_kept: str | None
    newest: list[MeasuredTold]
    sentinel: SentinelTold | None


class CalibrationTold(TypedDict):
    """Whether residuals are as the mast file predicts; ``since`` (ISO 8601, UTC) where they are not."""

    verdict: Literal["good", "drifts", "few", "unknown"]
    sentence: str
    pointings: int
    since: str | None


class CameraMountTold(TypedDict):
    """A configured camera: where it looks, by its frame's axes, and how much it sees.

    ``azimuth_rad`` (to the right), ``elevation_rad`` (up) of the optical axis; ``width_rad``, ``height_rad``
    of its picture's middle row and column; of a stereo pair ``pair``, ``eye`` and the ``partner``.
    """

    on: Literal["head", "rover"]
    size_px: list[int]
    azimuth_rad: float
    elevation_rad: float
    width_rad: float
    height_rad: float
    pair: str | None
    eye: Literal["left", "right"] | None
    partner: str | None


class CameraTold(TypedDict):
    """A camera's newest frame; all null before the first."""

    frame_id: str | None
    sequence: int | None
    exposure_s: float | None
    age_s: float | None


class ChangeTold(TypedDict):
    """What two configurations say differently: the key, and what was and is there; null for nothing."""

    key: str
    before: Any
    after: Any


class CommandEvent(TypedDict):
    """A command was carried out or refused, or what it began has ended."""

    key: str
    sequence: int
    lost: int
    topic: Literal["command"]
    value: CommandTold


class CommandTold(TypedDict):
    """A command as it is recorded, or (``ended``) how the operation ended that it began."""

    number: int
    time: str
    monotonic_s: float
    command: str
    who: str
    role: Literal["view", "operate", "admin"]
    via: str
    address: NotRequired[str | None]
    request: NotRequired[dict[str, Any] | None]
    lease: NotRequired[str | None]
    again: NotRequired[bool]
    result: NotRequired[str | None]
    message: NotRequired[str | None]
    operation: NotRequired[str | None]
    ended: NotRequired[str | None]
    state: NotRequired[str | None]
    code: NotRequired[str | None]


class ControlTold(TypedDict):
    """Who steers, by a lease or by what runs; ``until`` by the wall clock, null for as long as it runs."""

    holder: str
    kind: Literal["lease", "operation"]
    for_s: float | None
    until: str | None


class CoverageTold(TypedDict):
    """How many corners were seen in each cell of a camera's picture, 8 in a row, 6 rows."""

    size_px: list[int]
    cells: list[int]


class ErrorTold(TypedDict):
    """Why something was refused: a word for programs, a sentence for people, more where there is more."""

    code: str
    message: str
    detail: NotRequired[dict[str, Any] | None]


class EstopHeld(TypedDict):
    """The emergency stop that is latched: why, by whom, when (ISO 8601, UTC)."""

    reason: str
    name: str
    at: str


class EstopTold(TypedDict):
    """``POST /estop``: confirmed. ``kept``: a restart would find it; else ``message`` says why not."""

    reason: str
    name: str
    at: str
    stopped: Literal[True]
    latched: Literal[True]
    kept: bool
    operation: str | None
    message: NotRequired[str | None]


class EyeTold(TypedDict):
    """What one eye told of the target; pixel and sigma are null without a good verdict."""

    frame_id: str
    verdict: str
    reason: str
    x_px: float | None
    y_px: float | None
    sigma_px: list[float | None]
    correlation: float | None


class FaultEvent(TypedDict):
    """All that is wrong with one device now; ``key`` is its name."""

    key: str
    sequence: int
    lost: int
    topic: Literal["fault"]
    value: list[FaultTold]


class FaultSet(TypedDict):
    """A fault that is switched on; ``end_s`` is null for one without an end."""

    device: str
    word: str
    parameters: dict[str, float]
    begin_s: float
    end_s: float | None


class FaultTold(TypedDict):
    """What is wrong with a device, in plain words, for how long, and what takes it back."""

    device: str
    code: str
    message: str
    until: str
    for_s: float


class FaultsSet(TypedDict):
    """The faults that are switched on."""

    faults: list[FaultSet]


class FrameEvent(TypedDict):
    """A camera took a picture; ``key`` is its name."""

    key: str
    sequence: int
    lost: int
    topic: Literal["frame"]
    value: FrameTold


class FrameTold(TypedDict):
    """The facts of a camera's newest frame, without its picture."""

    frame_id: str
    camera: str
    sequence: int
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
    age_s: float


class HandoffTold(TypedDict):
    """The target went from one pair to another, at a range of the new one."""

    from_pair: str
    to_pair: str
    range_m: float


class HeadTold(TypedDict):
    """A reading of the head."""

    pan_rad: float
    tilt_rad: float
    true_pan_rad: float
    true_tilt_rad: float
    pan_approach: float
    tilt_approach: float
    measured_s: float
    age_s: float
    moving: bool


class HistoryEvent(TypedDict):
    """Something that happened, and whether it is well."""

    age_s: float
    kind: Literal["state", "fault", "command"]
    words: str
    well: bool


class HistoryTold(TypedDict):
    """``GET /history``: oldest first; one number a sample, of the axes that tell their temperature °C."""

    age_s: list[float]
    pan_rad: list[float]
    tilt_rad: list[float]
    temperatures_c: dict[str, list[float | None]]
    events: list[HistoryEvent]


class JogTold(TypedDict):
    """``POST /jog``: the jog's operation, whether the heartbeat was taken, and what holds an axis."""

    id: str | None
    taken: bool
    held: dict[str, str]


class Joints(TypedDict):
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
    age_s: float


class JointsEvent(TypedDict):
    """The head was read."""

    key: str
    sequence: int
    lost: int
    topic: Literal["joints"]
    value: HeadTold


class LastResidual(TypedDict):
    """The last measured residual, with one sigma, and the operation that measured it."""

    residual_px: list[float]
    residual_sigma_px: list[float]
    operation: str


class LeaseEvent(TypedDict):
    """The lease changed hands, or was renewed."""

    key: str
    sequence: int
    lost: int
    topic: Literal["lease"]
    value: LeaseTold


class LeaseGranted(TypedDict):
    """A lease that commands carry as ``Mastctl-Lease``."""

    lease_id: str
    holder: str
    for_s: float
    until: str


class LeaseTold(TypedDict):
    """``GET /lease``: who steers; null for nobody."""

    control: ControlTold | None


class LiveTold(TypedDict):
    """``GET /health/live``."""

    live: Literal[True]


class LoggedOut(TypedDict):
    """``POST /logout``."""

    logged_out: Literal[True]


class MastEvent(TypedDict):
    """Another mast file is in use."""

    key: str
    sequence: int
    lost: int
    topic: Literal["mast"]
    value: MastTold


class MastTold(TypedDict):
    """A mast file: its name on disk, the mast's, and the SHA-256 of its bytes."""

    file: str
    name: str
    digest: str


class MastsTold(TypedDict):
    """``POST /mast``: the mast file in use, and the one before it."""

    mast: MastTold
    former_mast: MastTold | None


class MeasuredTold(TypedDict):
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
    from_rad: list[float]
    to_rad: list[float]
    position_m: list[float]
    range_m: float
    residual_px: list[float]
    off_px: list[float]
    sigma_px: list[float]
    match_sigma_px: list[float]
    count_rad: list[float]
    square: float


class OffsetTold(TypedDict):
    """What hand-offs from ``source`` to ``camera`` tell by more than chance: found less predicted."""

    source: str
    camera: str
    handoffs: int
    left_out: int
    offset_px: list[float]
    sigma_px: list[float]
    sigmas: float
    sentence: str


class OperationEvent(TypedDict):
    """An operation began, made a step, or ended; ``key`` is its id."""

    key: str
    sequence: int
    lost: int
    topic: Literal["operation"]
    value: OperationTold


class OperationListed(TypedDict):
    """An operation without its steps; ``ended_because`` of a jog. Times of CLOCK_MONOTONIC."""

    id: str
    state: Literal["queued", "running", "done", "failed", "stopped"]
    request: dict[str, Any]
    created_s: float
    started_s: float | None
    ended_s: float | None
    error: ErrorTold | None
    residual_px: list[float | None] | None
    residual_sigma_px: list[float | None] | None
    position_m: list[float] | None
    range_m: float | None
    range_from: str
    range_interval_m: list[float | None] | None
    pointings: list[PointingTold]
    ended_because: NotRequired[str | None]


class OperationTold(TypedDict):
    """``GET /operations/{id}``: the same with its steps."""

    id: str
    state: Literal["queued", "running", "done", "failed", "stopped"]
    request: dict[str, Any]
    created_s: float
    started_s: float | None
    ended_s: float | None
    error: ErrorTold | None
    residual_px: list[float | None] | None
    residual_sigma_px: list[float | None] | None
    position_m: list[float] | None
    range_m: float | None
    range_from: str
    range_interval_m: list[float | None] | None
    pointings: list[PointingTold]
    ended_because: NotRequired[str | None]
    steps: list[StepTold]


class Operations(TypedDict):
    """``GET /operations``: the newest first."""

    operations: list[OperationListed]


class ParameterTold(TypedDict):
    """A parameter of a fault word: its usual value and its bounds; null for one without an end."""

    usual: float | None
    least: float
    most: float | None


class PlaceTold(TypedDict):
    """A place of the head, radians as it reads them."""

    pan_rad: float
    tilt_rad: float


class PlacementAsked(TypedDict):
    """Where a board is asked for, from the head's axes; ``waits``: until somebody says that it stands.

    ``bearing_deg`` to the right of pan zero, ``height_deg`` above the axes, ``turned_deg``: its face, to the
    head's right and upwards.
    """

    name: str
    range_m: float
    bearing_deg: float
    height_deg: float
    turned_deg: list[float]
    words: str
    waits: bool


class PlacesTold(TypedDict):
    """The places that are kept, by name; ``home`` is always among them."""

    places: dict[str, PlaceTold]


class PointingTold(TypedDict):
    """One pointing, and what was measured after it in a new picture."""

    commanded_pan_rad: float
    commanded_tilt_rad: float
    measured_pan_rad: float
    measured_tilt_rad: float
    true_pan_rad: float
    true_tilt_rad: float
    camera: str
    frame_id: str
    aim_px: list[float] | None
    predicted_px: list[float] | None
    target_px: list[float] | None
    residual_px: list[float | None] | None
    residual_sigma_px: list[float | None] | None
    predicted_sigma_px: list[float] | None
    predicted_covariance_px2: list[list[float]] | None
    note: str
    motion_evidence: dict[str, dict[str, Any]]


class PoseTaken(TypedDict):
    """``POST /pose``: the look that follows, if one does, and the track."""

    operation: str | None
    track: TrackTold


class PoseTold(TypedDict):
    """Where the rover stands in the site; ``time_s`` by the sender's clock."""

    position_m: list[float]
    quaternion: list[float]
    time_s: float | None
    age_s: float


class PreviewTold(TypedDict):
    """``POST /point/preview``: what a clicked pixel shows, before anything moves."""

    camera: str
    frame_id: str
    pixel_px: list[float]
    other_camera: str | None
    other_frame_id: str | None
    other_pixel_px: list[float] | None
    other_sigma_px: list[float] | None
    correlation: float | None
    second: float | None
    across_px: float | None
    position_m: list[float]
    sigma_m: list[float] | None
    range_m: float
    range_sigma_m: float | None
    range_from: str
    range_interval_m: list[float | None] | None
    aim: AimTold
    goal_rad: list[float] | None
    refused: RefusedTold | None


class ReadyTold(TypedDict):
    """``GET /health/ready`` where commands are carried out: the state with its reason."""

    ready: Literal[True]
    state: Literal[
        "starting", "ready", "moving", "tracking", "holding", "stopping", "stopped", "fault", "closing"
    ]
    reason: str


class ReasonTold(TypedDict):
    """One reason of a verdict."""

    grade: str
    sentence: str


class RecorderTold(TypedDict):
    """What is recorded now. ``dropped``: messages not written, by topic; ``fault``: what is wrong."""

    recording: bool
    ring_s: float
    run: str | None
    file: str | None
    size_mb: float
    dropped: dict[str, int]
    fault: str | None
    folder: str


class RecordingDeleted(TypedDict):
    """``DELETE /recordings/{name}``: those that are left."""

    recordings: list[RecordingListed]


class RecordingEnded(TypedDict):
    """``POST /recordings/stop``: the run, its file on the daemon's machine, what it lacks."""

    run: str
    file: str
    size_mb: float
    dropped: dict[str, int]


class RecordingListed(TypedDict):
    """A recording on the disk: a run, what a fault kept, or the ring; size in 10⁶ bytes, its files' names."""

    name: str
    kind: Literal["run", "kept", "ring"]
    size_mb: float
    files: int
    names: list[str]


class Recordings(TypedDict):
    """``GET /recordings``; ``free_mb``: of the disk, 10⁶ bytes, null if it does not say."""

    recordings: list[RecordingListed]
    recorder: RecorderTold
    free_mb: float | None


class RefusedTold(TypedDict):
    """Why the head would not be sent."""

    code: str
    message: str


class ReloadTold(TypedDict):
    """``POST /reload``: what changed, the mast file in use, and sentences that say what to know of it."""

    changed: list[ChangeTold]
    mast: MastTold
    notes: list[str]


class ReportListed(TypedDict):
    """A report that can be read."""

    name: str
    title: str
    written: str


class ReportsTold(TypedDict):
    """The reports, the newest first, and the folder where others may be put."""

    reports: list[ReportListed]
    folder: str


class ResetTold(TypedDict):
    """``POST /reset``: the emergency stop that was released, and those that are ``left``."""

    latched: bool
    released: EstopHeld
    left: list[EstopHeld]


class ResidualTold(TypedDict):
    """Rms of a camera's corners: fitted, not fitted, and what was promised of those that were not."""

    camera: str
    rms_px: list[float] | None
    check_rms_px: list[float | None] | None
    promised_px: float | None


class RigTold(TypedDict):
    """``GET /rig``: the configured cameras by the mast file in use, its date, its neighbours.

    ``made`` as the file's provenance says it; ``written_s``: when the file was, seconds since 1970 (UTC).
    """

    digest: str
    made: str | None
    written_s: float | None
    cameras: dict[str, CameraMountTold]
    mast_files: list[str]


class SelfCheck(TypedDict):
    """How the mast file in use agrees with the hand-offs."""

    handoffs: int
    offsets: list[OffsetTold]


class SentinelTold(TypedDict):
    """``GET /sentinel``: what its looks say together; ``none`` without a reference.

    ``reference``, ``last_look`` and ``since`` (of a change) as ISO 8601.
    """

    level: Literal["none", "good", "unsure", "bad"]
    sentence: str
    looks: int
    since: str | None
    last_look: str | None
    age_s: float | None
    reference: str | None


class SessionTold(TypedDict):
    """``GET /session``: who asks, what it may do, and by which way it came.

    ``ends_in_s`` of a page's session; ``needs_token``: whether the daemon asks for one at all.
    """

    name: str
    role: Literal["view", "operate", "admin"]
    via: str
    ends_in_s: float | None
    needs_token: bool


class SoftLimits(TypedDict):
    """[lowest, highest] of each joint, radians, the fastest speed, rad/s, and where the head must not be."""

    pan_rad: list[float]
    tilt_rad: list[float]
    speed_rad_per_s: float
    margin_rad: float
    acceleration_rad_per_s2: float | None
    keep_out: list[BoxTold]


class StandTold(TypedDict):
    """Where a simulated rover truly stands."""

    position_m: list[float]
    quaternion: list[float]


class Started(TypedDict):
    """What was started: the id of its operation."""

    id: str


class StateEvent(TypedDict):
    """The state changed."""

    key: str
    sequence: int
    lost: int
    topic: Literal["state"]
    value: StateTold


class StateTold(TypedDict):
    """What the daemon is doing; ``track`` is the id of the active one."""

    state: Literal[
        "starting", "ready", "moving", "tracking", "holding", "stopping", "stopped", "fault", "closing"
    ]
    reason: str
    state_for_s: float
    operation: str | None
    target: dict[str, Any] | None
    last_residual: LastResidual | None
    estop: EstopHeld | None
    estops: list[EstopHeld]
    track: str | None
    moving: bool


class Status(TypedDict):
    """``GET /status``."""

    state: Literal[
        "starting", "ready", "moving", "tracking", "holding", "stopping", "stopped", "fault", "closing"
    ]
    reason: str
    state_for_s: float
    operation: str | None
    target: dict[str, Any] | None
    last_residual: LastResidual | None
    estop: EstopHeld | None
    estops: list[EstopHeld]
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
    uptime_s: float


class StepTold(TypedDict):
    """One step of an operation; ``detail`` has units in its names."""

    name: str
    state: Literal["done", "failed"]
    started_s: float
    duration_s: float
    detail: dict[str, Any]


class StopTold(TypedDict):
    """``POST /stop``: the head has confirmed it; the operation that was stopped with it."""

    stopped: Literal[True]
    operation: str | None


class Sun(TypedDict):
    """The direction that no head camera looks into; ``left_s``: how long that holds, null for good."""

    direction: list[float]
    frame: Literal["site", "rover"]
    half_angle_rad: float
    left_s: float | None
    holds: bool


class SunTold(TypedDict):
    """``GET /limits/sun``; null where none was told. ``boxes``: of joints, within its cone while it holds."""

    sun: Sun | None
    boxes: list[BoxTold]


class TimeTold(TypedDict):
    """A simulated rover's time, seconds, and its speed, where it has one."""

    now_s: float
    speed: float | Literal["max"]


class TrackEvent(TypedDict):
    """The track changed."""

    key: str
    sequence: int
    lost: int
    topic: Literal["track"]
    value: TrackTold


class TrackTold(TypedDict):
    """``GET /track``, and each event of ``GET /track/stream``."""

    sequence: int
    state: Literal["idle", "starting", "tracking", "lost", "stopped"]
    reason: str
    id: str | None
    predicted: bool
    operation: str | None
    looks: int
    misses: int
    handoffs: list[HandoffTold]
    renewals: int
    range_m: float | None
    pair: str | None
    pixels: dict[str, EyeTold]
    chi2: float | None
    renewed: bool
    pose_doubt: str
    position_m: list[float] | None
    position_in_site_m: list[float] | None
    covariance_m2: list[list[float]] | None
    pose: PoseTold | None
    age_s: float
    self_check: SelfCheck


class TrackWord(TypedDict):
    """The track in a word."""

    state: Literal["idle", "starting", "tracking", "lost", "stopped"]
    reason: str
    id: str | None


class TruthTold(TypedDict):
    """Where a point of the simulated scene truly is: in the site, in the rover frame of a frame, and in it.

    ``pixel_px`` is null where the camera could not see it, all three where the pixel shows the sky.
    """

    position_in_site_m: list[float] | None
    position_m: list[float] | None
    pixel_px: list[float] | None


class TurnedTold(TypedDict):
    """How far a camera seems turned, by the axes of the frame that it is mounted on."""

    turn_rad: list[float]
    sigma_rad: list[float]
    log10_evidence: float


class VerdictTold(TypedDict):
    """Whether to trust a calibration: ``good``, ``care``, ``bad``, and why."""

    grade: str
    words: str
    reasons: list[ReasonTold]


class WordTold(TypedDict):
    """A fault word: what it does, in one sentence, and its parameters; the unit is in the name."""

    does: str
    parameters: dict[str, ParameterTold]


class WordsTold(TypedDict):
    """The fault words of each simulated device."""

    devices: dict[str, dict[str, WordTold]]


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
