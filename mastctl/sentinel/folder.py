"""What a sentinel keeps: its reference pictures, a line for each look, and what the looks say together."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.errors import BadFile
from calib.files import read_bytes
from calib.files.strict import Section
from calib.pictures.warp import Grey, grey
from calib.scene.drift import Drift

SCHEMA = "mastctl/sentinel/1"
REFERENCE, LOOKS = "reference.json", "looks.jsonl"
MOST_BYTES = 4_000_000
CONFIRMED = 2
"""So many looks one after the other must name the same change before it is told."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A camera's picture at a rest: true joint angles, and the mast file that they follow from."""

    camera: str
    pose: int
    pan_rad: float
    tilt_rad: float
    mast_digest: str
    image: Grey


@dataclass(frozen=True)
class Reference:
    """A folder's reference: when it was taken, with which mast file, at which rests; its pictures."""

    time: str
    mast_digest: str
    rests: tuple[tuple[float, float], ...]
    pictures: tuple[Mapping[str, Any], ...]
    folder: Path

    def picture(self, camera: str, pose: int) -> Picture | None:
        """Return a picture, None if the reference has none of this camera there. Raises BadFile."""
        for told in self.pictures:
            if told["camera"] == camera and told["pose"] == pose:
                path = self.folder / told["file"]
                data = np.frombuffer(read_bytes(path, 1 << 28), np.uint8)
                image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
                if image is None:
                    raise BadFile(path, "", "is no picture that can be read; take the reference again")
                return Picture(camera, pose, told["pan_rad"], told["tilt_rad"], self.mast_digest, grey(image))
        return None


@dataclass(frozen=True)
class Standing:
    """What the looks say together.

    level
        ``good``, ``bad`` for a change that two looks name alike, ``unsure`` for none, one, or silent ones.
    sentence
        For a person.
    """

    level: str
    sentence: str
    looks: int
    since: str | None


def save_reference(
    folder: Path, time: str, rests: Sequence[tuple[float, float]], pictures: Sequence[Picture]
) -> Reference:
    """Save reference pictures in place of any before, and forget the looks at those.

    A reference counts from its ``reference.json`` on, which is written last.

    Raises
    ------
    BadFile
        If the file system refuses.
    """
    told = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stamp = "".join(c for c in time if c.isdigit())
        inner = folder / f"pictures-{stamp}"
        inner.mkdir(exist_ok=True)
        for one in pictures:
            name = f"{inner.name}/{one.pose}-{one.camera}.png"
            if not cv2.imwrite(str(folder / name), np.clip(np.rint(one.image), 0, 255).astype(np.uint8)):
                raise OSError(None, "the picture cannot be written")
            told.append(
                {
                    "camera": one.camera, "pose": one.pose, "pan_rad": one.pan_rad, "tilt_rad": one.tilt_rad,
                    "file": name,
                }
            )  # fmt: skip
        document = {
            "schema": SCHEMA, "time": time, "mast_digest": pictures[0].mast_digest,
            "rests": [list(rest) for rest in rests], "pictures": told,
        }  # fmt: skip
        (folder / LOOKS).unlink(missing_ok=True)
        new = folder / (REFERENCE + ".new")
        new.write_text(json.dumps(document, indent=1))
        new.replace(folder / REFERENCE)
        for old in folder.glob("pictures-*"):
            if old != inner:
                shutil.rmtree(old)
    except OSError as error:
        raise BadFile(folder, "", f"cannot be written: {error.strerror or error}") from None
    return read_reference(folder)


def read_reference(folder: Path) -> Reference:
    """Read a folder's reference.

    Raises
    ------
    BadFile
        If there is none, or it is damaged.
    """
    path = folder / REFERENCE
    if not path.is_file():
        raise BadFile(folder, "", "holds no reference; take one: mastctl sentinel reference")
    try:
        document = json.loads(read_bytes(path, MOST_BYTES))
    except ValueError:
        raise BadFile(path, "", "is no JSON; take the reference again") from None
    top = Section(path, "", document, ("schema", "time", "mast_digest", "rests", "pictures"))
    top.choice("schema", (SCHEMA,))
    rests, pictures = [], []
    for key, kind in (("rests", list), ("pictures", list)):
        if not isinstance(top.values[key], kind):
            raise top.bad(key, "a list is expected; take the reference again")
    for at, rest in enumerate(top.values["rests"]):
        pair = Section(path, "", {f"rests[{at}]": rest}, (f"rests[{at}]",)).vector(f"rests[{at}]", 100.0, 2)
        rests.append((float(pair[0]), float(pair[1])))
    for at, one in enumerate(top.values["pictures"]):
        told = Section(path, f"pictures[{at}]", one, ("camera", "pose", "pan_rad", "tilt_rad", "file"))
        pictures.append(
            {
                "camera": told.text("camera"),
                "pose": told.integer("pose", 0, len(rests) - 1),
                "pan_rad": told.number("pan_rad", 100.0),
                "tilt_rad": told.number("tilt_rad", 100.0),
                "file": told.text("file"),
            }
        )
    return Reference(top.text("time"), top.text("mast_digest"), tuple(rests), tuple(pictures), folder)


def add_look(folder: Path, time: str, drift: Drift) -> dict[str, Any]:
    """Append what a look found, and return it. Raises BadFile."""
    named = drift.named
    line = {
        "time": time,
        "views": drift.views,
        "silent": list(drift.silent),
        "named": None if named is None else named.what,
        "sentence": drift.sentence,
        "instead": list(drift.instead),
        "sigmas": None if named is None else named.sigmas,
        "values": None if named is None else named.values.tolist(),
        "likeliest": [[change.what, change.sigmas] for change in drift.changes[:3]],
    }
    try:
        with (folder / LOOKS).open("a") as file:
            file.write(json.dumps(line) + "\n")
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise BadFile(folder / LOOKS, "", f"cannot be written: {error.strerror or error}") from None
    return line


def read_looks(folder: Path) -> list[dict[str, Any]]:
    """Return the looks, oldest first; lines that were cut or spoiled are left out."""
    looks = []
    try:
        text = (folder / LOOKS).read_text(errors="replace")
    except OSError:
        return []
    for row in text.splitlines():
        try:
            told = json.loads(row)
        except ValueError:
            continue
        if isinstance(told, dict) and isinstance(told.get("time"), str) and "named" in told:
            looks.append(told)
    return looks


def standing(looks: Sequence[Mapping[str, Any]], now: datetime) -> Standing:
    """Return what the looks say together; ``now`` for how long ago."""
    telling = [look for look in looks if look.get("views")]
    if not telling:
        words = (
            "no look yet"
            if not looks
            else f"{len(looks)} looks saw nothing they knew: night, fog, another place?"
        )
        return Standing("unsure", words, len(looks), None)
    last = telling[-1]
    if not last["named"]:
        words = f"nothing has changed ({len(telling)} looks, the last {_ago(last['time'], now)} ago)"
        return Standing("good", words, len(looks), None)
    first = last
    alike = 0
    for look in reversed(telling):
        if look["named"] != last["named"]:
            break
        first, alike = look, alike + 1
    if alike < CONFIRMED:
        return Standing("unsure", f"{last['sentence']}, seen once: look again", len(looks), first["time"])
    return Standing("bad", f"{last['sentence']}, since {_ago(first['time'], now)}", len(looks), first["time"])


def findings(folder: Path, mast_digest: str) -> dict[str, Any]:
    """Return what a folder says, as ``GET /sentinel`` tells it; ``mast_digest``: of the mast file in use."""
    now = datetime.now(UTC)
    found: dict[str, Any] = {
        "level": "none", "sentence": "no reference pictures have been taken", "looks": 0, "since": None,
        "last_look": None, "age_s": None, "reference": None,
    }  # fmt: skip
    if not (folder / REFERENCE).is_file():
        return found
    try:
        reference, looks = read_reference(folder), read_looks(folder)
        says = standing(looks, now)
    except BadFile as error:
        return {**found, "level": "unsure", "sentence": str(error)}
    except (KeyError, TypeError):
        return {**found, "level": "unsure", "sentence": f"{folder / LOOKS} holds lines that are no looks"}
    level, sentence = says.level, says.sentence
    if reference.mast_digest != mast_digest:
        level, sentence = "unsure", f"the reference is of another mast file: take a new one ({sentence})"
    last = looks[-1]["time"] if looks else None
    return {
        "level": level, "sentence": sentence, "looks": says.looks, "since": says.since, "last_look": last,
        "age_s": None if last is None else _age_s(last, now), "reference": reference.time,
    }  # fmt: skip


def _age_s(time: str, now: datetime) -> float | None:
    try:
        return max((now - datetime.fromisoformat(time)).total_seconds(), 0.0)
    except (ValueError, TypeError):
        return None


def _ago(time: str, now: datetime) -> str:
    """How long ago in words."""
    age_s = _age_s(time, now)
    if age_s is None:
        return "an unknown time"
    hours = age_s / 3600.0
    if hours < 1.0:
        return f"{60.0 * hours:.0f} min"
    return f"{hours:.0f} h" if hours < 48.0 else f"{hours / 24.0:.0f} days"
