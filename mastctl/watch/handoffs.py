"""The mast's self-check in service: the record of hand-offs, and what they say together.

Keys of a line of the record: ``schema`` (``mastctl/handoff/1``), ``time`` (ISO 8601, UTC), ``mast_digest``,
``source`` (left and right camera), ``pan_rad``, ``tilt_rad``, ``joint_sigma_rad``, ``left_px``, ``right_px``,
``sigma_px`` (of each coordinate of those), ``to_pan_rad``, ``to_tilt_rad``, and ``destinations``, by camera:
``geometric_px``, ``geometric_covariance_px2`` (of the clicks), ``verdict``, ``reason``, ``found_px`` and
``found_covariance_px2``, the last two null unless the verdict is ``accepted``. Angles are true ones, by the
joints of the mast file that ``mast_digest`` names. The file may hang or be full: a thread of its own reads
and writes it, and nobody waits for that.
"""

from __future__ import annotations

import json
import logging
import threading
from collections import deque
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from calib.errors import BadFile
from calib.files import digest_of, read_bytes
from calib.files.mast_file import CameraName
from calib.files.records import Moment, Number, Pair, Record, Text, problem, read_record
from calib.files.yaml_text import plain
from calib.geometry.handoff import Joints
from calib.matching.handed_over import HandoffBias, Landed, MatchedHandoff, handoff_bias
from calib.matching.handoff import RefinedVerdict
from drivers.clock import Clock, SystemClock
from drivers.recordings.mcap_file import BadRecording, is_mcap, read_messages
from mastctl.as_json import picked
from mastctl.control.standing import StandingFault
from mastctl.json_lines import OtherFile, append_line

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


class HandoffLog:
    """A record that grows; several processes may append to one file.

    Parameters
    ----------
    path
        Made by the first `append`, its folder too.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)

    def append(self, handoff: MatchedHandoff) -> None:
        """Add one hand-off as one line; it is on the disk, whole, when this returns.

        What a crash has left of a line at the end of the file is taken away first.

        Raises
        ------
        BadFile
            If the file cannot be written, or is something else than a record of hand-offs.
        ValueError
            If a number is not finite.
        """
        line = (json.dumps(line_of(handoff), allow_nan=False) + "\n").encode()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            append_line(self.path, line, begins=_BEGIN)
        except OtherFile:
            words = "is no record of hand-offs; a new or another file is expected"
            raise BadFile(self.path, "", words) from None
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be appended to: {error.strerror or error}") from None


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


def bias_told(bias: HandoffBias) -> dict[str, Any]:
    """Return a camera's mean offset as JSON."""
    sigma_px = np.sqrt(np.diag(bias.covariance_px2)).tolist()
    names = ("source", "camera", "handoffs", "left_out", "offset_px", "sigmas", "sentence")
    return picked(bias, *names) | {"sigma_px": sigma_px}


def read_log(path: str | Path) -> ReadLog:
    """Read a record of hand-offs.

    A last line without its end that is no JSON is what a crash left, and is passed over. A recording (MCAP)
    is one too: its topic ``/handoff`` holds the lines.

    Raises
    ------
    BadFile
        If the file cannot be read or a line is no hand-off: which line, which key, what is expected.
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
"""Newest hand-offs that count, and that wait for a file that cannot be written."""
SLOW_S = 5.0  # a file that takes longer than this is a fault
CLOSE_S = 2.0


class HandoffCheck:
    """What hand-offs say of the mast file in use; safe to use from any thread, never waits for a file.

    Parameters
    ----------
    path
        The record, read at the start and appended to; None: only what comes is known.
    digest
        Of the mast file in use.
    clock
        Dates the faults.
    file_time
        What the file's slowness is measured by; the machine's own clock by default: a file is real, also
        beside a simulation whose time goes by faster.
    """

    def __init__(self, path: Path | None, digest: str, clock: Clock, file_time: Clock | None = None) -> None:
        self._path = path
        self._clock = clock
        self._file_time = file_time or SystemClock()
        self._lock = threading.Lock()
        self._handoffs: deque[MatchedHandoff] = deque(maxlen=KEPT)
        self._digest = digest
        self._judged: tuple[int, tuple[HandoffBias, ...]] = (0, ())  # how many count, what stands out
        self._unread: StandingFault | None = None
        self._unwritten: StandingFault | None = None
        # Since when the file has not answered: by the clock, and by the file's time.
        self._asked_s: tuple[float, float] | None = None
        self._queue: SimpleQueue[MatchedHandoff | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._work, name=NAME, daemon=True)
        if path is not None:
            self._thread.start()

    def add(self, handoff: MatchedHandoff) -> None:
        """Count a hand-off, and have it written down."""
        with self._lock:
            self._handoffs.append(handoff)
            news = self._judge()
        _log_news(news)
        if self._path is not None:
            self._queue.put(handoff)

    def use_mast(self, digest: str) -> None:
        """Count only the hand-offs of this mast file from now on."""
        with self._lock:
            self._digest = digest
            news = self._judge()
        _log_news(news)

    def told(self) -> dict[str, Any]:
        """Return how many hand-offs of the mast file count, and the offsets that stand out, as JSON."""
        counted, offsets = self._judged
        return {"handoffs": counted, "offsets": [bias_told(one) for one in offsets]}

    def faults(self) -> tuple[StandingFault, ...]:
        """Return what is wrong with the record's file."""
        faults = [one for one in (self._unread, self._unwritten) if one is not None]
        asked_s = self._asked_s
        if asked_s is not None and self._file_time.now_s() - asked_s[1] > SLOW_S:
            faults.append(
                StandingFault(
                    NAME,
                    "slow",
                    f"{self._path} does not answer; hand-offs wait for it",
                    asked_s[0],
                    "the file answers",
                )
            )
        return tuple(faults)

    def close(self) -> None:
        """Write down what waits; bounded."""
        if self._path is None:
            return
        self._queue.put(None)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.error("%s does not answer; the newest hand-offs are not written down", self._path)

    def _judge(self) -> list[HandoffBias]:
        """Sum up anew and return what stands out newly; the lock is held, so nothing is logged here."""
        those = [one for one in self._handoffs if one.mast_digest == self._digest]
        known = {(one.source, one.camera) for one in self._judged[1]}
        offsets = tuple(one for one in handoff_bias(those) if one.significant)
        self._judged = sum(bool(one.found) for one in those), offsets
        return [one for one in offsets if (one.source, one.camera) not in known]

    # In the file's thread

    def _work(self) -> None:
        assert self._path is not None
        self._read(self._path)
        writer = HandoffLog(self._path)
        waiting: deque[MatchedHandoff] = deque(maxlen=KEPT)
        while True:
            handoff = self._queue.get()
            if handoff is not None:
                waiting.append(handoff)
            self._write(writer, waiting)
            if handoff is None:
                return

    def _read(self, path: Path) -> None:
        self._ask()
        try:
            before = read_log(path).handoffs if path.is_file() else ()
        except (BadFile, OSError) as error:
            words = f"{' '.join(str(error).split())}; earlier records do not count"
            with self._lock:
                self._unread = StandingFault(
                    NAME, "unreadable", words, self._clock.now_s(), "the file is right at the next start"
                )
            log.error("%s", words)
            before = ()
        with self._lock:
            self._handoffs = deque((*before, *self._handoffs), maxlen=KEPT)
            news = self._judge()
        _log_news(news)
        self._answered()

    def _write(self, writer: HandoffLog, waiting: deque[MatchedHandoff]) -> None:
        """Write down what waits, oldest first, as far as it goes."""
        words = ""
        self._ask()
        while waiting and not words:
            try:
                writer.append(waiting[0])
                waiting.popleft()
            except BadFile as error:
                words = f"{' '.join(str(error).split())}; hand-offs count, and wait to be written down"
            except ValueError as error:
                log.error("a hand-off cannot be written down: %s", error)
                waiting.popleft()
        self._answered()
        with self._lock:
            before = self._unwritten
            since_s = self._clock.now_s() if before is None else before.since_s
            self._unwritten = (
                StandingFault(NAME, "unwritable", words, since_s, "a hand-off is written down")
                if words
                else None
            )
        if words and before is None:
            log.error("%s", words)

    def _ask(self) -> None:
        with self._lock:
            self._asked_s = self._clock.now_s(), self._file_time.now_s()

    def _answered(self) -> None:
        with self._lock:
            self._asked_s = None


def _log_news(news: list[HandoffBias]) -> None:
    for one in news:
        log.warning("hand-offs show an offset: %s", one.sentence)
