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
from datetime import datetime
from pathlib import Path
from queue import SimpleQueue
from typing import Any, cast, get_args

import numpy as np

from calib.errors import BadFile
from calib.files import digest_of, read_bytes
from calib.files.mast_file import CAMERA_NAME, CAMERA_NAME_WORDS
from calib.files.yaml_text import Section, kind_of
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
_KEYS = (
    "schema", "time", "mast_digest", "source", "pan_rad", "tilt_rad", "joint_sigma_rad", "left_px",
    "right_px", "sigma_px", "to_pan_rad", "to_tilt_rad", "destinations",
)  # fmt: skip
_LANDED_KEYS = (
    "geometric_px", "geometric_covariance_px2", "verdict", "reason", "found_px", "found_covariance_px2",
)  # fmt: skip


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
    return {
        "schema": SCHEMA,
        "time": handoff.time,
        "mast_digest": handoff.mast_digest,
        "source": list(handoff.pair),
        "pan_rad": handoff.joints.pan_rad,
        "tilt_rad": handoff.joints.tilt_rad,
        "joint_sigma_rad": handoff.joints.sigma_rad,
        "left_px": handoff.clicks_px[0].tolist(),
        "right_px": handoff.clicks_px[1].tolist(),
        "sigma_px": handoff.sigma_px,
        "to_pan_rad": handoff.to_joints.pan_rad,
        "to_tilt_rad": handoff.to_joints.tilt_rad,
        "destinations": {
            name: {
                "geometric_px": one.geometric_px.tolist(),
                "geometric_covariance_px2": one.geometric_covariance_px2.tolist(),
                "verdict": one.verdict,
                "reason": one.reason,
                "found_px": None if one.found_px is None else one.found_px.tolist(),
                "found_covariance_px2": (
                    None if one.found_covariance_px2 is None else one.found_covariance_px2.tolist()
                ),
            }
            for name, one in handoff.landed.items()
        },
    }


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
    """Return the hand-off that one line tells. Raises BadFile."""
    line = Section(path, f"line {number}", value, _KEYS)
    line.choice("schema", (SCHEMA,))
    time = line.text("time")
    try:
        datetime.fromisoformat(time)
    except ValueError:
        raise line.bad("time", f"'{time}' where an ISO 8601 time is expected") from None
    source = value["source"]
    if not isinstance(source, list) or len(source) != 2 or not all(isinstance(n, str) for n in source):
        raise line.bad("source", f"{kind_of(source)} where [left camera, right camera] is expected")
    if not all(CAMERA_NAME.fullmatch(name) for name in source):
        raise line.bad("source", CAMERA_NAME_WORDS)
    sigma_px, sigma_rad = line.number("sigma_px"), line.number("joint_sigma_rad")
    if sigma_px <= 0.0:
        raise line.bad("sigma_px", f"{sigma_px:g} where a number above zero is expected")
    if sigma_rad < 0.0:
        raise line.bad("joint_sigma_rad", f"{sigma_rad:g} where zero or more is expected")
    return MatchedHandoff(
        time=time,
        mast_digest=line.text("mast_digest"),
        pair=(source[0], source[1]),
        joints=Joints(line.number("pan_rad"), line.number("tilt_rad"), sigma_rad),
        clicks_px=np.array([line.vector(key, LARGEST_PX, 2) for key in ("left_px", "right_px")]),
        sigma_px=sigma_px,
        to_joints=Joints(line.number("to_pan_rad"), line.number("to_tilt_rad"), sigma_rad),
        landed=_landed(line),
        name=f"hand-off of {time} ({Path(path).name} line {number})",
    )


def _landed(line: Section) -> dict[str, Landed]:
    """Read a line's destinations."""
    landed = {}
    for name, value in line.mapping("destinations").items():
        key = f"destinations.{name}"
        if not CAMERA_NAME.fullmatch(name):
            raise line.bad(key, CAMERA_NAME_WORDS)
        one = Section(line.path, line.at(key), value, _LANDED_KEYS)
        verdict = cast(RefinedVerdict, one.choice("verdict", get_args(RefinedVerdict)))
        if not isinstance(value["reason"], str):
            raise one.bad("reason", f"{kind_of(value['reason'])} where text is expected")
        good = verdict == "accepted"
        landed[name] = Landed(
            one.vector("geometric_px", LARGEST_PX, 2),
            one.covariance("geometric_covariance_px2", 2),
            verdict,
            value["reason"],
            one.vector("found_px", LARGEST_PX, 2) if good else None,
            one.covariance("found_covariance_px2", 2) if good else None,
        )
    return landed


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
