"""Answers about the things that a daemon keeps: its rig, mast files, health, recordings, places, sessions."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from annotated_types import Len
from typing_extensions import TypedDict

from mastctl.answers.status import CalibrationTold, MastTold, SentinelTold
from mastctl.answers.words import Angles, Count, Pixel, Point, Role, Seconds

RecordingKind = Literal["run", "kept", "ring"]


class CameraMountTold(TypedDict):
    """A configured camera: where it looks, by its frame's axes, and how much it sees.

    ``azimuth_rad`` (to the right), ``elevation_rad`` (up) of the optical axis; ``width_rad``, ``height_rad``
    of its picture's middle row and column; of a stereo pair ``pair``, ``eye`` and the ``partner``.
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


class RigTold(TypedDict):
    """``GET /rig``: the configured cameras by the mast file in use, its date, its neighbours.

    ``mast_date`` as the file's provenance says it; ``modified_s``: of the file, seconds since 1970 (UTC).
    """

    digest: str
    mast_date: str | None
    modified_s: float | None
    cameras: dict[str, CameraMountTold]
    mast_files: list[str]


class TurnedTold(TypedDict):
    """How far a camera seems turned, by the axes of the frame that it is mounted on."""

    turn_rad: Point
    sigma_rad: Point
    log10_evidence: float


class MeasuredTold(TypedDict):
    """A pointing that counts: where, the residual, the part that joints do not explain, its predicted sigma.

    ``time_s`` since 1970 (UTC); ``chi_square``: of ``off_px`` over all that is expected, 2 on average.
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
    chi_square: float


class CalibrationHealthTold(CalibrationTold):
    """``GET /calibration/health``: the verdict, its figures, the newest pointings that count, and what the
    drift sentinel's looks say."""

    times_expected: float | None
    log10_evidence: float | None
    log10_threshold: float
    false_alarms_per_day: float
    cameras: dict[str, TurnedTold]
    write_error: str | None
    newest: list[MeasuredTold]
    sentinel: SentinelTold | None


class RecordingListed(TypedDict):
    """A recording on the disk: a run, what a fault kept, or the ring; size in 10⁶ bytes, its files' names."""

    name: str
    kind: RecordingKind
    size_mb: float
    files: Count
    names: list[str]


class RecorderTold(TypedDict):
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
    recorder: RecorderTold
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


class PlaceTold(TypedDict):
    """A place of the head, radians as it reads them."""

    pan_rad: float
    tilt_rad: float


class PlacesTold(TypedDict):
    """The places that are kept, by name; ``home`` is always among them."""

    places: dict[str, PlaceTold]


class MastsTold(TypedDict):
    """``POST /mast``: the mast file in use, and the one before it."""

    mast: MastTold
    former_mast: MastTold | None


class ChangeTold(TypedDict):
    """A difference of two configurations: the key, its former and its present value; null where absent."""

    key: str
    before: Any
    after: Any


class ReloadTold(TypedDict):
    """``POST /reload``: what changed, the mast file in use, and sentences that say what to know of it."""

    changed: list[ChangeTold]
    mast: MastTold
    notes: list[str]


class SessionTold(TypedDict):
    """``GET /session``: the client, its rights, and the way it came.

    ``needs_token``: whether the daemon requires one at all.
    """

    name: str
    role: Role
    via: str
    needs_token: bool
