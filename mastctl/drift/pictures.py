"""What the drift sentinel keeps: reference images, a line for each look, and what the looks say together."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal

import numpy as np

from calib.calibrate.drift import SceneDrift
from calib.errors import BadFile
from calib.files import replace_bytes
from calib.matching.warp import Grey
from mastctl.answers import SentinelAnswer
from mastctl.as_json import as_json
from mastctl.drift.journal import Journal

FOLDER = "sentinel"
"""In a daemon's state folder, where its verdict has them from."""

REFERENCE, LOOKS = "reference.npz", "looks.jsonl"


@dataclass(frozen=True, eq=False)
class ReferencePicture:
    """A camera's image at a rest: true joint angles, and the mast file that they follow from."""

    camera: str
    pose: int
    pan_rad: float
    tilt_rad: float
    mast_digest: str
    image: Grey


@dataclass(frozen=True)
class Reference:
    """A folder's reference: when it was taken (ISO 8601), with which mast file, at which rests (pan, tilt).

    ``views``: camera, number of the rest, true pan and tilt of each image.
    """

    path: Path
    time: str
    mast_digest: str
    rests: tuple[tuple[float, float], ...]
    views: tuple[tuple[str, int, float, float], ...]

    def pictures(self) -> dict[tuple[str, int], ReferencePicture]:
        """Read the images, by camera and rest. Raises BadFile if one is damaged."""
        try:
            with np.load(self.path) as stored:
                return {
                    view[:2]: ReferencePicture(
                        *view, self.mast_digest, stored[f"image_{number}"].astype(np.float32)
                    )
                    for number, view in enumerate(self.views)
                }
        except Exception as error:  # whatever a library says of a damaged archive
            raise _damaged(self.path, error) from None


def save_reference(
    folder: Path, time: str, rests: Sequence[tuple[float, float]], pictures: Sequence[ReferencePicture]
) -> Reference:
    """Save reference images in place of any before, and forget the looks at those. Raises BadFile."""
    data = io.BytesIO()
    arrays: dict[str, Any] = {
        "time": time,
        "mast_digest": pictures[0].mast_digest,
        "rests": np.array(rests, dtype=float),
        "cameras": [one.camera for one in pictures],
        "poses": [one.pose for one in pictures],
        "true_rad": [(one.pan_rad, one.tilt_rad) for one in pictures],
    }
    for number, one in enumerate(pictures):
        arrays[f"image_{number}"] = np.clip(np.rint(one.image), 0, 255).astype(np.uint8)
    np.savez_compressed(data, **arrays)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        replace_bytes(folder / REFERENCE, data.getvalue(), 0o644)
    except OSError as error:
        raise BadFile(folder, "", f"cannot be written: {error.strerror or error}") from None
    (folder / LOOKS).unlink(missing_ok=True)
    return read_reference(folder)


def read_reference(folder: Path) -> Reference:
    """Read a folder's reference, without the images. Raises BadFile if there is none, or it is damaged."""
    path = folder / REFERENCE
    if not path.is_file():
        raise BadFile(folder, "", "holds no reference; take one: mastctl rig sentinel reference")
    try:
        with np.load(path) as stored:
            rests = tuple((float(pan), float(tilt)) for pan, tilt in stored["rests"])
            views = tuple(
                (str(camera), int(pose), float(pan), float(tilt))
                for camera, pose, (pan, tilt) in zip(
                    stored["cameras"], stored["poses"], stored["true_rad"], strict=True
                )
            )
            time = datetime.fromisoformat(str(stored["time"])).astimezone(UTC)
            return Reference(path, time.isoformat(), str(stored["mast_digest"]), rests, views)
    except Exception as error:  # as above
        raise _damaged(path, error) from None


def _damaged(path: Path, error: Exception) -> BadFile:
    return BadFile(path, "", f"is damaged ({type(error).__name__}); take the reference again")


def add_look(folder: Path, reference: Reference, drift: SceneDrift) -> dict[str, Any]:
    """Append what was found beside a reference now, and return the line. Raises BadFile."""
    line = {
        "time": now_utc(),
        "reference": reference.time,
        **as_json(drift),
        "changed": drift.changed,
        "sentence": drift.sentence,
    }
    try:
        _journal(folder).append(line)
    except BadFile as error:
        raise BadFile(error.path, error.place, f"{error.reason}; the look is not kept") from None
    return line


def read_looks(folder: Path, reference: Reference) -> list[dict[str, Any]]:
    """Return the looks at a reference, oldest first; lines that were cut or spoiled are left out.

    Raises BadFile if there is a file of looks that cannot be read.
    """
    return [line for line in _journal(folder).read() if line["reference"] == reference.time]


def _journal(folder: Path) -> Journal[dict[str, Any]]:
    return Journal(folder / LOOKS, "looks", _look)


def _look(value: Any) -> dict[str, Any]:
    """Pass the object of a look. Raises ValueError and others."""
    datetime.fromisoformat(value["time"]).astimezone(UTC)
    if not (
        isinstance(value["sentence"], str) and isinstance(value["changed"], bool) and value["views"] >= 0
    ):
        raise ValueError("it is no look")
    return {"reference": None, **value}


CONFIRMED = 2
"""So many looks one after the other must see a change before it is reported."""

SILENT = 3
"""So many looks since the last that knew anything, and it is not known any more that all is well."""


def now_utc() -> str:
    """Return the time of day (ISO 8601, to the second)."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def standing(
    reference: Reference, looks: Sequence[Mapping[str, Any]], now: datetime | None = None
) -> SentinelAnswer:
    """Return what the looks at a reference say together; ``now`` for how long ago, the present by default.

    ``bad`` for a change that two looks see, ``unsure`` for no look, one, or silent ones.
    """
    now = now or datetime.now(UTC)
    level, sentence, since = _judged(reference, looks, now)
    last = looks[-1]["time"] if looks else None
    return {
        "level": level, "sentence": sentence, "looks": len(looks), "since": since, "last_look": last,
        "age_s": last and age_s(last, now), "reference": reference.time,
    }  # fmt: skip


def _judged(
    reference: Reference, looks: Sequence[Mapping[str, Any]], now: datetime
) -> tuple[Literal["good", "unsure", "bad"], str, str | None]:
    """The level, its sentence, and the first look that saw the change (ISO 8601)."""
    clear = [one for one in looks if one["views"]]
    if not looks:
        return "unsure", f"no look yet at the reference of {_for_long(reference.time, now)} ago", None
    silent = len(list(takewhile(lambda one: not one["views"], reversed(looks))))
    nothing = f"{_looks(silent)} recognised nothing: night, fog, other light, another place?"
    if not clear:
        return "unsure", nothing, None
    age = f"last look {_for_long(clear[-1]['time'], now)} ago" + (f"; since then {nothing}" if silent else "")
    alike = len(list(takewhile(lambda one: one["changed"], reversed(clear))))
    if not alike:
        level: Literal["good", "unsure"] = "good" if silent < SILENT else "unsure"
        return level, f"nothing has changed, {_looks(len(clear))}, {age}", None
    first, change = clear[-alike]["time"], clear[-1]["sentence"]
    if alike < CONFIRMED:
        return "unsure", f"{change}, seen once: look again; {age}", first
    return "bad", f"{change}, since {_for_long(first, now)}, {age}", first


def _looks(count: int) -> str:
    return f"{count} look" + "s" * (count != 1)


def age_s(time: str, now: datetime) -> float:
    """Return how long ago a time (ISO 8601) was, seconds; 0 for one that is to come."""
    return max((now - datetime.fromisoformat(time).astimezone(UTC)).total_seconds(), 0.0)


def _for_long(time: str, now: datetime) -> str:
    """How long ago that was, as ``3 days``."""
    hours = age_s(time, now) / 3600.0
    if hours < 1.0:
        return f"{60.0 * hours:.0f} min"
    return f"{hours:.0f} h" if hours < 48.0 else f"{hours / 24.0:.0f} days"


class Findings:
    """What the looks in a folder say; its files are read by `poll` alone."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._marks: object = None
        self._read: tuple[Reference, list[dict[str, Any]]] | str = ""

    def answer(self, mast_digest: str) -> SentinelAnswer:
        """Return what the looks say of the mast file in use, as ``GET /sentinel`` has it."""
        if isinstance(self._read, str):
            return {
                "level": "unsure" if self._read else "none",
                "sentence": self._read or "no reference images have been taken",
                "looks": 0, "since": None, "last_look": None, "age_s": None, "reference": None,
            }  # fmt: skip
        reference, looks = self._read
        found = standing(reference, looks)
        if reference.mast_digest != mast_digest:
            sentence = f"the reference is of another mast file: take a new one ({found['sentence']})"
            found |= {"level": "unsure", "sentence": sentence}
        return found

    def poll(self) -> None:
        """Read the files again if one has changed."""
        marks = []
        for name in (REFERENCE, LOOKS):
            with suppress(OSError):
                about = (self._folder / name).stat()
                marks.append((name, about.st_mtime_ns, about.st_size))
        if marks == self._marks:
            return
        self._marks = marks
        try:
            if (self._folder / REFERENCE).is_file():
                reference = read_reference(self._folder)
                self._read = reference, read_looks(self._folder, reference)
            else:
                self._read = ""
        except BadFile as error:
            self._read = str(error)
