"""A survey: the measurements of one calibration (the folder of docs/how-to/calibrate.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from calib.geometry.cahvor import Kind
from calib.geometry.mode import SensorMode
from calib.geometry.rigid import FloatArray
from calib.targets.boards import AnyBoard, Board, Corners, Dots

StationKind = Literal["prism", "tape", "check"]
Purpose = Literal["camera", "mast", "check"]
Approach = Literal[-1, 0, 1]


@dataclass(frozen=True, eq=False)
class SurveyCamera:
    """The prior knowledge of a camera.

    ``rough_C_m`` and ``rough_A`` (3,) are in the rover frame at the angles of its first image, good to
    20 cm and 10 degrees, or None; ``focal_px`` is rough too. ``sensor_mode`` is that of its pictures, None if
    it is not known.
    """

    name: str
    on: Literal["head", "rover"]
    size_px: tuple[int, int]
    kind: Kind
    focal_px: float
    rough_C_m: FloatArray | None = None
    rough_A: FloatArray | None = None
    sensor_mode: SensorMode | None = None


@dataclass(frozen=True, eq=False)
class StationPoint:
    """A row of station.csv: a point (3,), metres, in the station frame of its set-up.

    ``row`` is the line of the file, the header being line 1.
    """

    setup: str
    kind: StationKind
    placement: str
    point: str
    position_m: FloatArray
    row: int


@dataclass(frozen=True, eq=False)
class SurveyImage:
    """A row of images.csv; body cameras have no angles (None).

    ``file`` is relative to the survey's folder, ``Path()`` where there is no picture but only dots.
    ``placement`` is empty for a check image without a board. ``row`` is the line of the file, the header
    being line 1. Of a bench: ``board`` names what it shows, and an approach is +1 where the joint came to
    rest from smaller angles, -1 from larger ones, 0 where that is not known.
    """

    name: str
    camera: str
    setup: str
    placement: str
    purpose: Purpose
    pan_rad: float | None
    tilt_rad: float | None
    file: Path
    row: int
    board: str = ""
    pan_approach: Approach = 0
    tilt_approach: Approach = 0


@dataclass(frozen=True, eq=False)
class Click:
    """A check point (kind ``check`` of the station) at ``pixel_px`` (2,) of an image."""

    image: str
    point: str
    pixel_px: FloatArray


@dataclass(frozen=True)
class Sigma:
    """Standard deviations of the measurements, one axis each.

    A bench has ``corner_px``, of corners without a sigma of their own in corners.csv, and ``joint_rad``.
    """

    station_m: float = 0.0
    dot_px: float = 0.0
    joint_rad: float = 0.0
    prism_cad_m: float = 0.0
    corner_px: float = 0.0


@dataclass(frozen=True, eq=False)
class Survey:
    """Everything that was measured.

    ``dots`` maps an image's name to its dots; ``digest`` identifies the folder's contents. A bench has no
    station: it has ``boards`` by name, with unknown poses (one for each set-up, placement and board), and
    ``corners`` by an image's name. Its ``board``, prisms, station, dots and clicks are empty.
    """

    folder: Path
    board: Board
    prisms_in_rover_m: Mapping[str, FloatArray]
    sigma: Sigma
    cameras: Mapping[str, SurveyCamera]
    stereo: Mapping[str, tuple[str, str]]
    station: tuple[StationPoint, ...]
    images: tuple[SurveyImage, ...]
    dots: Mapping[str, Dots]
    clicks: tuple[Click, ...] = ()
    digest: str = ""
    boards: Mapping[str, AnyBoard] = field(default_factory=dict)
    corners: Mapping[str, Corners] = field(default_factory=dict)

    def as_model(self, kind: Kind) -> Survey:
        """Return the survey with all its cameras fitted as one camera model."""
        cameras = {name: replace(camera, kind=kind) for name, camera in self.cameras.items()}
        return replace(self, cameras=cameras)

    def measured(self, kind: StationKind) -> dict[tuple[str, str], dict[str, FloatArray]]:
        """Return set-up and placement ('' for prisms) to the points (3,) of a kind measured there, metres."""
        groups: dict[tuple[str, str], dict[str, FloatArray]] = {}
        for point in self.station:
            if point.kind == kind:
                groups.setdefault((point.setup, point.placement), {})[point.point] = point.position_m
        return groups


@dataclass(frozen=True)
class SurveyFinding:
    """Something about a survey that a person should know before it is fitted.

    ``error``: do not fit this; ``warning``: the fit can go on and may be worse for it. The place is a file
    with its line, a camera, a set-up or a placement. The message has the finding's numbers, the advice the
    measurement to take or correct. ``tested_again`` findings are about single measurements that the joint fit
    tests itself, by all the others.
    """

    severity: Literal["error", "warning"]
    place: str
    message: str
    advice: str
    tested_again: bool = False

    def __str__(self) -> str:
        return f"{self.severity}: {self.place}: {self.message}. {self.advice}."
