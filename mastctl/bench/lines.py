"""A run told and answered in lines: JSON on one stream for a program that shows it, words on the other back.

    {"event": "begun", "board_m": [w, h], "cameras": {name: [width, height]}, "folder", "simulated"}
    {"event": "said", "sentence"}
    {"event": "step", "step": "search" | "pictures" | "fit" | "check"}
    {"event": "place", "name", "range_m", "bearing_deg", "height_deg", "turned_deg", "words", "waits"}
    {"event": "stands", "name"}
    {"event": "progress", "placement", "pictures", "most", "predicted_px", "target_px", "floor_px",
     "next_rad", "expected_px", "cells": {camera: 48 counts of corners, row by row, 8 a row}}
    {"event": "done", "result"}             what the command tells with --json
    {"event": "failed", "code", "message"}

Numbers that are not finite are null. The only answer is a line ``stands``. Whoever asks is gone when the
answers end, and then the process ends too: nobody would steer with a lease that nobody renews.
"""

from __future__ import annotations

import json
import math
import os
import queue
import threading
from collections.abc import Callable, Mapping
from typing import Any, TextIO

from calib.plan.placements import Placement
from mastctl.bench.eyes import Head
from mastctl.bench.teller import Progress, Step

STANDS = "stands"
LEFT_ALONE = 3
"""Exit code of a run whose answers have ended."""


def leave() -> None:
    """End the process at once; what was seen is on the disk."""
    os._exit(LEFT_ALONE)


class Lines:
    """Tells a run in lines; see `mastctl.bench.teller.Teller`.

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
        self, head: Head, board_m: tuple[float, float], folder: str, simulated: bool, waits: bool
    ) -> None:
        """Tell what is calibrated with what; ``waits``: whether a placement is waited for, or the board goes
        by itself where it is asked for."""
        self._waits = waits
        cameras = {name: list(camera.model.size_px) for name, camera in head.rig.cameras.items()}
        self._tell("begun", board_m=list(board_m), cameras=cameras, folder=folder, simulated=simulated)

    def say(self, sentence: str) -> None:
        """Tell a sentence."""
        self._tell("said", sentence=sentence)

    def step(self, step: Step) -> None:
        """Tell what is done from now on."""
        self._tell("step", step=step)

    def progress(self, now: Progress) -> None:
        """Tell how far the run is."""
        self._tell(
            "progress",
            placement=now.placement,
            pictures=now.pictures,
            most=now.most,
            predicted_px=now.predicted_px,
            target_px=now.target_px,
            floor_px=now.floor_px,
            next_rad=list(now.next_rad),
            expected_px=now.expected_px,
            cells={camera: list(counts) for camera, counts in now.cells.items()},
        )

    def place(self, name: str, placement: Placement, head: Head) -> None:
        """Ask for a placement, and wait until somebody says that it stands."""
        while self._waits and not self._stands.empty():
            self._stands.get()  # of a placement before
        self._tell(
            "place",
            name=name,
            range_m=placement.range_m,
            bearing_deg=placement.bearing_deg,
            height_deg=placement.height_deg,
            turned_deg=list(placement.turned_deg),
            words=placement.words(),
            waits=self._waits,
        )
        if self._waits:
            self._stands.get()
        self._tell("stands", name=name)

    def stands(self, name: str, placement: Placement | None, head: Head) -> None:
        """A real board stands where it stands."""

    def done(self, result: Mapping[str, Any]) -> None:
        """Tell what came of it."""
        self._tell("done", result=dict(result))

    def failed(self, code: str, message: str) -> None:
        """Tell why nothing did."""
        self._tell("failed", code=code, message=message)

    def _tell(self, event: str, **told: Any) -> None:
        line = json.dumps({"event": event, **_finite(told)}, allow_nan=False)
        with self._lock:
            self._out.write(line + "\n")
            self._out.flush()

    def _hear(self, answers: TextIO, on_end: Callable[[], None]) -> None:
        for line in answers:
            if line.strip() == STANDS:
                self._stands.put(None)
        on_end()


def _finite(value: Any) -> Any:
    """The same with null for numbers that JSON does not have."""
    if isinstance(value, dict):
        return {key: _finite(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
