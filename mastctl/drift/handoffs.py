"""The log of hand-offs, from which body cameras are corrected; angles are true ones, by ``mast_digest``."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from calib.errors import BadFile
from calib.files import digest_of, read_bytes
from calib.files.mast_file import CameraName
from calib.files.records import Moment, Number, Pair, Record, Text, problem, read_record
from calib.files.yaml_text import plain
from calib.geometry.handoff import Joints
from calib.matching.handoff import Landed, MatchedHandoff, RefinedVerdict
from drivers.recordings.mcap_file import BadRecording, McapEntry, is_mcap, read_items
from mastctl.drift.journal import Journal

SCHEMA = "mastctl/handoff/1"
TOPIC = "/handoff"
"""Of a recording."""

MAX_BYTES = 1 << 28
_BEGIN = f'{{"schema": "{SCHEMA}"'.encode()
LARGEST_PX = 1e6


def _covariance(rows: list[list[float]]) -> list[list[float]]:
    if not np.allclose(rows, np.transpose(rows)) or np.linalg.eigvalsh(rows)[0] < 0.0:
        raise problem("", "no covariance: it must be symmetric, with no variance below zero")
    return rows


_Pixel = Annotated[
    list[Annotated[float, Field(ge=-LARGEST_PX, le=LARGEST_PX)]], Field(min_length=2, max_length=2)
]
Covariance = Annotated[list[Pair], Field(min_length=2, max_length=2), AfterValidator(_covariance)]


class LandedRecord(Record):
    """Where clicks put a target in a camera, with their covariance; where it was found, if accepted."""

    geometric_px: _Pixel
    geometric_covariance_px2: Covariance
    verdict: RefinedVerdict
    reason: str
    found_px: _Pixel | None
    found_covariance_px2: Covariance | None

    @model_validator(mode="after")
    def _was_found_where_accepted(self) -> LandedRecord:
        for key in ("found_px", "found_covariance_px2"):
            if self.verdict == "accepted" and getattr(self, key) is None:
                raise problem(key, "nothing where an accepted hand-off has 2 numbers a row")
        return self

    @property
    def landed(self) -> Landed:
        """The landing in arrays."""
        good = self.verdict == "accepted"
        found = (np.array(self.found_px), np.array(self.found_covariance_px2)) if good else (None, None)
        geometric = np.array(self.geometric_px), np.array(self.geometric_covariance_px2)
        return Landed(*geometric, self.verdict, self.reason, *found)


class HandoffRecord(Record):
    """A line: a hand-off from the cameras ``source``, ``sigma_px`` of each coordinate of the clicks."""

    schema_: Literal["mastctl/handoff/1"] = Field(alias="schema")
    time: Moment
    mast_digest: Text
    source: Annotated[list[CameraName], Field(min_length=2, max_length=2)]
    pan_rad: Number
    tilt_rad: Number
    joint_sigma_rad: Annotated[float, Field(ge=0.0, le=1e9)]
    left_px: _Pixel
    right_px: _Pixel
    sigma_px: Annotated[float, Field(gt=0.0, le=1e9)]
    to_pan_rad: Number
    to_tilt_rad: Number
    destinations: dict[CameraName, LandedRecord]


@dataclass(frozen=True, eq=False)
class ReadLog:
    """A record of hand-offs: its path, the digest of its bytes, and what it holds, in the file's order."""

    path: Path
    digest: str
    handoffs: tuple[MatchedHandoff, ...]


def handoff_log(path: Path) -> Journal[dict[str, Any]]:
    """Return the log of hand-offs at a path; its records are those of `line_of`."""
    return Journal(path, "hand-offs", dict, _BEGIN)


def line_of(handoff: MatchedHandoff) -> dict[str, Any]:
    """Return the keys of a hand-off's line."""
    joints, to_joints = handoff.joints, handoff.to_joints
    document = {
        "schema": SCHEMA,
        "time": handoff.time,
        "mast_digest": handoff.mast_digest,
        "source": handoff.pair,
        "pan_rad": joints.pan_rad,
        "tilt_rad": joints.tilt_rad,
        "joint_sigma_rad": joints.sigma_rad,
        "left_px": handoff.clicks_px[0],
        "right_px": handoff.clicks_px[1],
        "sigma_px": handoff.sigma_px,
        "to_pan_rad": to_joints.pan_rad,
        "to_tilt_rad": to_joints.tilt_rad,
        "destinations": {name: vars(one) for name, one in handoff.landed.items()},
    }
    return dict(plain(document))


def read_log(path: str | Path) -> ReadLog:
    """Read a record of hand-offs.

    A last line without its end that is no JSON is what a crash left, and is passed over. A recording (MCAP)
    is one too: its topic ``/handoff`` holds the lines. Raises BadFile with line and key.
    """
    data = _lines_recorded(Path(path)) if is_mcap(Path(path)) else read_bytes(path, MAX_BYTES)
    lines = data.split(b"\n")
    handoffs = []
    for number, line in enumerate(lines, start=1):
        if not line.strip():
            continue
        try:
            value = json.loads(line)
        except (ValueError, RecursionError) as error:
            if number == len(lines):
                break
            raise BadFile(path, f"line {number}", f"is no JSON: {error}") from None
        handoffs.append(handoff_of(path, number, value))
    return ReadLog(Path(path), digest_of(data), tuple(handoffs))


def _lines_recorded(path: Path) -> bytes:
    """The hand-offs of a recording as lines. Raises BadFile."""
    try:
        entries = (item for item in read_items(path) if isinstance(item, McapEntry))
        return b"".join(one.message.data + b"\n" for one in entries if one.channel.topic == TOPIC)
    except BadRecording as error:
        raise BadFile(path, "", str(error)) from None


def handoff_of(path: str | Path, number: int, value: Any) -> MatchedHandoff:
    """Return the hand-off of one line. Raises BadFile."""
    line = read_record(HandoffRecord, value, path, f"line {number}")
    return MatchedHandoff(
        time=line.time,
        mast_digest=line.mast_digest,
        pair=(line.source[0], line.source[1]),
        joints=Joints(line.pan_rad, line.tilt_rad, line.joint_sigma_rad),
        clicks_px=np.array([line.left_px, line.right_px]),
        sigma_px=line.sigma_px,
        to_joints=Joints(line.to_pan_rad, line.to_tilt_rad, line.joint_sigma_rad),
        landed={name: one.landed for name, one in line.destinations.items()},
        name=f"hand-off of {line.time} ({Path(path).name} line {number})",
    )
