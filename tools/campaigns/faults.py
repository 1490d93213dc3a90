"""What a daemon does about each fault word, met while it points and while it tracks.

    python -m tools.campaigns.faults [--head memory|dynamixel|ptu] [--during pointing|tracking]
        [--word WORD ...]

Prints the tables of docs/evidence/safety.md. A daemon in a process of its own on a simulated rover. For
each word of the head and of a camera a pointing at a place is sent off, or a track is followed while the
rover drives a step; the fault is set under way and taken back after some seconds. Told are when and as what
the status or the operation names it, the states reached, how the operation and the track ended, and how long
after the fault's end the daemon was well: no fault told, at rest, and a pointing (a look) done again. Times
are of the machine as it is busy now.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from drivers.faults import CAMERA_WORDS, HEAD_WORDS, PAN_TILT
from tools.command import end, heading, line, options
from tools.living_daemon import HEADS, Asker, simulated, started

CAMERAS = ("navcam_left", "navcam_right")
CAMERA = CAMERAS[0]
NEAR_RAD = {"pan_rad": -0.6, "tilt_rad": -0.1}
PLACE_M = [5.0, 1.5, 0.0]
LOOK_RAD = {"pan_rad": 0.0, "tilt_rad": -0.3}
PIXELS_PX = ((520.0, 480.0), (400.0, 420.0), (640.0, 420.0), (460.0, 560.0), (580.0, 560.0), (520.0, 350.0))
HOLDS_S = 2.5
DEADLINE_S = 20.0
ENDS_S = 30.0
STEP_M = 0.05
DURING = ("pointing", "tracking")


@dataclass(frozen=True)
class FaultTrial:
    """What came of one fault.

    Attributes
    ----------
    device, word
        The fault.
    told_s, told
        When it was first told, seconds after it was set, and as which code; None and empty if never.
    states
        The daemon's states while it held, each once, in order.
    ended
        How the operation under way ended: its state, with the code of its error.
    track
        The track's state after it; empty while pointing.
    well_s
        How long after the fault's end all was well, seconds; None if not within half a minute.
    lost
        What was lost that should not have been; empty if nothing.
    why
        Why it is not well, if it is not.
    """

    device: str
    word: str
    told_s: float | None
    told: str
    states: tuple[str, ...]
    ended: str
    track: str
    well_s: float | None
    lost: str = ""
    why: str = ""


def main() -> int:
    """Try all, print the tables; 1 if something was lost."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("--head", choices=HEADS, default="dynamixel", help="default dynamixel")
    parser.add_argument(
        "--during", choices=DURING, action="append", help="default: both, one after the other"
    )
    parser.add_argument(
        "--word", choices=sorted({*HEAD_WORDS, *CAMERA_WORDS}), action="append", help="default: all"
    )
    args = parser.parse_args()
    bad = 0
    for during in args.during or DURING:
        print(f"\nHead {args.head}, while {during}, load {os.getloadavg()[0]:.1f}.\n")
        track = ("track",) if during == "tracking" else ()
        columns = ("fault", "reported after", "as", "states", "operation", *track, "well after")
        print(heading(columns), flush=True)
        with tempfile.TemporaryDirectory() as folder:
            for trial in trials(Path(folder), args.head, during, args.word):
                print(_row(trial), flush=True)
                bad += bool(trial.lost)
    return 1 if bad else 0


def trials(folder: Path, head: str, during: str, words: Sequence[str] | None = None) -> Any:
    """Yield what came of each fault, of the head first."""
    faults = [(PAN_TILT, word) for word in HEAD_WORDS] + [(CAMERA, word) for word in CAMERA_WORDS]
    faults = [(device, word) for device, word in faults if words is None or word in words]
    begin, well = (_point, _pointed) if during == "pointing" else (_drive, _looked)
    config = simulated(folder, head, CAMERAS)
    while faults:
        with started(config) as (_, port), Asker(port, "faults") as asker:
            bench, good = _FaultClient(asker), True
            while faults and good:  # what does not get well is left behind with its daemon
                trial = bench.tried(*faults.pop(0), begin, well)
                good = trial.well_s is not None
                yield trial


class _FaultClient:
    """One client that sets faults and looks what follows."""

    def __init__(self, asker: Asker) -> None:
        self.asker = asker
        self.x_m = 0.0
        self.why = ""

    def tried(self, device: str, word: str, begin: Any, well: Any) -> FaultTrial:
        """Set a fault under way and take it back."""
        mast = self.asker.json("GET", "/status")["mast"]["digest"]
        operation = begin(self)
        set_s = time.monotonic()
        self.asker.json("POST", "/simulation/faults", {"device": device, "word": word, "parameters": {}})
        trial = self._watched(FaultTrial(device, word, None, "", (), "", "", None), operation, set_s)
        self.asker.json("DELETE", "/simulation/faults")
        over_s = time.monotonic()
        record = self.ended(operation)
        error = record.get("error") or {}
        if trial.told_s is None and error.get("code"):
            trial = replace(trial, told_s=max(0.0, record["ended_s"] - set_s), told=error["code"])
        trial = replace(trial, ended=f"{record['state']} {error.get('code', '')}".strip())
        if begin is _drive:
            trial = replace(trial, track=self.asker.json("GET", "/track")["state"])
        good = well(self, over_s + ENDS_S)
        lost = "" if record["state"] != "failed" or error.get("message") else "the reason"
        if self.asker.json("GET", "/status")["mast"]["digest"] != mast:
            lost = "the mast file"
        if not good:
            trial = replace(trial, why=self.why)
        return replace(trial, well_s=time.monotonic() - over_s if good else None, lost=lost)

    def _watched(self, trial: FaultTrial, operation: str, set_s: float) -> FaultTrial:
        """Look at the status while the fault holds."""
        states: list[str] = []
        while time.monotonic() < set_s + HOLDS_S:
            status = self.asker.json("GET", "/status")
            if status["state"] not in states[-1:]:
                states.append(status["state"])
            named = [fault for fault in status["faults"] if fault["device"] == trial.device]
            if named and trial.told_s is None:
                trial = replace(trial, told_s=time.monotonic() - set_s, told=named[0]["code"])
            time.sleep(0.01)
        return replace(trial, states=tuple(dict.fromkeys(states)))

    def ended(self, operation: str) -> dict[str, Any]:
        """Wait for an operation's end and return its record."""
        until_s = time.monotonic() + DEADLINE_S + ENDS_S
        while time.monotonic() < until_s:
            record = self.asker.json("GET", f"/operations/{operation}")
            if record["state"] not in ("queued", "running"):
                return record
            time.sleep(0.02)
        raise TimeoutError(f"operation {operation} did not end")

    def begin(self, path: str, body: Mapping[str, Any], until_s: float) -> str | None:
        """Begin an operation, again and again while it is refused; None if it always was."""
        while time.monotonic() < until_s:
            try:
                return str(self.asker.json("POST", path, {**body, "deadline_s": DEADLINE_S})["id"])
            except OSError as error:
                self.why = str(error)
                time.sleep(0.05)
        return None

    def quiet(self, until_s: float) -> bool:
        """Wait until no fault is told and nothing moves or runs."""
        status = self.asker.json("GET", "/status")
        while time.monotonic() < until_s:
            status = self.asker.json("GET", "/status")
            if not status["faults"] and not status["moving"] and status["operation"] is None:
                return True
            time.sleep(0.02)
        told = [fault["message"] for fault in status["faults"]]
        self.why = f"{status['state']} ({status['reason']}), faults {told}"
        return False

    def done(self, path: str, body: Mapping[str, Any], until_s: float) -> bool:
        """Whether an operation, begun until it is, ends well."""
        operation = self.begin(path, body, until_s)
        if operation is None:
            return False
        record = self.ended(operation)
        self.why = str((record["error"] or {}).get("message", ""))
        return bool(record["state"] == "done")


def _point(bench: _FaultClient) -> str:
    """Send the head off to a place, and wait until it is under way."""
    until_s = time.monotonic() + ENDS_S
    if not (bench.done("/point", NEAR_RAD, until_s) and bench.quiet(until_s)):
        raise TimeoutError(f"the head does not come to where it is to begin: {bench.why}")
    operation = bench.begin("/point", {"position_m": PLACE_M, "frame": "rover"}, until_s)
    if operation is None:
        raise TimeoutError("no pointing was taken")
    while time.monotonic() < until_s and not bench.asker.json("GET", "/status")["moving"]:
        time.sleep(0.005)
    return operation


def _pointed(bench: _FaultClient, until_s: float) -> bool:
    """Whether a pointing is done again, and nothing is wrong."""
    while time.monotonic() < until_s:
        if bench.done("/point", {"position_m": PLACE_M, "frame": "rover"}, until_s) and bench.quiet(until_s):
            return True
    return False


def _drive(bench: _FaultClient) -> str:
    """Have a target followed, and drive a step."""
    if bench.asker.json("GET", "/track")["state"] != "tracking":
        _follow(bench)
    operation = _posed(bench)
    if operation is None:
        raise RuntimeError("nothing was looked for after a step")
    return operation


def _follow(bench: _FaultClient) -> None:
    """Begin a track where nothing is followed."""
    until_s = time.monotonic() + ENDS_S
    asker = bench.asker
    if asker.json("GET", "/track")["state"] not in ("idle", "stopped"):
        asker.json("POST", "/track/stop")
    bench.x_m = 0.0
    _posed(bench)
    if not (bench.done("/point", LOOK_RAD, until_s) and bench.quiet(until_s)):
        raise TimeoutError("the head does not come to where a target is to be found")
    for x_px, y_px in PIXELS_PX:  # not every place can be followed
        _, headers, _ = asker.ask("GET", f"/snapshot/{CAMERA}?fresh=true&format=jpeg")
        pixel = {"camera": CAMERA, "frame_id": headers["x-mastctl-frame-id"], "x_px": x_px, "y_px": y_px}
        if bench.done("/track", {"pixel": pixel}, until_s):
            return
    raise TimeoutError(f"no track could be begun: {bench.why}")


def _posed(bench: _FaultClient) -> str | None:
    """Drive a step and say so; the look that follows, if any."""
    bench.x_m += STEP_M
    asker = bench.asker
    true = asker.json("POST", "/simulation/pose", {"x_m": bench.x_m, "y_m": 0.0, "heading_rad": 0.0})
    sigma = {"position_m": 0.01, "rotation_rad": 0.005}
    pose = {"position_m": true["position_m"], "quaternion": true["quaternion"]}
    told = asker.json("POST", "/pose", {**pose, "sigma": sigma})
    return told["operation"]


def _looked(bench: _FaultClient, until_s: float) -> bool:
    """Whether the target is found again, and nothing is wrong."""
    while time.monotonic() < until_s:
        if bench.done("/track/look", {}, until_s):
            track = bench.asker.json("GET", "/track")
            if track["state"] == "tracking":
                return bench.quiet(until_s)
            bench.why = f"the track is {track['state']}: {track['reason']}"
    return False


def _row(trial: FaultTrial) -> str:
    """One line of the table."""
    device = "head" if trial.device == PAN_TILT else "camera"
    told = "" if trial.told_s is None else f"{trial.told_s:.2f} s"
    cells = [
        f"{device} `{trial.word}`",
        told,
        f"`{trial.told}`" if trial.told else "",
        ", ".join(trial.states),
    ]
    cells.append(trial.ended + (f" (lost: {trial.lost})" if trial.lost else ""))
    if trial.track:
        cells.append(trial.track)
    cells.append(f"not by itself: {trial.why}" if trial.well_s is None else f"{trial.well_s:.1f} s")
    return line(*cells)


if __name__ == "__main__":
    end(main)
