"""What a run says to the person at the bench, and what it asks for."""

from __future__ import annotations

import json
import math
import os
import queue
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any, Protocol, TextIO

from calib.plan.placements import Placement
from mastctl import signals
from mastctl.as_json import as_json
from mastctl.bench.events import (
    LINES,
    BenchAsks,
    BenchBegins,
    BenchFails,
    BenchLine,
    BenchProgress,
    BenchSays,
    BenchStands,
    BenchSteps,
    Step,
)
from mastctl.bench.eyes import BenchHead
from mastctl.errors import MastctlError

COLUMNS, ROWS = 33, 11
"""Of each half of a sketch, signs."""


class NobodyThere(MastctlError):
    """No operator answers at the terminal."""

    code = "nobody_there"


class Teller(Protocol):
    """Who is told how a run goes, and places the board."""

    def say(self, sentence: str) -> None:
        """Tell something, once."""
        ...

    def step(self, step: Step) -> None:
        """Tell what is done from now on."""
        ...

    def progress(self, now: BenchProgress) -> None:
        """Tell how far the run is."""
        ...

    def place(self, name: str, placement: Placement, head: BenchHead) -> None:
        """Have the board placed, and return when it stands."""
        ...

    def stands(self, name: str, placement: Placement | None, head: BenchHead) -> None:
        """Know that a run goes on before a board that was placed so."""
        ...


def sketch(placement: Placement, board_m: float = 0.5) -> str:
    """Return a placement drawn with signs: from above, and as the head looking straight ahead sees it."""
    above, ahead = _above(placement, board_m), _ahead(placement)
    head = f"{'from above':<{COLUMNS}}   as the head sees it from pan 0, tilt 0"
    return "\n".join([head, *(f"{a}   {b}".rstrip() for a, b in zip(above, ahead, strict=True))])


def _above(placement: Placement, board_m: float) -> list[str]:
    """The head at the bottom, ahead upwards, a metre as wide as high."""
    canvas = [[" "] * COLUMNS for _ in range(ROWS)]
    bearing = math.radians(placement.bearing_deg)
    up_m, right_m = placement.range_m * math.cos(bearing), placement.range_m * math.sin(bearing)
    # Signs are twice as high as wide.
    scale = min((ROWS - 3) / max(up_m + 0.3, 0.5), (COLUMNS / 2 - 2) / 2 / max(abs(right_m) + 0.4, 0.5))
    middle = COLUMNS // 2

    def put(forward_m: float, aside_m: float, sign: str) -> None:
        row, column = ROWS - 1 - round(forward_m * scale), middle + round(2 * aside_m * scale)
        if 0 <= row < ROWS and 0 <= column < COLUMNS:
            canvas[row][column] = sign

    for part in range(1, 8):
        put(part / 8 * up_m, part / 8 * right_m, ".")
    along = bearing - math.radians(placement.turned_deg[0])
    for k in range(-8, 9):
        aside = k / 16 * board_m
        put(up_m - aside * math.sin(along), right_m + aside * math.cos(along), "#")
    put(0.0, 0.0, "H")
    text = f"{placement.range_m:.1f} m"
    row, column = ROWS - 1 - round(0.45 * up_m * scale), middle + round(0.9 * right_m * scale) + 2
    for k, sign in enumerate(text):
        if 0 <= row < ROWS and column + k < COLUMNS:
            canvas[row][column + k] = sign
    return ["".join(line) for line in canvas]


def _ahead(placement: Placement) -> list[str]:
    """A frame of 120 by 80 degrees with the board in it."""
    inner, rows = COLUMNS - 2, ROWS - 2
    canvas = [[" "] * inner for _ in range(rows)]
    canvas[rows // 2][inner // 2] = "+"
    column = round((placement.bearing_deg / 120.0 + 0.5) * (inner - 1))
    row = round((0.5 - placement.height_deg / 80.0) * (rows - 1))
    left, right = ("[", "]")
    turned, raised = placement.turned_deg
    if turned >= 5:
        left, right = "[", ">"
    elif turned <= -5:
        left, right = "<", "]"
    body = "^^" if raised >= 5 else "vv" if raised <= -5 else "##"
    for k, sign in enumerate(left + body + right):
        at = min(max(column - 2 + k, 0), inner - 1)
        canvas[min(max(row, 0), rows - 1)][at] = sign
    edge = "+" + "-" * inner + "+"
    return [edge, *("|" + "".join(line) + "|" for line in canvas), edge]


class Terminal:
    """A person at a terminal: asked in words and a sketch, told line by line on stderr."""

    def __init__(self, board_m: float) -> None:
        self._board_m = board_m

    def say(self, sentence: str) -> None:
        """Write a line."""
        sys.stderr.write(sentence + "\n")
        sys.stderr.flush()

    def step(self, step: Step) -> None:
        """Say nothing: sentences and progress show it."""

    def progress(self, now: BenchProgress) -> None:
        """Write a line."""
        self.say(now.words())

    def stands(self, name: str, placement: Placement | None, head: BenchHead) -> None:
        """A real board stands where it stands."""

    def place(self, name: str, placement: Placement, head: BenchHead) -> None:
        """Ask for the placement, and wait for Enter.

        Raises
        ------
        NobodyThere
            If nobody can answer.
        """
        if not signals.may_read_stdin():
            raise NobodyThere("no one can place the board: the command runs in its terminal's background")
        self.say(
            f"\nPlacement {name}: put the board {placement.words()}.\n{sketch(placement, self._board_m)}"
        )
        sys.stderr.write("It need not be exact. Enter when it stands still (Ctrl-C: later). ")
        sys.stderr.flush()
        if not sys.stdin.readline():
            raise NobodyThere("no one can place the board: standard input has ended")


STANDS = "stands"
LEFT_ALONE = 3
"""Exit code of a run whose answers have ended."""


def leave() -> None:
    """End the process at once; what was seen is on the disk."""
    os._exit(LEFT_ALONE)


class Lines:
    """Tells a run to a program, a line of JSON each (`mastctl.bench.events`); see `Teller`.

    The only answer is a line ``stands``. Whoever asks is gone when the answers end, and then the process ends
    too: nobody would steer with a lease that nobody renews.

    Parameters
    ----------
    out, answers
        Where lines go, and where answers come from.
    on_end
        Called, in a thread of its own, when the answers end.
    """

    def __init__(self, out: TextIO, answers: TextIO, on_end: Callable[[], None] = leave) -> None:
        self._out, self._waits = out, True
        self._stands: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        threading.Thread(target=self._hear, args=(answers, on_end), name="answers", daemon=True).start()

    def begun(
        self, head: BenchHead, board_m: tuple[float, float], folder: str, simulated: bool, waits: bool
    ) -> None:
        """Tell what is calibrated with what; ``waits``: whether a placement is waited for, or the board goes
        by itself where it is asked for."""
        self._waits = waits
        cameras = {name: camera.model.size_px for name, camera in head.rig.cameras.items()}
        self._tell(BenchBegins(board_m, cameras, folder, simulated))

    def say(self, sentence: str) -> None:
        """Tell a sentence."""
        self._tell(BenchSays(sentence))

    def step(self, step: Step) -> None:
        """Tell what is done from now on."""
        self._tell(BenchSteps(step))

    def progress(self, now: BenchProgress) -> None:
        """Tell how far the run is."""
        self._tell(now)

    def place(self, name: str, placement: Placement, head: BenchHead) -> None:
        """Ask for a placement, and wait until an operator confirms that it stands."""
        while self._waits and not self._stands.empty():
            self._stands.get()  # of a placement before
        described = {**asdict(placement), "description": placement.words()}
        self._tell(BenchAsks(name, **described, needs_confirmation=self._waits))
        if self._waits:
            self._stands.get()
        self._tell(BenchStands(name))

    def stands(self, name: str, placement: Placement | None, head: BenchHead) -> None:
        """A real board stands where it stands."""

    def done(self, result: Mapping[str, Any]) -> None:
        """Tell what came of it: all that the command tells with ``--json``."""
        self._write(json.dumps({"event": "done", "result": as_json(result)}, allow_nan=False))

    def failed(self, code: str, message: str) -> None:
        """Tell why nothing did."""
        self._tell(BenchFails(code, message))

    def _tell(self, line: BenchLine) -> None:
        self._write(LINES.dump_json(line).decode())

    def _write(self, line: str) -> None:
        with self._lock:
            self._out.write(line + "\n")
            self._out.flush()

    def _hear(self, answers: TextIO, on_end: Callable[[], None]) -> None:
        for line in answers:
            if line.strip() == STANDS:
                self._stands.put(None)
        on_end()
