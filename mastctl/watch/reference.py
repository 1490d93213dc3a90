"""What a sentinel keeps: its reference pictures, and a line for each look."""

from __future__ import annotations

import hashlib
import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import cv2
import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from calib.calibrate.drift import SceneDrift
from calib.errors import BadFile
from calib.files import read_bytes
from calib.files.atomic import replace_bytes
from calib.files.records import Moment, Record, Text, problem, read_record
from calib.matching.warp import Grey, grey
from mastctl.watch.journal import Journal

SCHEMA: Literal["mastctl/sentinel/1"] = "mastctl/sentinel/1"
SENTINEL_FOLDER = "sentinel"
"""In a daemon's state folder, where its status reads it."""

REFERENCE, LOOKS = "reference.json", "looks.jsonl"
MOST_BYTES, MOST_PICTURE_BYTES = 4_000_000, 1 << 28


_Angle = Annotated[float, Field(ge=-100.0, le=100.0)]


class PictureRecord(Record):
    """A picture of `reference.json`."""

    camera: Text
    pose: Annotated[int, Field(ge=0, le=1_000_000)]
    pan_rad: _Angle
    tilt_rad: _Angle
    file: Text
    sha256: Text


@dataclass(frozen=True, eq=False)
class ReferencePicture:
    """A camera's picture at a rest: true joint angles, and the mast file that they follow from."""

    camera: str
    pose: int
    pan_rad: float
    tilt_rad: float
    mast_digest: str
    image: Grey


class Reference(Record):
    """A folder's reference: when it was taken, with which mast file, at which rests; its pictures."""

    schema_: Literal["mastctl/sentinel/1"] = Field(alias="schema")
    time: Moment
    mast_digest: Text
    rests: list[Annotated[list[_Angle], Field(min_length=2, max_length=2)]]
    pictures: list[PictureRecord]
    _folder: Path = PrivateAttr(default=Path())

    @model_validator(mode="after")
    def _has_a_rest_for_each_picture(self) -> Self:
        most = len(self.rests) - 1
        for at, one in enumerate(self.pictures):
            if one.pose > most:
                reason = f"{one.pose} where an integer from 0 to {most} is expected"
                raise problem(f"pictures[{at}].pose", reason)
        return self

    @property
    def cameras(self) -> tuple[str, ...]:
        """The cameras that it has pictures of."""
        return tuple(dict.fromkeys(one.camera for one in self.pictures))

    def check(self) -> None:
        """Pass if all pictures can be read. Raises BadFile."""
        for one in self.pictures:
            self.picture(one.camera, one.pose)

    def picture(self, camera: str, pose: int) -> ReferencePicture | None:
        """Return a picture, None if the reference has none of this camera there. Raises BadFile."""
        for one in self.pictures:
            if (one.camera, one.pose) == (camera, pose):
                path = self._folder / one.file
                data = read_bytes(path, MOST_PICTURE_BYTES)
                whole = hashlib.sha256(data).hexdigest() == one.sha256
                image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE) if whole else None
                if image is None:
                    raise BadFile(path, "", "is not the picture that was taken; take the reference again")
                return ReferencePicture(
                    camera, pose, one.pan_rad, one.tilt_rad, self.mast_digest, grey(image)
                )
        return None


def save_reference(
    folder: Path, time: str, rests: Sequence[tuple[float, float]], pictures: Sequence[ReferencePicture]
) -> Reference:
    """Save reference pictures in place of any before, and forget the looks at those.

    A reference counts from its ``reference.json`` on, which is written last. Raises BadFile.
    """
    inner = None
    try:
        folder.mkdir(parents=True, exist_ok=True)
        inner = Path(tempfile.mkdtemp(prefix="pictures-", dir=folder))
        reference = Reference(
            schema=SCHEMA,
            time=time,
            mast_digest=pictures[0].mast_digest,
            rests=[list(rest) for rest in rests],
            pictures=[_saved(folder, inner, one) for one in pictures],
        )
        document = reference.model_dump_json(by_alias=True, indent=1)
        replace_bytes(folder / REFERENCE, document.encode(), 0o644)
    except OSError as error:
        if inner is not None:
            shutil.rmtree(inner, ignore_errors=True)  # the former reference still counts
        raise BadFile(folder, "", f"cannot be written: {error.strerror or error}") from None
    (folder / LOOKS).unlink(missing_ok=True)
    for old in folder.glob("pictures-*"):
        if old != inner:
            shutil.rmtree(old, ignore_errors=True)
    return read_reference(folder)


def _saved(folder: Path, inner: Path, one: ReferencePicture) -> PictureRecord:
    """Write a picture; what the reference says of it. Raises OSError."""
    done, png = cv2.imencode(".png", np.clip(np.rint(one.image), 0, 255).astype(np.uint8))
    if not done:
        raise OSError(None, f"{one.camera}'s picture cannot be written as PNG")
    path = inner / f"{one.pose}-{one.camera}.png"
    path.write_bytes(png.tobytes())
    return PictureRecord(
        camera=one.camera,
        pose=one.pose,
        pan_rad=one.pan_rad,
        tilt_rad=one.tilt_rad,
        file=str(path.relative_to(folder)),
        sha256=hashlib.sha256(png.tobytes()).hexdigest(),
    )


def read_reference(folder: Path) -> Reference:
    """Read a folder's reference. Raises BadFile if there is none, or it is damaged."""
    path = folder / REFERENCE
    if not path.is_file():
        raise BadFile(folder, "", "holds no reference; take one: mastctl rig sentinel reference")
    try:
        document = json.loads(read_bytes(path, MOST_BYTES))
    except (ValueError, RecursionError):
        raise BadFile(path, "", "is no JSON; take the reference again") from None
    reference = read_record(Reference, document, path)
    reference._folder = folder
    return reference


def add_look(folder: Path, reference: Reference, time: str, drift: SceneDrift) -> dict[str, Any]:
    """Append what a look at a reference found, and return it. Raises BadFile."""
    look = look_line(reference, time, drift)
    try:
        look_journal(folder).append(look)
    except BadFile as error:
        raise BadFile(error.path, error.place, f"{error.reason}; the look is not kept") from None
    return look


def look_journal(folder: Path) -> Journal[dict[str, Any]]:
    """Return the journal of the looks in a folder."""
    return Journal(folder / LOOKS, "looks", lambda look: look, _look)


def look_line(reference: Reference, time: str, drift: SceneDrift) -> dict[str, Any]:
    """Return what is kept of a look at a reference."""
    return {
        "time": time,
        "reference": reference.time,
        "views": drift.views,
        "silent": list(drift.silent),
        "missing": dict(drift.missing),
        "changed": drift.changed,
        "sigmas": drift.sigmas,
        "moved_px": drift.moved_px,
        "sentence": drift.sentence,
    }


def read_looks(folder: Path, reference: Reference) -> list[dict[str, Any]]:
    """Return the looks at a reference, oldest first; lines that were cut or spoiled are left out.

    Raises BadFile if there is a file of looks that cannot be read.
    """
    return [look for look in look_journal(folder).read() if look.get("reference") == reference.time]


def _look(value: Any) -> dict[str, Any]:
    """Pass the object of a look. Raises ValueError and others."""
    datetime.fromisoformat(value["time"]).astimezone(UTC)
    look: dict[str, Any] = {"changed": bool(value.get("named")), **value}  # before 0.1 a change had a name
    if not isinstance(look["sentence"], str) or look["views"] < 0:
        raise ValueError("it is no look")
    return look
