"""The mast's self-check in service: the log of hand-offs, and their mean offsets.

Keys of a line of the log: ``schema`` (``mastctl/handoff/1``), ``time`` (ISO 8601, UTC), ``mast_digest``,
``source`` (left and right camera), ``pan_rad``, ``tilt_rad``, ``joint_sigma_rad``, ``left_px``, ``right_px``,
``sigma_px`` (of each coordinate of those), ``to_pan_rad``, ``to_tilt_rad``, and ``destinations``, by camera:
``geometric_px``, ``geometric_covariance_px2`` (of the clicks), ``verdict``, ``reason``, ``found_px`` and
``found_covariance_px2``, the last two null unless the verdict is ``accepted``. Angles are true ones, by the
joints of the mast file that ``mast_digest`` names.
"""

from __future__ import annotations

import json
import logging
import threading
from collections import deque
from collections.abc import Callable
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
from calib.matching.handoff import HandoffBias, Landed, MatchedHandoff, RefinedVerdict, handoff_bias
from drivers.clock import Clock
from drivers.recordings.mcap_file import BadRecording, is_mcap, read_messages
from mastctl.answers import OffsetAnswer, SelfCheck
from mastctl.control.machine import StandingFault
from mastctl.watch.journal import Journal, JournalThread

log = logging.getLogger(__name__)

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
    """Where a hand-off landed in a camera; what was found where it was accepted."""

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
    """A line of a record of hand-offs."""

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


def handoff_log(path: Path) -> Journal[MatchedHandoff]:
    """Return the log of hand-offs at a path."""
    return Journal(path, "hand-offs", line_of, lambda value: handoff_of(path, 0, value), _BEGIN)


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


def bias_record(bias: HandoffBias) -> OffsetAnswer:
    """Return a camera's mean offset as JSON."""
    return {
        "source": bias.source,
        "camera": bias.camera,
        "handoffs": bias.handoffs,
        "left_out": bias.left_out,
        "offset_px": bias.offset_px.tolist(),
        "sigma_px": np.sqrt(np.diag(bias.covariance_px2)).tolist(),
        "sigmas": bias.sigmas,
        "sentence": bias.sentence,
    }


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
        return b"".join(entry.message.data + b"\n" for entry in read_messages(path, (TOPIC,)))
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


NAME = "handoff_log"
KEPT = 2000
"""Newest hand-offs that count."""


class HandoffCheck:
    """The offsets that hand-offs show with the mast file in use; safe from any thread, waits for no file.

    The log at ``path`` is read at the start and appended to; None: earlier hand-offs are not known.
    """

    def __init__(self, path: Path | None, digest: str, clock: Clock, thread: JournalThread) -> None:
        self._journal = None if path is None else handoff_log(path)
        self._clock = clock
        self._thread = thread
        self._lock = threading.Lock()
        self._handoffs: deque[MatchedHandoff] = deque(maxlen=KEPT)
        self._digest = digest
        self._judged: tuple[int, tuple[HandoffBias, ...]] = (0, ())  # how many count, the offsets
        self._fault: StandingFault | None = None
        if self._journal is not None:
            thread.put(self._read)

    def add(self, handoff: MatchedHandoff) -> None:
        """Count a hand-off, and have it logged."""
        self._judge(lambda: self._handoffs.append(handoff))
        if self._journal is not None:
            self._thread.put(lambda: self._write(handoff))

    def use_mast(self, digest: str) -> None:
        """Count only the hand-offs of this mast file from now on."""
        self._digest = digest
        self._judge(lambda: None)

    def summary(self) -> SelfCheck:
        """Return how many hand-offs of the mast file count, and the significant offsets."""
        counted, offsets = self._judged
        return {"handoffs": counted, "offsets": [bias_record(one) for one in offsets]}

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with the log's file."""
        fault = self._fault
        return () if fault is None else (fault,)

    def _judge(self, change: Callable[[], None]) -> None:
        """Change the hand-offs, find their offsets anew, and log those that are new."""
        with self._lock:
            change()
            those = [one for one in self._handoffs if one.mast_digest == self._digest]
            known = {(one.source, one.camera) for one in self._judged[1]}
            offsets = tuple(one for one in handoff_bias(those) if one.significant)
            self._judged = sum(bool(one.found) for one in those), offsets
        for one in offsets:
            if (one.source, one.camera) not in known:
                log.warning("hand-offs show an offset: %s", one.sentence)

    # In the journals' thread

    def _read(self) -> None:
        assert self._journal is not None
        earlier = self._journal.earlier()

        def join() -> None:
            self._handoffs = deque((*earlier, *self._handoffs), maxlen=KEPT)

        self._judge(join)

    def _write(self, handoff: MatchedHandoff) -> None:
        assert self._journal is not None
        self._journal.keep(handoff)
        reason, since_s = self._journal.unwritten, self._fault.since_s if self._fault else self._clock.now_s()
        self._fault = (
            StandingFault(NAME, "unwritable", reason, since_s, "a hand-off is logged") if reason else None
        )
