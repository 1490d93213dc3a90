"""The record of hand-offs: a text file, one JSON object a line, appended to by whoever hands over.

Keys of a line: ``schema`` (``mastctl/handoff/1``), ``time`` (ISO 8601, UTC), ``mast_digest``, ``source``
(left and right camera), ``pan_rad``, ``tilt_rad``, ``joint_sigma_rad``, ``left_px``, ``right_px``,
``sigma_px`` (of each coordinate of those), ``to_pan_rad``, ``to_tilt_rad``, and ``destinations``, by camera:
``geometric_px``, ``geometric_covariance_px2`` (of the clicks), ``verdict``, ``reason``, ``found_px`` and
``found_covariance_px2``, the last two null unless the verdict is ``accepted``. Angles are true ones, by the
joints of the mast file that ``mast_digest`` names.
"""

from __future__ import annotations

import fcntl
import json
import os
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from calib.errors import BadFile
from calib.files import digest_of, read_bytes
from calib.files.mast_file import CAMERA_NAME, CAMERA_NAME_WORDS
from calib.files.yaml_text import Section, kind_of
from calib.geometry.handoff import Joints
from calib.matching.handed_over import HandoffBias, Landed, MatchedHandoff
from calib.matching.handoff import RefinedVerdict
from drivers.recordings.mcap_file import BadRecording, is_mcap, read_messages
from mastctl.as_json import picked

SCHEMA = "mastctl/handoff/1"
TOPIC = "/handoff"
"""Of a recording."""

MAX_BYTES = 1 << 28
LONGEST_LINE = 1 << 16
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
            with self.path.open("a+b") as file:
                fcntl.flock(file, fcntl.LOCK_EX)  # released when the file is closed
                file.write(self._mended(file.fileno()) + line)
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise BadFile(self.path, "", f"cannot be appended to: {error.strerror or error}") from None

    def _mended(self, descriptor: int) -> bytes:
        """Take a torn last line away; return the line end that a whole one lacks."""
        end = os.fstat(descriptor).st_size
        start = max(0, end - LONGEST_LINE)
        tail = os.pread(descriptor, end - start, start)
        last = tail[tail.rfind(b"\n") + 1 :]
        head = os.pread(descriptor, len(_BEGIN), 0)
        if not _BEGIN.startswith(head) or len(last) == LONGEST_LINE:
            raise BadFile(self.path, "", "is no record of hand-offs; a new or another file is expected")
        if not last:
            return b""
        try:
            json.loads(last)
        except ValueError:
            os.ftruncate(descriptor, end - len(last))
            return b""
        return b"\n"


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
