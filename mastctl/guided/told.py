"""What is known of a run: made of the lines that it tells (`mastctl.bench.events`), each judged before it is
believed. One that is none of them changes nothing but a count.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, cast

from pydantic import ValidationError

from mastctl.answers import MOST_CELLS, BenchRunTold, BenchState, BenchStep
from mastctl.bench.events import (
    LINES,
    LONGEST_SENTENCE,
    BenchAsks,
    BenchBegins,
    BenchEnds,
    BenchFails,
    BenchLine,
    BenchProgress,
    BenchSays,
    BenchStands,
    BenchSteps,
    CheckLine,
    PlacementLine,
    ResultLine,
)
from mastctl.errors import one_line

MOST_SENTENCES = 40
MOST_ON_CURVE = 600
MOST_CAMERAS = 16


@dataclass(frozen=True)
class CameraCells:
    """A camera's picture size, and how many corners were seen in each cell of it (8 a row, 6 rows)."""

    size_px: tuple[int, int]
    cells: tuple[int, ...] = (0,) * MOST_CELLS


@dataclass(frozen=True)
class GuidedRun:
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
    predicted_px, target_px, counts_px, expected_px
        What the calibration would leave of a first pointing now, may leave, what counts leave; and what it
        would leave with the next picture.
    next_rad
        The attitude that tells most now: pan and tilt.
    curve
        Pictures and what was predicted with them.
    sentences
        The newest.
    unread_lines
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
    asked: PlacementLine | None = None
    placements: int = 0
    pictures: int = 0
    most: int = 0
    predicted_px: float | None = None
    target_px: float | None = None
    counts_px: float | None = None
    expected_px: float | None = None
    next_rad: tuple[float, float] | None = None
    cameras: Mapping[str, CameraCells] = field(default_factory=dict)
    curve: tuple[tuple[int, float], ...] = ()
    sentences: tuple[str, ...] = ()
    unread_lines: int = 0
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


def heard(run: GuidedRun, line: bytes) -> GuidedRun:
    """Return what is known of a run after one more line."""
    try:
        return _after(run, LINES.validate_json(line))
    except (ValidationError, KeyError):  # KeyError: a camera that was not there as it began
        return replace(run, unread_lines=run.unread_lines + 1)


def _after(run: GuidedRun, line: BenchLine) -> GuidedRun:
    match line:
        case BenchBegins():
            cameras = {name: CameraCells(size) for name, size in [*line.cameras.items()][:MOST_CAMERAS]}
            return replace(run, simulated=line.simulated, board_m=line.board_m, cameras=cameras)
        case BenchSays():
            return _saying(run, line.sentence)
        case BenchSteps():
            return replace(run, step=line.step, state="running")
        case BenchAsks():
            state: BenchState = "asking" if line.needs_confirmation else "running"
            return replace(run, asked=line.asked, placements=run.placements + 1, step="place", state=state)
        case BenchStands():
            return replace(run, state="running", step="search")
        case BenchProgress():
            return _progressed(run, line)
        case BenchEnds():
            last = replace(run, result=_result(line.result), pictures=line.result.pictures)
            return ended(last, "done", None, f"verdict: {line.result.verdict.words}")
        case BenchFails():
            return ended(run, "interrupted", line.code, line.message)


def ended(run: GuidedRun, state: BenchState, code: str | None, sentence: str) -> GuidedRun:
    """Return a run that is over; one that is over already stays as it is."""
    if run.over:
        return run
    said = _saying(run, sentence) if sentence else run
    return replace(said, state=state, step="over", code=code, sentence=sentence)


def _saying(run: GuidedRun, sentence: str) -> GuidedRun:
    return replace(run, sentences=(*run.sentences, one_line(sentence, LONGEST_SENTENCE))[-MOST_SENTENCES:])


def _progressed(run: GuidedRun, now: BenchProgress) -> GuidedRun:
    curve = run.curve
    if now.predicted_px is not None:
        before = (one for one in curve if one[0] < now.pictures)
        curve = (*before, (now.pictures, now.predicted_px))[-MOST_ON_CURVE:]
    seen = {name: CameraCells(run.cameras[name].size_px, cells) for name, cells in now.cells.items()}
    return replace(
        run,
        state="running",
        step="pictures",
        pictures=now.pictures,
        most=now.most,
        predicted_px=now.predicted_px,
        target_px=now.target_px,
        counts_px=now.counts_px,
        expected_px=now.expected_px,
        next_rad=now.next_rad,
        curve=curve,
        cameras={**run.cameras, **seen},
    )


def _result(told: ResultLine) -> dict[str, Any]:
    """What of the end's figures is shown."""
    check = told.check or CheckLine()
    return {
        "verdict": asdict(told.verdict) | {"reasons": [asdict(one) for one in told.verdict.reasons]},
        "cameras": [
            {
                "camera": name,
                "rms_px": _listed(rms),
                "check_rms_px": _listed(told.check_rms_px.get(name)),
                "promised_px": check.promised_px.get(name),
            }
            for name, rms in [*told.rms_px.items()][:MOST_CAMERAS]
        ],
        "pointing_rms_px": _listed(check.pointing_rms_px),
        "pointing_promised_px": check.pointing_promised_px,
        "pointings": len(check.pointings),
        "calibrated_px": told.calibrated_px,
        "counts_px": told.counts_px,
        "pictures": told.pictures,
        "placements": told.placements,
        "rover_s": told.rover_seconds,
        "notes": [*told.gauges, *told.notes][:MOST_SENTENCES],
    }


def _listed(pair: tuple[float, float] | None) -> list[float] | None:
    return None if pair is None else list(pair)
