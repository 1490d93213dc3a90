"""What happened in a soak, and what of it nothing explains; safe from any thread."""

from __future__ import annotations

import threading
import time
from typing import Any

SEES = ("navcam_left", "navcam_right", "hazcam_left", "hazcam_right")

AFTER_S = 10.0
"""So long after its end a fault explains what is seen: a call under way, a line that comes back."""

LIES = {"wrong", "garbage", "drifting", "not_a_number", "misnamed", "swapped", "late"}
"""Words by which the head reads what is not so."""

OF_THE_SCENE = {
    "target_flat", "target_ambiguous", "target_border", "target_not_found", "target_moving", "eyes_disagree",
    "not_trackable", "not_in_view", "outside_image", "outside_limits", "keep_out", "no_stereo",
    "blind_cone", "too_near", "not_one_point", "out_of_reach", "unreachable", "behind", "frame_too_old",
    "frame_moving", "rover_moved", "other_mast_file", "no_track",
}  # fmt: skip
"""Ends of an operation that a place in the scene, drawn at random, explains."""

OF_A_STOP = {"stopped", "estopped", "stopping", "jog_ended"}

OF_LOAD = {"too_many"}
"""Refusals that a client is told to come back after."""

OF_THE_DISK = {"latch_not_kept", "slow"}
"""Told while a busy disk has not confirmed yet; at rest it must be gone."""

EVERYTHING = frozenset({
    "angles done", "pixel done", "place done", "look done", "jog done", "rival", "stop", "estop", "mast",
    "recording", "stalled", "killed", "fault of the head", "fault of a camera",
    *(f"looked by {camera}" for camera in SEES),
})  # fmt: skip
"""What the first time takes memory that stays; a daemon is warm when it has done all of it."""


class Ledger:
    """Faults that were set, with their times; ``wrong`` has a sentence for each thing that was not right."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._lacking = set(EVERYTHING)
        self._faults: list[tuple[str, str, float, float]] = []
        self.operated = 0
        self.wrong: list[str] = []

    def check(self, good: bool, otherwise: str) -> None:
        """Note a sentence if something is not good."""
        if not good:
            with self._lock:
                self.wrong.append(otherwise)

    def act(self, what: str) -> None:
        """Note something that a client did."""
        with self._lock:
            self._lacking.discard(what)

    def lacking(self) -> set[str]:
        """Return what of ``EVERYTHING`` was not done yet."""
        with self._lock:
            return set(self._lacking)

    def fault_set(self, device: str, word: str, begin_s: float, end_s: float) -> None:
        """Note a fault that was set, with its times (CLOCK_MONOTONIC)."""
        with self._lock:
            self._lacking.discard("fault of a camera" if device in SEES else "fault of the head")
            self._faults.append((device, word, begin_s, end_s))

    def faults_taken_back(self) -> None:
        """Note that no fault is set any more."""
        now_s = time.monotonic()
        with self._lock:
            self._faults = [(*one[:3], min(one[3], now_s)) for one in self._faults]

    def explained(
        self, since_s: float, until_s: float, words: set[str] | None = None, device: str = ""
    ) -> bool:
        """Whether a fault, if given of this device or one of these words, held then or shortly before."""
        with self._lock:
            return any(
                begin_s <= until_s
                and since_s <= end_s + AFTER_S
                and (words is None or word in words)
                and device in ("", on)
                for on, word, begin_s, end_s in self._faults
            )

    def answer(self, who: str, asked: str, status: int, code: str, since_s: float, says: str) -> None:
        """Judge an answer; from 500 on a fault or a full queue must explain it."""
        if status >= 500 and code not in OF_LOAD:
            good = code != "internal" and self.explained(since_s, time.monotonic())
            self.check(good, f"{who}: {asked}: {status} {says[:200]}")

    def operation_ended(self, what: str, record: dict[str, Any], deadline_s: float) -> None:
        """Note an operation's end: in time, and with a reason that something explains."""
        state = str(record["state"])
        error = record.get("error") or {}
        code = str(error.get("code", ""))
        took_s = record["ended_s"] - record["created_s"]
        with self._lock:
            self.operated += 1
            self._lacking.discard(f"{what} {state}")
        self.check(took_s <= deadline_s + 5.0, f"{what}: {took_s:.1f} s, {deadline_s:g} s were given")
        self.check(state != "failed" or bool(error.get("message")), f"{what}: failed and says not why")
        if state == "failed" and code not in OF_THE_SCENE | OF_A_STOP:
            good = self.explained(record["created_s"], record["ended_s"])
            self.check(good, f"{what}: {code}: {str(error.get('message'))[:200]}, and no fault was set")

    def status(self, told: dict[str, Any], asked_s: float) -> None:
        """Look at a status: faults that nothing explains, joints beyond the limits."""
        now_s = time.monotonic()
        for fault in told["faults"]:
            good = fault["code"] in OF_THE_DISK or self.explained(asked_s, now_s, device=fault["device"])
            self.check(good, f"the status tells a fault, and none was set: {fault['message'][:200]}")
        joints, limits = told["joints"], told["limits"]
        if joints is None or self.explained(asked_s, now_s, LIES):
            return
        for axis in ("pan_rad", "tilt_rad"):
            low, high = limits[axis]
            good = low - 0.01 <= joints[axis] <= high + 0.01
            self.check(good, f"{axis} reads {joints[axis]:.4f}, the limits are {low:g} to {high:g}")
