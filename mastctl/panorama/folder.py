"""A panorama's folder: an index, pictures with their facts, the mast file, the mosaic and a preview.

    index.yaml     schema mastctl/panorama/1: what was wanted, each view, the mosaic, its seams
    mast.yaml      the mast file by which it was taken
    frames/        NNN-CAMERA.png, as the cameras gave them
    mosaic.png     composed by the mast file alone; preview.jpg, 2048 pixels wide at most

The index is replaced whole after each view, when its pictures are on the disk. Everything but the state that
a daemon keeps beside it is in the folder, so it opens anywhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import Field

from calib.errors import BadFile
from calib.files import digest_of, read_bytes, replace_bytes, write_new
from calib.files.mast_file import CameraName, StoredRig, load_rig
from calib.files.pictures import decode_picture
from calib.files.records import ABSENT, Moment, Number, Pair, Record, Text, Vector, parse_record
from calib.files.yaml_text import dump_mapping
from calib.geometry.cahvor import CameraModel
from calib.geometry.mosaic import Canvas, MosaicSurface, Projection
from calib.geometry.rigid import Rigid
from calib.matching.mosaic import Picture, SeamError, Slip
from mastctl.as_json import as_json
from mastctl.devices.frames import StampedFrame
from mastctl.frame_facts import FrameFacts
from mastctl.report.pictures import encoded

SCHEMA: Literal["mastctl/panorama/1"] = "mastctl/panorama/1"
INDEX, MAST, MOSAIC, PREVIEW = "index.yaml", "mast.yaml", "mosaic.png", "preview.jpg"
PREVIEW_PX = 2048
MOST_BYTES = 1 << 28
PICTURES_KEPT = 32
Count = Annotated[int, Field(ge=0, le=1_000_000)]


class FrameRecord(Record):
    """A picture of a view: its file, the SHA-256 of that, and its facts."""

    file: Annotated[str, Field(pattern=r"^frames/[^/]+\.png$")]
    sha256: Text
    facts: FrameFacts


class ViewRecord(Record):
    """One view: the true joint angles that were wanted, and what came of it."""

    pan_rad: Number
    tilt_rad: Number
    state: Literal["wanted", "taken", "missing", "forbidden"]
    reason: str = ""
    frames: dict[CameraName, FrameRecord] = Field(default_factory=dict)
    motion_evidence: dict[str, Any] = Field(default_factory=dict)


class MosaicRecord(Record):
    """How the mosaic was composed; its pixels are those of `calib.geometry.mosaic.Canvas`."""

    projection: Projection
    frame: Literal["mast", "rover"]
    surface: Text
    px_per_rad: Annotated[Number, Field(gt=0)]
    azimuth_rad: Number
    elevation_rad: Number
    size_px: Annotated[list[Count], Field(min_length=2, max_length=2)]
    origin_m: Vector
    rotation: Annotated[list[Vector], Field(min_length=3, max_length=3)]
    gains: list[Number] | None = None

    @property
    def canvas(self) -> Canvas:
        """The mosaic's pixels as directions."""
        return Canvas(
            self.projection, self.px_per_rad, self.azimuth_rad, self.elevation_rad,
            (self.size_px[0], self.size_px[1]), Rigid(np.array(self.rotation), np.array(self.origin_m)),
            MosaicSurface.of(self.surface),
        )  # fmt: skip

    @staticmethod
    def of(canvas: Canvas, frame: Literal["mast", "rover"], gains: Any) -> MosaicRecord:
        """Return the record of a canvas."""
        facts = as_json(canvas)
        pose = facts.pop("rover_from_mosaic")
        facts |= {
            "surface": str(canvas.surface),
            "origin_m": pose["translation_m"],
            "rotation": pose["rotation"],
        }
        return MosaicRecord(frame=frame, gains=as_json(gains), **facts)


class Index(Record):
    """``index.yaml``. ``cameras``: the one that the mosaic is made of first, then its partner."""

    schema_: Literal["mastctl/panorama/1"] = Field(alias="schema")
    id: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9-]{0,60}$")]
    time: Moment
    cameras: Annotated[list[CameraName], Field(min_length=1, max_length=2)]
    mast_digest: Text
    pan_rad: Pair
    tilt_rad: Pair
    overlap: Annotated[float, Field(ge=0.05, le=0.8)]
    exposure: Literal["first", "auto-per-view"]
    state: Literal["running", "done", "ended"]
    reason: str = ""
    views: list[ViewRecord]
    mosaic: MosaicRecord | None = ABSENT
    seams: list[SeamError] = Field(default_factory=list)
    whole: SeamError | None = ABSENT
    slip: Slip | None = ABSENT

    def taken(self) -> list[tuple[int, ViewRecord]]:
        """Return the views that the mosaic is made of, with their numbers."""
        return [(at, one) for at, one in enumerate(self.views) if one.state == "taken"]

    def with_view(self, number: int, view: ViewRecord) -> Index:
        """Return it with another record of one view."""
        views = [view if at == number else one for at, one in enumerate(self.views)]
        return self.model_copy(update={"views": views})


class Folder:
    """A panorama on the disk. Raises BadFile if there is none, or its index or mast file cannot be read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.index = parse_record(Index, read_bytes(path / INDEX, MOST_BYTES), path / INDEX, SCHEMA)
        self.mast: StoredRig = load_rig(path / MAST)

    @staticmethod
    def begin(path: Path, index: Index, mast_file: bytes) -> Folder:
        """Make a folder for a panorama that has no views yet. Raises BadFile."""
        try:
            (path / "frames").mkdir(parents=True)
            write_new(path / MAST, mast_file)
        except OSError as error:
            raise BadFile(path, "", f"cannot be written: {error.strerror or error}") from None
        _save(path, index)
        return Folder(path)

    def save(self, index: Index) -> None:
        """Replace the index. Raises BadFile; the old one is then still there."""
        _save(self.path, index)
        self.index = index

    def keep(self, number: int, camera: str, frame: StampedFrame) -> FrameRecord:
        """Write a picture of a view and return its record. Raises BadFile; nothing is left then."""
        file = f"frames/{number:03d}-{camera}.png"
        data = encoded(frame.image, "png")
        write_whole(self.path / file, data)
        return FrameRecord(file=file, sha256=digest_of(data), facts=frame.facts)

    def picture(self, frame: FrameRecord) -> Picture:
        """Return a view's picture. Raises BadFile if it is not the one that was taken."""
        path = self.path / frame.file
        data = read_bytes(path, MOST_BYTES)
        if digest_of(data) != frame.sha256:
            raise BadFile(path, "", "is not the picture that was taken; the index has another digest")
        return _decoded(path, data)

    def mosaic(self) -> Picture:
        """Return the mosaic that the index describes. Raises BadFile."""
        path, record = self.path / MOSAIC, self.index.mosaic
        assert record is not None
        image = _decoded(path, read_bytes(path, MOST_BYTES))
        if [image.shape[1], image.shape[0]] != record.size_px:
            raise BadFile(
                path, "", "has another size than the index says; 'mastctl panorama compose' mends it"
            )
        return image

    def frame(self, number: int, camera: str) -> StampedFrame:
        """Return a picture of a view with its facts, as a camera gave it. Raises BadFile."""
        record = self.index.views[number].frames[camera]
        image = self.picture(record)
        image.setflags(write=False)
        facts = {one.name: getattr(record.facts, one.name) for one in fields(FrameFacts)}
        return StampedFrame(**facts, image=image)

    def angles_rad(self) -> list[tuple[float, float]]:
        """Return true (pan, tilt) of each view that was taken."""
        return [view.frames[self.index.cameras[0]].facts.true_rad for _, view in self.index.taken()]

    def cameras(self) -> list[CameraModel]:
        """Return the mosaic's camera at each view that was taken, in the rover frame."""
        name = self.index.cameras[0]
        return [self.mast.rig.camera_in_rover(name, *angles) for angles in self.angles_rad()]

    def pictures(self) -> Callable[[int], Picture]:
        """Return what reads the mosaic's pictures, by their place in `cameras`; a few stay in memory."""
        frames = [view.frames[self.index.cameras[0]] for _, view in self.index.taken()]
        return lru_cache(PICTURES_KEPT)(lambda at: self.picture(frames[at]))


def write_whole(path: Path, data: bytes) -> None:
    """Write a file whole or not at all. Raises BadFile."""
    try:
        replace_bytes(path, data, 0o644)
    except OSError as error:
        raise BadFile(path, "", f"cannot be written: {error.strerror or error}") from None


def _decoded(path: Path, data: bytes) -> Picture:
    try:
        return np.asarray(decode_picture(data, cv2.IMREAD_UNCHANGED), dtype=np.uint8)
    except ValueError as error:
        raise BadFile(path, "", str(error)) from None


def _save(path: Path, index: Index) -> None:
    write_whole(path / INDEX, dump_mapping(index.model_dump(by_alias=True, exclude_none=True)))
