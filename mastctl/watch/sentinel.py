"""What a sentinel keeps, reference pictures and a line for each look, and what the looks say together."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from itertools import takewhile
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import cv2
import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from calib.calibrate.drift import SceneDrift
from calib.errors import BadFile
from calib.files import read_bytes, replace_bytes
from calib.files.records import Moment, Record, Text, problem, read_record
from calib.matching.warp import Grey, grey
from mastctl.answers import SentinelAnswer
from mastctl.as_json import as_json
from mastctl.watch.journal import Journal, JournalThread

log = logging.getLogger(__name__)

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


def _journal(folder: Path) -> Journal[dict[str, Any]]:
    return Journal(folder / LOOKS, "looks", dict, _look)


def read_looks(folder: Path, reference: Reference) -> list[dict[str, Any]]:
    """Return the looks at a reference, oldest first; lines that were cut or spoiled are left out.

    Raises BadFile if there is a file of looks that cannot be read.
    """
    return [line for line in _journal(folder).read() if line.get("reference") == reference.time]


def _look(value: Any) -> dict[str, Any]:
    """Pass the object of a look. Raises ValueError and others."""
    datetime.fromisoformat(value["time"]).astimezone(UTC)
    look: dict[str, Any] = {"changed": bool(value.get("named")), **value}  # before 0.1 a change had a name
    if not isinstance(look["sentence"], str) or look["views"] < 0:
        raise ValueError("it is no look")
    return look


CONFIRMED = 2
"""So many looks one after the other must see a change before it is reported."""

OLD_S = 7.0 * 86400.0
"""What was found by a look longer ago than this is reported with the age of the look."""

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
        "age_s": last and max(age_s(last, now), 0.0), "reference": reference.time,
    }  # fmt: skip


def _judged(
    reference: Reference, looks: Sequence[Mapping[str, Any]], now: datetime
) -> tuple[Literal["good", "unsure", "bad"], str, str | None]:
    """The level, its sentence, and the first look that saw the change (ISO 8601)."""
    if not looks:
        return "unsure", f"no look yet at the reference of {_ago(reference.time, now)}", None
    clear = [one for one in looks if one["views"]]
    if not clear:
        blind = f"{_looks(len(looks))} saw nothing they knew: night, fog, other light, another place?"
        return "unsure", f"{blind} The last {_ago(looks[-1]['time'], now)}", None
    last = clear[-1]
    silent = len(looks) - 1 - max(at for at, one in enumerate(looks) if one["views"])
    blind = f"; {_looks(silent)} since then saw nothing they knew" if silent else ""
    seen = f"last looked {_ago(last['time'], now)}"
    if not last["changed"]:
        sentence = f"nothing has changed, {_looks(len(clear))}, {seen}{blind}"
        return "good" if silent < SILENT else "unsure", sentence, None
    alike = len(list(takewhile(lambda one: one["changed"], reversed(clear))))
    first = clear[-alike]["time"]
    if alike < CONFIRMED:
        return "unsure", f"{last['sentence']}, seen once {_ago(first, now)}: look again{blind}", first
    old = f" ({seen})" if age_s(last["time"], now) > OLD_S else ""
    return "bad", f"{last['sentence']}, since {_for_long(first, now)}{old}{blind}", first


def findings(folder: Path, mast_digest: str) -> SentinelAnswer:
    """Return what a folder says, as ``GET /sentinel`` has it; ``mast_digest``: of the mast file in use."""
    damaged = ""
    try:
        if (folder / REFERENCE).is_file():
            reference = read_reference(folder)
            found = standing(reference, read_looks(folder, reference))
            if reference.mast_digest != mast_digest:
                sentence = f"the reference is of another mast file: take a new one ({found['sentence']})"
                found |= {"level": "unsure", "sentence": sentence}
            return found
    except BadFile as error:
        damaged = str(error)
    return {
        "level": "unsure" if damaged else "none",
        "sentence": damaged or "no reference pictures have been taken",
        "looks": 0, "since": None, "last_look": None, "age_s": None, "reference": None,
    }  # fmt: skip


def _looks(count: int) -> str:
    return f"{count} look" + "s" * (count != 1)


def age_s(time: str, now: datetime) -> float:
    """Return how long ago a time (ISO 8601) was, seconds; less than 0: it is to come."""
    return (now - datetime.fromisoformat(time).astimezone(UTC)).total_seconds()


def _for_long(time: str, now: datetime) -> str:
    """How long ago that was, as ``3 days``."""
    age = age_s(time, now)
    hours = abs(age) / 3600.0
    if hours < 1.0:
        text = f"{60.0 * hours:.0f} min"
    else:
        text = f"{hours:.0f} h" if hours < 48.0 else f"{hours / 24.0:.0f} days"
    return text if age > -90.0 else f"a time {text} ahead of this clock"


def _ago(time: str, now: datetime) -> str:
    text = _for_long(time, now)
    return f"at {text}" if text.startswith("a time") else f"{text} ago"


RENEWED_S = 60.0
"""Sentences say how long ago something was, and are made anew so often."""


class SentinelFindings:
    """What the looks in a folder say, as of a few seconds ago; reading it waits for nothing."""

    def __init__(self, folder: Path, mast_digest: Callable[[], str], thread: JournalThread) -> None:
        self._folder = folder
        self._mast_digest = mast_digest
        self._found: SentinelAnswer | None = None
        self._read: object = None
        thread.poll(self._poll)

    def summary(self) -> SentinelAnswer | None:
        """Return the answer of ``GET /sentinel``, None before the folder was read for the first time."""
        found = self._found
        if found is None or found["last_look"] is None:
            return found
        return {**found, "age_s": max(age_s(found["last_look"], datetime.now(UTC)), 0.0)}

    # In the journals' thread

    def _poll(self) -> None:
        """Read the folder anew whenever a file, the mast file or the minute is another; log changes."""
        marks = []
        for name in (REFERENCE, LOOKS):
            with suppress(OSError):
                about = (self._folder / name).stat()
                marks.append((name, about.st_mtime_ns, about.st_size))
        read = marks, self._mast_digest(), datetime.now(UTC).timestamp() // RENEWED_S
        if read == self._read:
            return
        self._read = read
        before, self._found = self._found, findings(self._folder, read[1])
        bad, was_bad = self._found["level"] == "bad", before is not None and before["level"] == "bad"
        if bad != was_bad:
            log.log(logging.WARNING if bad else logging.INFO, "drift sentinel: %s", self._found["sentence"])
