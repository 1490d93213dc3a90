"""What is known of a run: made of the lines that it tells, each judged before it is believed.

A line that is none of `mastctl.bench.lines` changes nothing but a count.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, cast

from mastctl.answers import MOST_CELLS, BenchRunTold, BenchState, BenchStep
from mastctl.errors import one_line

MOST_SENTENCES, LONGEST_SENTENCE = 40, 400
MOST_ON_CURVE = 600
MOST_CAMERAS = 16


class Odd(ValueError):
    """A line that tells nothing that could be believed."""


@dataclass(frozen=True)
class Asked:
    """Where a board is asked for.

    Attributes
    ----------
    name
        Of the placement.
    range_m, bearing_deg, height_deg, turned_deg
        As of `calib.plan.placements.Placement`.
    words
        The same for a person.
    waits
        Whether somebody has to say that it stands.
    """

    name: str
    range_m: float
    bearing_deg: float
    height_deg: float
    turned_deg: tuple[float, float]
    words: str
    waits: bool


@dataclass(frozen=True)
class Camera:
    """A camera's picture size, and how many corners were seen in each cell of it (8 a row, 6 rows)."""

    size_px: tuple[int, int]
    cells: tuple[int, ...] = (0,) * MOST_CELLS


@dataclass(frozen=True)
class Run:
    """One run as far as it is known; replaced, never edited.

    Attributes
    ----------
    name, begun, by
        Its folder's, when (ISO 8601, UTC), and who began it.
    state, step
        What it is, and what it does.
    code, sentence
        How it ended; empty before.
    simulated
        Whether the rover is; None before it is known.
    board_m
        Width and height of the board.
    asked, placements
        The newest placement, and how many there were since the run began or went on.
    pictures, most
        Of the camera with most.
    predicted_px, target_px, floor_px, expected_px
        What the calibration would leave of a first pointing now, may leave, what counts leave; and what it
        would leave with the next picture.
    next_rad
        The attitude that tells most now: pan and tilt.
    curve
        Pictures and what was predicted with them.
    sentences
        The newest.
    odd
        Lines that could not be understood.
    result
        The end's figures.
    mast_file, report
        The mast file that it has made, and its report's name; None before.
    """

    name: str
    begun: str
    by: str
    state: BenchState = "running"
    step: BenchStep = "begin"
    code: str | None = None
    sentence: str = ""
    simulated: bool | None = None
    by_hand: bool = False
    wanted_px: float = 0.2
    board_m: tuple[float, float] | None = None
    asked: Asked | None = None
    placements: int = 0
    pictures: int = 0
    most: int = 0
    predicted_px: float | None = None
    target_px: float | None = None
    floor_px: float | None = None
    expected_px: float | None = None
    next_rad: tuple[float, float] | None = None
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    curve: tuple[tuple[int, float], ...] = ()
    sentences: tuple[str, ...] = ()
    odd: int = 0
    result: Mapping[str, Any] | None = None
    mast_file: str | None = None
    report: str | None = None

    @property
    def over(self) -> bool:
        """Whether nothing more will come of it."""
        return self.state in ("done", "interrupted")

    def told(self) -> BenchRunTold:
        """Return it as JSON."""
        return cast(BenchRunTold, asdict(self))


def heard(run: Run, line: bytes) -> Run:
    """Return what is known of a run after one more line."""
    try:
        event = json.loads(line)
        if not isinstance(event, dict):
            raise Odd
        return _READ[event.get("event", "")](run, event)
    except (ValueError, KeyError, TypeError, RecursionError, OverflowError):
        return replace(run, odd=run.odd + 1)


def ended(run: Run, state: BenchState, code: str | None, sentence: str) -> Run:
    """Return a run that is over; one that is over already stays as it is."""
    if run.over:
        return run
    said = _saying(run, sentence) if sentence else run
    return replace(said, state=state, step="over", code=code, sentence=sentence)


def _saying(run: Run, sentence: str) -> Run:
    return replace(run, sentences=(*run.sentences, _words(sentence))[-MOST_SENTENCES:])


def _begun(run: Run, event: Mapping[str, Any]) -> Run:
    cameras = {}
    for name, size in list(dict(event["cameras"]).items())[:MOST_CAMERAS]:
        width, height = size
        cameras[_words(name)] = Camera((_count(width), _count(height)))
    width_m, height_m = event["board_m"]
    return replace(
        run,
        simulated=bool(event["simulated"]),
        board_m=(_number(width_m), _number(height_m)),
        cameras=cameras,
    )


def _said(run: Run, event: Mapping[str, Any]) -> Run:
    return _saying(run, event["sentence"])


def _step(run: Run, event: Mapping[str, Any]) -> Run:
    step = event["step"]
    if step not in ("search", "pictures", "check", "fit"):
        raise Odd
    return replace(run, step=step, state="running")


def _place(run: Run, event: Mapping[str, Any]) -> Run:
    right, up = event["turned_deg"]
    asked = Asked(
        _words(event["name"]),
        _number(event["range_m"]),
        _number(event["bearing_deg"]),
        _number(event["height_deg"]),
        (_number(right), _number(up)),
        _words(event["words"]),
        bool(event["waits"]),
    )
    state: BenchState = "asking" if asked.waits else "running"
    return replace(run, asked=asked, placements=run.placements + 1, step="place", state=state)


def _stands(run: Run, event: Mapping[str, Any]) -> Run:
    return replace(run, state="running", step="search")


def _progress(run: Run, event: Mapping[str, Any]) -> Run:
    pictures, predicted_px = _count(event["pictures"]), _maybe(event["predicted_px"])
    curve = run.curve
    if predicted_px is not None:
        curve = (*(one for one in curve if one[0] < pictures), (pictures, predicted_px))[-MOST_ON_CURVE:]
    cameras = dict(run.cameras)
    for name, counts in dict(event["cells"]).items():
        known = cameras.get(name)
        if known is None or len(counts) != MOST_CELLS:
            raise Odd
        cameras[name] = Camera(known.size_px, tuple(_count(one) for one in counts))
    pan, tilt = event["next_rad"]
    return replace(
        run,
        state="running",
        step="pictures",
        pictures=pictures,
        most=_count(event["most"]),
        predicted_px=predicted_px,
        target_px=_maybe(event["target_px"]),
        floor_px=_maybe(event["floor_px"]),
        expected_px=_maybe(event["expected_px"]),
        next_rad=(_number(pan), _number(tilt)),
        curve=curve,
        cameras=cameras,
    )


def _done(run: Run, event: Mapping[str, Any]) -> Run:
    told = event["result"]
    verdict = told["verdict"]
    check = told.get("check") or {}
    reasons = [
        {"grade": _words(one["grade"]), "sentence": _words(one["sentence"])} for one in verdict["reasons"]
    ]
    words = _words(verdict["words"])
    result = {
        "verdict": {"grade": _words(verdict["grade"]), "words": words, "reasons": reasons},
        "cameras": [
            {
                "camera": _words(name),
                "rms_px": _pair(rms),
                "check_rms_px": _pair(told["check_rms_px"].get(name)),
                "promised_px": _maybe((check.get("promised_px") or {}).get(name)),
            }
            for name, rms in list(told["rms_px"].items())[:MOST_CAMERAS]
        ],
        "pointing_rms_px": _pair(check.get("pointing_rms_px")),
        "pointing_promised_px": _maybe(check.get("pointing_promised_px")),
        "pointings": len(check.get("pointings") or ()),
        "calibrated_px": _maybe(told["calibrated_px"]),
        "counts_px": _maybe(told["counts_px"]),
        "pictures": _count(told["pictures"]),
        "placements": _count(told["placements"]),
        "rover_s": _maybe(told["rover_seconds"]),
        "notes": [_words(one) for one in [*told["gauges"], *told["notes"]][:MOST_SENTENCES]],
    }
    last = replace(run, result=result, pictures=_count(told["pictures"]))
    return ended(last, "done", None, f"verdict: {words}")


def _failed(run: Run, event: Mapping[str, Any]) -> Run:
    return ended(run, "interrupted", _words(event["code"]), _words(event["message"]))


_READ: Mapping[str, Callable[[Run, Mapping[str, Any]], Run]] = {
    "begun": _begun,
    "said": _said,
    "step": _step,
    "place": _place,
    "stands": _stands,
    "progress": _progress,
    "done": _done,
    "failed": _failed,
}


def _words(value: Any) -> str:
    if not isinstance(value, str):
        raise Odd
    return one_line(value, LONGEST_SENTENCE)


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise Odd
    return float(value)


def _maybe(value: Any) -> float | None:
    return None if value is None else _number(value)


def _pair(value: Any) -> list[float] | None:
    if value is None:
        return None
    x, y = value
    return [_number(x), _number(y)]


def _count(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 1 << 40:
        raise Odd
    return value
