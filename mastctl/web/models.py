"""The bodies and queries that the API takes."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, Self, cast

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from calib.geometry.rigid import Rigid, rotation_of
from mastctl.control.lease import LONGEST_S, SHORTEST_S, USUAL_S
from mastctl.control.publisher import TOPICS, Topic
from mastctl.devices.judge import LEAST_CONE_RAD, WIDEST_CONE_RAD, SunDirection, direction_of
from mastctl.motion.requests import LARGEST_M, LARGEST_PX, Angle, Metres, Name, Place, StrictBody
from mastctl.motion.track import RoverPose
from mastctl.safety.latch import LONGEST

Slope = Annotated[float, Field(ge=-1.0, le=1.0)]
Sigma = Annotated[float, Field(ge=0.0, le=LARGEST_M)]
Part = Annotated[float, Field(ge=-1e9, le=1e9)]
LeaseS = Annotated[float, Field(ge=SHORTEST_S, le=LONGEST_S)]
MOST_KEYS = 16


Words = Annotated[str, StringConstraints(strip_whitespace=True, min_length=1, max_length=LONGEST)]


class EstopBody(BaseModel):
    """``POST /estop``: why and by whom, if they are given."""

    reason: str | None = None
    name: str | None = None


class ResetBody(StrictBody):
    """``POST /reset``: why and by whom the stop is released."""

    reason: Words
    name: Words


class LeaseBody(StrictBody):
    """``POST /lease``: how long, and whose it is, if not the caller's.

    ``ends_with_stop``: it ends with the next stop of the head.
    """

    name: Name | None = None
    for_s: LeaseS = USUAL_S
    ends_with_stop: bool = False


class RenewBody(StrictBody):
    """``POST /lease/renew``: how long from now on; as long as at first when left out."""

    for_s: LeaseS | None = None


class TakeBody(LeaseBody):
    """``POST /lease/take``: why, beside what goes with a lease."""

    reason: Annotated[
        str, Field(min_length=1, max_length=400, pattern=r"\S", description="a reason in words")
    ]


class CameraSettingsBody(StrictBody):
    """``PATCH /cameras/{camera}/settings``: what is to change; one at least."""

    exposure_s: float | None = None
    gain: float | None = None
    white_balance_k: float | None = None
    focus: float | None = None

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not self.wanted:
            raise ValueError(f"one of {', '.join(type(self).model_fields)} at least is expected")
        return self

    @property
    def wanted(self) -> dict[str, float]:
        """The changes, by name."""
        return self.model_dump(exclude_none=True)


class RecordBody(StrictBody):
    """``POST /recordings/start``: a word for the file's name."""

    name: Annotated[str, Field(max_length=60)] = ""


class SigmaBody(StrictBody):
    """One sigma of each axis of a motion: of its translation, metres, and of its rotation, radians."""

    position_m: Sigma
    rotation_rad: Annotated[float, Field(ge=0.0, le=math.pi)]


class PoseBody(StrictBody):
    """``POST /pose``: site_from_rover, and how well the motion since the pose before is known.

    ``covariance`` has its rows and columns in the order x, y, z, turn about x, about y, about z: metres and
    radians along the rover's axes of this pose.
    """

    position_m: Place
    quaternion: Annotated[list[Part], Field(min_length=4, max_length=4)]
    covariance: list[list[Part]] | None = None
    sigma: SigmaBody | None = None
    time_s: Annotated[float, Field(ge=-1e12, le=1e12)] | None = None
    look: bool = True

    @model_validator(mode="after")
    def _sound(self) -> PoseBody:
        length = math.sqrt(sum(part * part for part in self.quaternion))
        if abs(length - 1.0) > 1e-3:
            raise ValueError(f"quaternion (w, x, y, z) has the length {length:g} where 1 is expected")
        if self.covariance is not None and self.sigma is not None:
            raise ValueError("covariance and sigma say the same; one of them is expected")
        if self.covariance is not None:
            _check_covariance(self.covariance)
        return self

    def pose(self, received_s: float) -> RoverPose:
        """Return it as the tracker takes it."""
        rotation = rotation_of(self.quaternion)
        covariance = None
        if self.covariance is not None:
            order = [3, 4, 5, 0, 1, 2]  # rotation first, as calib.matching.track has it
            covariance = np.array(self.covariance)[np.ix_(order, order)]
        elif self.sigma is not None:
            covariance = np.diag([self.sigma.rotation_rad**2] * 3 + [self.sigma.position_m**2] * 3)
        return RoverPose(Rigid(rotation, np.array(self.position_m)), covariance, self.time_s, received_s)


_NEGATIVE = "covariance has a negative variance in some direction"


def _check_covariance(rows: list[list[float]]) -> None:
    """Pass a matrix that can be a covariance. Raises ValueError."""
    if len(rows) != 6 or any(len(row) != 6 for row in rows):
        raise ValueError("covariance: 6 rows of 6 numbers are expected")
    matrix = np.array(rows)
    variances = np.diag(matrix)
    if (variances < 0).any():
        raise ValueError(_NEGATIVE)
    # Each axis by its own sigma: a large one in metres hides nothing that is wrong with a small one.
    sigma = np.where(variances > 0, np.sqrt(np.abs(variances)), 1.0)
    correlation = matrix / sigma / sigma[:, None]
    if np.abs(correlation - correlation.T).max() > 1e-6:
        raise ValueError("covariance is not symmetric")
    if np.linalg.eigvalsh(correlation)[0] < -1e-6:
        raise ValueError(_NEGATIVE)


class SunBody(StrictBody):
    """``POST /limits/sun``: a direction by azimuth and elevation, or as a vector, and the cone around it.

    Azimuth goes from x over y, elevation up; in the site frame x is north and y east, in the rover's forward
    and right. ``valid_s`` is how long it holds; left out: until another is given.
    """

    azimuth_rad: Angle | None = None
    elevation_rad: Annotated[float, Field(ge=-math.pi / 2, le=math.pi / 2)] | None = None
    direction: Annotated[list[Part], Field(min_length=3, max_length=3)] | None = None
    frame: Literal["site", "rover"] = "site"
    half_angle_rad: Annotated[float, Field(ge=LEAST_CONE_RAD, le=WIDEST_CONE_RAD)]
    valid_s: Annotated[float, Field(gt=0.0, le=1e6)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        angles = (self.azimuth_rad is not None) + (self.elevation_rad is not None)
        if angles != (0 if self.direction is not None else 2):
            raise ValueError("azimuth_rad with elevation_rad, or direction, is expected")
        if self.direction is not None and not math.hypot(*self.direction) > 1e-6:
            raise ValueError("direction is no direction: its length is 0")
        return self

    def sun(self, now_s: float) -> SunDirection:
        """Return it as the judge of moves takes it."""
        if self.direction is None:
            assert self.azimuth_rad is not None and self.elevation_rad is not None
            x, y, z = direction_of(self.azimuth_rad, self.elevation_rad)
        else:
            x, y, z = (part / math.hypot(*self.direction) for part in self.direction)
        until_s = None if self.valid_s is None else now_s + self.valid_s
        return SunDirection((x, y, z), self.frame, self.half_angle_rad, until_s)


class StandBody(StrictBody):
    """``POST /simulation/pose``: where the simulated rover truly stands on its ground."""

    x_m: Metres
    y_m: Metres
    heading_rad: Angle
    pitch_rad: Slope = 0.0
    roll_rad: Slope = 0.0


class BoardBody(StrictBody):
    """``POST /simulation/boards/{name}``: where a board is held up before a simulated rover.

    ``board`` holds what a BOARD.yaml does (its ``schema`` may be left out); without it a board of this name
    is moved that is there already. The place is in the rover frame as the rover stands now. Without
    ``quaternion`` (w, x, y, z; rover_from_board) it faces the mast upright and is then turned about its own
    x, y and z.
    """

    position_m: Place
    board: dict[str, Any] | None = None
    turned_rad: Annotated[list[Angle], Field(min_length=3, max_length=3)] | None = None
    quaternion: Annotated[list[Part], Field(min_length=4, max_length=4)] | None = None
    bow_m: Annotated[list[Metres], Field(min_length=2, max_length=2)] | None = None

    @model_validator(mode="after")
    def _one_turn(self) -> BoardBody:
        if self.turned_rad is not None and self.quaternion is not None:
            raise ValueError("quaternion and turned_rad are both there, one of them is expected")
        if self.quaternion is not None and float(np.linalg.norm(self.quaternion)) < 1e-6:
            raise ValueError(f"quaternion: {self.quaternion} where one that is not zero is expected")
        return self


class TimeBody(StrictBody):
    """``POST /simulation/time``: let time pass where it does not pass by itself."""

    advance_s: Annotated[float, Field(ge=0.0, le=3600.0)]


class MastBody(StrictBody):
    """``POST /mast``: the name of a file beside the configured mast file."""

    file: Name


class PlaceBody(StrictBody):
    """``POST /places/{name}``: the angles that are kept, as the head reads them."""

    pan_rad: Angle
    tilt_rad: Angle


class BenchBody(StrictBody):
    """``POST /bench``: with which board, and how far; or with which run to go on.

    ``board`` names a packaged one, ``board_file`` is the text of a BOARD.yaml. ``wanted_px`` is what the
    calibration may leave of a first pointing, rms an axis; ``pictures`` of each camera at most; ``by_hand``:
    a simulated board waits for `POST /bench/stands` too, as a real one always does. Left out they are 0.2,
    60 and false, or as the run had them that goes on.
    """

    board: Name | None = None
    board_file: Annotated[str, Field(min_length=1, max_length=20000)] | None = None
    resume: Name | None = None
    wanted_px: Annotated[float, Field(ge=0.01, le=20.0)] | None = None
    pictures: Annotated[int, Field(ge=12, le=500)] | None = None
    by_hand: bool | None = None

    @model_validator(mode="after")
    def _one(self) -> BenchBody:
        if sum(one is not None for one in (self.board, self.board_file, self.resume)) != 1:
            raise ValueError("board, board_file or resume is expected, and one of them")
        return self


class PanoramaBody(StrictBody):
    """``POST /panoramas``: which field, azimuth and elevation, by which cameras; or what to go on with.

    By default the widest stereo pair, all that the limits let it see, 0.7 rad down to 0.2 rad up.
    ``exposure``: fixed from the first view on, or each view's own.
    """

    pair: Name | None = None
    camera: Name | None = None
    pan_rad: Annotated[list[Angle], Field(min_length=2, max_length=2)] | None = None
    tilt_rad: Annotated[list[Angle], Field(min_length=2, max_length=2)] | None = None
    overlap: Annotated[float, Field(ge=0.05, le=0.8)] = 0.2
    exposure: Literal["first", "auto-per-view"] = "first"
    resume: Name | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.pair is not None and self.camera is not None:
            raise ValueError("pair and camera are both there, one of them is expected")
        if self.resume is not None and self.model_fields_set - {"resume", "deadline_s"}:
            raise ValueError("resume goes alone: a panorama goes on as it was begun")
        return self


class TargetBody(StrictBody):
    """``POST /targets/{name}``: a point of the rover or site frame, and its covariance if it is known.

    Without ``position_m`` the one that ``operation`` measured, a pointing since which the rover stood.
    """

    position_m: Place | None = None
    operation: Name | None = None
    frame: Literal["rover", "site"] = "rover"
    covariance_m2: Annotated[list[Place], Field(min_length=3, max_length=3)] | None = None

    @model_validator(mode="after")
    def _one(self) -> TargetBody:
        if (self.position_m is None) == (self.operation is None):
            raise ValueError("exactly one of position_m and operation is expected")
        return self


class FaultBody(StrictBody):
    """``POST /simulation/faults``: a fault word for a simulated device, with its parameters."""

    device: Name
    word: Name
    parameters: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _free_names(self) -> FaultBody:
        for name in ("device", "word", "self"):
            if name in self.parameters:
                raise ValueError(f"parameters.{name}: unknown key; no fault has a parameter of this name")
        return self


class StrictQuery(BaseModel):
    """A query without unknown names; its numbers come as text."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class SnapshotQuery(StrictQuery):
    """``GET /snapshot/{camera}``; ``frame_id`` names a frame that is still kept."""

    format: Literal["png", "jpeg"] = "png"
    fresh: bool = False
    frame_id: Name | None = None


class EventsQuery(StrictQuery):
    """``GET /events``: ``topics`` with commas between, all of them when left out; ``key``: of these only."""

    topics: Annotated[str, Field(max_length=200)] | None = None
    key: Annotated[list[Name], Field(max_length=MOST_KEYS)] | None = None

    @model_validator(mode="after")
    def _known(self) -> Self:
        unknown = [name for name in self.names if name not in TOPICS]
        if unknown:
            raise ValueError(f"topics: {unknown[0]!r} where some of {', '.join(sorted(TOPICS))} are expected")
        return self

    @property
    def names(self) -> tuple[Topic, ...]:
        """The topics, none for all."""
        return tuple(cast(Topic, name.strip()) for name in (self.topics or "").split(",") if name.strip())

    @property
    def keys(self) -> frozenset[str] | None:
        """The keys, None for all."""
        return None if self.key is None else frozenset(self.key)


class ImagesQuery(StrictQuery):
    """``GET /images``, a WebSocket: of which cameras; whether their first pictures are requested too, and all
    of them come at the cameras' own rate.
    """

    camera: Annotated[list[Name], Field(min_length=1, max_length=MOST_KEYS)]
    on_request: bool = False
    every: bool = False


QueryPixel = Annotated[float, Field(ge=-LARGEST_PX, le=LARGEST_PX)]
QueryMetres = Annotated[float, Field(ge=-LARGEST_M, le=LARGEST_M)]


class TruthQuery(StrictQuery):
    """``GET /simulation/truth``: a frame, and a pixel of it or a point of the site, metres."""

    frame_id: Name
    x_px: QueryPixel | None = None
    y_px: QueryPixel | None = None
    x_m: QueryMetres | None = None
    y_m: QueryMetres | None = None
    z_m: QueryMetres | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        given = {name for name in ("x_px", "y_px", "x_m", "y_m", "z_m") if getattr(self, name) is not None}
        if given not in ({"x_px", "y_px"}, {"x_m", "y_m", "z_m"}):
            raise ValueError("x_px and y_px, or x_m, y_m and z_m, are expected, and not both")
        return self

    @property
    def pixel_px(self) -> tuple[float, float] | None:
        """The pixel, None where a point was given."""
        return None if self.x_px is None or self.y_px is None else (self.x_px, self.y_px)

    @property
    def position_in_site_m(self) -> tuple[float, float, float] | None:
        """The point, None where a pixel was given."""
        if self.x_m is None or self.y_m is None or self.z_m is None:
            return None
        return self.x_m, self.y_m, self.z_m


class FaultsQuery(StrictQuery):
    """``DELETE /simulation/faults``; without a device all faults are taken back."""

    device: Name | None = None
