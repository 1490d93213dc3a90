"""Answers about what a daemon keeps: its rig, mast files, health, recordings, places, bench runs; of a
simulated rover its true pose, boards, time and faults.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NotRequired

from annotated_types import Ge, Gt, Len
from typing_extensions import TypedDict

from mastctl.answers.status import (
    MOST_CELLS,
    Angles,
    BenchState,
    BenchStep,
    CalibrationAnswer,
    Count,
    Json,
    MastAnswer,
    MaybePixel,
    Pixel,
    Point,
    Quaternion,
    Role,
    Seconds,
    SentinelAnswer,
)

RecordingKind = Literal["run", "kept", "ring"]


class CameraMount(TypedDict):
    """A configured camera: its direction, by its frame's axes, and its field.

    ``azimuth_rad`` (to the right), ``elevation_rad`` (up) of the optical axis; ``width_rad``, ``height_rad``
    of its picture's middle row and column; of a stereo pair ``pair``, ``side`` and the ``partner``.
    """

    on: Literal["head", "rover"]
    size_px: Annotated[list[int], Len(2, 2)]
    azimuth_rad: float
    elevation_rad: float
    width_rad: float
    height_rad: float
    pair: str | None
    side: Literal["left", "right"] | None
    partner: str | None


class RigSummary(TypedDict):
    """``GET /rig``: the configured cameras by the mast file in use, its date, its neighbours."""

    digest: str
    mast_date: str | None
    cameras: dict[str, CameraMount]
    mast_files: list[str]


class PanoramaListed(TypedDict):
    """A panorama: how it stands, and how many views are taken, wanted, missing, forbidden."""

    id: str
    time: str
    state: Literal["running", "done", "ended"]
    reason: str
    camera: str
    mast_digest: str
    views: dict[str, int]


class PanoramaList(TypedDict):
    """``GET /panoramas``: the newest first."""

    panoramas: list[PanoramaListed]


class PanoramaDrawn(TypedDict):
    """``GET /panoramas/{id}/drawing``: what is drawn over a panorama, in its pixels.

    ``view_px``: the border of what the mosaic's camera sees now, null before the first reading of the head.
    Before the mosaic is composed the pixels are those of a canvas to which ``/picture`` is stretched.
    """

    size_px: Annotated[list[int], Len(2, 2)]
    view_px: list[Pixel] | None
    targets_px: dict[str, Pixel]


class KeptTarget(TypedDict):
    """A point kept by a name, in the site frame where a pose was known; its covariance where one is."""

    position_m: Point
    frame: Literal["site", "rover"]
    covariance_m2: list[Point] | None


class TargetList(TypedDict):
    """``GET /targets``: by name."""

    targets: dict[str, KeptTarget]


class CameraTurn(TypedDict):
    """How far a camera, or both of a pair, seem turned, by the axes of the frame that they are mounted on."""

    turn_rad: Point
    sigma_rad: Point
    log10_evidence: float


class MeasuredPointing(TypedDict):
    """A pointing of which a new image was taken, or one camera's part of a hand-off.

    ``time_s`` since 1970 (UTC); ``source``, ``partner``: the pair that gave the position, the clicked camera
    first; ``camera``: the one that was aimed. ``from_rad``, ``to_rad``: true pan and tilt at the pair's
    images and at the new image. ``position_m`` in the rover frame, ``range_m`` from the aimed camera.
    ``off_px``: the part of the residual that measured joints do not explain; ``count_rad``: one count of each
    encoder; ``click_sigma_px``: of the target in the pair's images, where it is not the usual one.
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
    match_sigma_px: Annotated[list[Annotated[float, Gt(0.0)]], Len(2, 2)]
    count_rad: Annotated[list[Annotated[float, Ge(0.0)]], Len(2, 2)]
    click_sigma_px: NotRequired[Annotated[float, Gt(0.0)]]


# As `pydantic.with_config` does: the client alone has no pydantic.
MeasuredPointing.__pydantic_config__ = {"allow_inf_nan": False}  # type: ignore[attr-defined]


class CountedPointing(MeasuredPointing):
    """A pointing that counts: ``sigma_px`` of all that is expected, ``chi_square`` of ``off_px`` over it."""

    sigma_px: Pixel
    chi_square: float


class ResidualVerdict(CalibrationAnswer):
    """The verdict of residuals alone; ``times_expected``: rms over the expected, common parts taken out."""

    times_expected: float | None
    log10_evidence: float | None
    log10_threshold: float
    cameras: dict[str, CameraTurn]


class CalibrationReport(ResidualVerdict):
    """``GET /calibration/health``: the verdict, its figures, the newest pointings, the sentinel's looks."""

    newest: list[CountedPointing]
    sentinel: SentinelAnswer


class RecordingListed(TypedDict):
    """A recording on the disk: a run, what a fault kept, or the ring; size in 10⁶ bytes, its files' names."""

    name: str
    kind: RecordingKind
    size_mb: float
    files: Count
    names: list[str]


class RecorderState(TypedDict):
    """What is recorded now. ``dropped``: messages not written, by topic; ``fault``: what is wrong."""

    recording: bool
    ring_s: Seconds
    run: str | None
    file: str | None
    size_mb: float
    dropped: dict[str, Count]
    fault: str | None
    folder: str


class Recordings(TypedDict):
    """``GET /recordings``; ``free_mb``: of the disk, 10⁶ bytes, null if it does not say."""

    recordings: list[RecordingListed]
    recorder: RecorderState
    free_mb: float | None


class RecordingDeleted(TypedDict):
    """``DELETE /recordings/{name}``: those that are left."""

    recordings: list[RecordingListed]


class RecordingEnded(TypedDict):
    """``POST /recordings/stop``: the run, its file on the daemon's machine, what it lacks."""

    run: str
    file: str
    size_mb: float
    dropped: dict[str, Count]


class HeadPlace(TypedDict):
    """A place of the head, radians as it reads them."""

    pan_rad: float
    tilt_rad: float


class PlaceList(TypedDict):
    """The places that are kept, by name; ``home`` is always among them."""

    places: dict[str, HeadPlace]


class MastChange(TypedDict):
    """``POST /mast``: the mast file in use, and the one before it."""

    mast: MastAnswer
    former_mast: MastAnswer | None


class ClientSession(TypedDict):
    """``GET /session``: the client, its rights, how it came, and whether tokens are required at all."""

    name: str
    role: Role
    via: str
    needs_token: bool


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
    """Rms of corners that were not fitted, by camera, and of those pointed at: promised and measured."""

    promised_px: dict[str, float]
    pointings: list[Json]
    pointing_rms_px: MaybePixel | None
    pointing_promised_px: float | None


class BenchResult(TypedDict):
    """The result of a bench calibration: rms of each camera's corners, fitted and not; what the calibration,
    and the encoders' counts alone, leave of a first pointing, rms an axis.
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
    """How far a bench calibration is; ``pictures`` of the camera with most.

    ``predicted_px``, ``target_px``, ``counts_px``: rms per axis of a first pointing that the calibration
    leaves, may leave, and that counts alone leave; ``expected_px``: after a picture at ``next_rad``.
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
    """A bench calibration as far as it is known; ``most`` pictures of a camera; ``curve``: pictures and
    ``predicted_px``."""

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


class FaultKind(TypedDict):
    """A fault word: its effect, in one sentence, and its parameters; the unit is in the name."""

    effect: str
    parameters: dict[str, FaultParameter]


class FaultKinds(TypedDict):
    """The fault words of each simulated device."""

    devices: dict[str, dict[str, FaultKind]]


class PointTruth(TypedDict):
    """Where a point of the simulated scene truly is: in the site, in the rover frame of a frame, and in it.

    ``pixel_px`` is null where the camera could not see it, all three where the pixel shows the sky.
    """

    position_in_site_m: Point | None
    position_m: Point | None
    pixel_px: Pixel | None
