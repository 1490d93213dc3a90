"""Drive real servo drivers on faulty simulated hardware and compare every reading with the true motors.

For each driver and each fault word (and random mixtures): episodes of a healthy phase, a fault, and recovery.
All the time the head is read, moved and stopped at random. Counted are readings that are wrong (a faultless
reading away from every true angle of the call by more than 1.5 counts, or from those within 0.15 s of its
stamp), moments outside the limits, and failures to recover. An encoder that lies (``wrong``,
``drifting``, ``garbage``) cannot be told from a moving axis by its bytes: while such a word is in a mixture
readings are not judged.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from drivers.errors import DriverError, HardwareFault
from drivers.faults import HEAD_WORDS
from drivers.interfaces import Reading
from hil_tests.support.servo_rigs import (
    LIMITS_RAD,
    HeadRig,
    dynamixel,
    feetech,
    ptu,
)

DRIVERS: dict[str, Callable[[], AbstractContextManager[HeadRig]]] = {
    "dynamixel": partial(dynamixel, watchdog_s=0.3, reply_timeout_s=0.05, turned=True),
    "feetech": partial(feetech, lease_s=0.2, reply_timeout_s=0.05, turned=True),
    "feetech_echo": partial(feetech, lease_s=0.2, reply_timeout_s=0.05, echoes=True, turned=True),
    "ptu": partial(ptu, turned=True),
}
"""All on a turned clock, without real time."""
MIXTURE = "mixture"
WORDS = (*HEAD_WORDS, MIXTURE)
LYING = ("wrong", "drifting", "garbage")

AWAY_PERIOD_S = 0.02  # between calls while the head is away: polled as a service polls it
PERIOD_S = 0.004  # between calls otherwise
RECOVERY_S = 20.0
EPISODE_S = (0.3, 3.0)
WRONG_COUNTS = 1.5
OLD_S = 0.15
AGE_STEP_S, OLDEST_S = 0.005, 1.0


@dataclass
class ServoRow:
    """What came out for one driver and one word."""

    driver: str
    word: str
    calls: int = 0
    wrong: int = 0
    outside: int = 0
    episodes: int = 0
    lost: int = 0
    complaints: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """Whether nothing happened that must not."""
        return not (self.wrong or self.outside or self.lost)


class ReadingJudge:
    """Compares readings with the true angles, and true angles with the limits."""

    def __init__(self, rig: HeadRig, row: ServoRow, lying: bool) -> None:
        self._rig, self._row, self.lying = rig, row, lying
        self._seen_s = self._rig.clock.now_s()

    def reading(self, reading: Reading, began_s: float, ended_s: float) -> None:
        """Judge one reading of a call."""
        if reading.faults or self.lying:
            return
        truths = self._truths(began_s, ended_s)
        away = 0.0
        for axis, angle in enumerate((reading.pan_rad, reading.tilt_rad)):
            seen = [truth[axis] for truth in truths]
            away = max(away, min(seen) - angle, angle - max(seen))
        if not away <= WRONG_COUNTS * self._rig.count_rad:
            self._row.wrong += 1
            self._complain(f"a reading was {away:.6f} rad away from the truth: {reading}")
        elif (age_s := self._age_s(reading, ended_s)) > OLD_S:
            self._row.wrong += 1
            self._complain(f"a reading was true {age_s:.3f} s away from its stamp: {reading}")

    def _age_s(self, reading: Reading, now_s: float) -> float:
        """How long before or after a reading's stamp both axes have passed its angles."""
        slack = WRONG_COUNTS * self._rig.count_rad
        truths: list[tuple[float, float]] = []
        for step in range(round(OLDEST_S / AGE_STEP_S)):
            away_s = step * AGE_STEP_S
            moments_s = (reading.time_s - away_s, min(reading.time_s + away_s, now_s))
            truths += [self._rig.true_rad(time_s) for time_s in moments_s]
            axes = zip((reading.pan_rad, reading.tilt_rad), zip(*truths, strict=True), strict=True)
            if all(min(seen) - slack <= angle <= max(seen) + slack for angle, seen in axes):
                return away_s
        return math.inf

    def limits(self) -> None:
        """See that no axis was outside its limits since the last look."""
        now_s = self._rig.clock.now_s()
        slack = 1.5 * self._rig.count_rad
        for truth in self._truths(max(self._seen_s, now_s - 30.0), now_s):
            for angle, (low, high) in zip(truth, LIMITS_RAD, strict=True):
                if not low - slack <= angle <= high + slack:
                    self._row.outside += 1
                    self._complain(f"an axis was at {angle:.4f} rad, limits {low} to {high}")
        self._seen_s = now_s

    def _truths(self, began_s: float, ended_s: float) -> list[tuple[float, float]]:
        steps = max(8, math.ceil((ended_s - began_s) / 0.01))
        return [self._rig.true_rad(began_s + (ended_s - began_s) * i / steps) for i in range(steps + 1)]

    def _complain(self, words: str) -> None:
        if len(self._row.complaints) < 10:
            self._row.complaints.append(words)


class ServoRun:
    """Episodes of one word on one rig."""

    def __init__(self, rig: HeadRig, row: ServoRow, rng: np.random.Generator) -> None:
        self._rig, self._row, self._rng = rig, row, rng
        self._judge = ReadingJudge(rig, row, row.word in LYING)

    def episode(self) -> bool:
        """Healthy, faulty, healthy again; return whether the head came back without being switched off."""
        self._row.episodes += 1
        self._drive(lambda calls, spent_s: calls >= 5)
        self._set_faults()
        length_s = self._rng.uniform(*EPISODE_S)
        self._drive(lambda calls, spent_s: spent_s >= length_s)
        self._rig.panel.clear()
        return self._recover()

    def _set_faults(self) -> None:
        rng = self._rng
        mixed = self._row.word == MIXTURE
        words = tuple(rng.choice(list(HEAD_WORDS), int(rng.integers(2, 4)), replace=False)) if mixed else ()
        words = words or (self._row.word,)
        self._judge.lying = bool(set(words) & set(LYING))  # and until the next fault is set
        for word in words:
            self._rig.panel.set("pan_tilt", word, **_parameters(word, rng))

    def _move(self) -> None:
        """Send the head anywhere."""
        low, high = zip(*LIMITS_RAD, strict=True)
        self._rig.head.move(*self._rng.uniform(low, high))

    def _drive(self, enough: Callable[[int, float], bool]) -> None:
        """Read, move and stop at random."""
        began_s, calls = self._rig.clock.now_s(), 0
        while not enough(calls, self._rig.clock.now_s() - began_s):
            calls += 1
            self._row.calls += 1
            dice = self._rng.random()
            started_s = self._rig.clock.now_s()
            try:
                if dice < 0.012:
                    self._move()
                elif dice < 0.015:
                    self._rig.head.stop()
                else:
                    reading = self._rig.head.read()
                    self._judge.reading(reading, started_s, self._rig.clock.now_s())
            except DriverError:
                self._rig.clock.sleep(max(0.0, AWAY_PERIOD_S - (self._rig.clock.now_s() - started_s)))
            else:
                self._rig.clock.sleep(PERIOD_S)
        self._judge.limits()

    def _recover(self) -> bool:
        """Wait for a healthy reading and a move that is taken; False if it has to be switched off and on."""
        began_s, read, faulty, moved, last = self._rig.clock.now_s(), False, False, False, ""
        while self._rig.clock.now_s() - began_s < RECOVERY_S:
            self._row.calls += 1
            started_s = self._rig.clock.now_s()
            try:
                if not read:
                    reading = self._rig.head.read()
                    self._judge.reading(reading, started_s, self._rig.clock.now_s())
                    read = not reading.faults
                    faulty = bool(reading.faults)
                if read or (faulty and not moved):  # a supply is judged where a way ends
                    self._rig.head.stop()
                    self._rig.head.move(0.0, 0.0)
                    moved = True
                    if read:
                        return True
            except HardwareFault:
                return False
            except DriverError as error:
                last = str(error)
            self._rig.clock.sleep(AWAY_PERIOD_S)
        self._row.lost += 1
        self._row.complaints.append(f"not back {RECOVERY_S:g} s after the fault: {last}")
        return False


def _parameters(word: str, rng: np.random.Generator) -> dict[str, float]:
    """Random parameters of a fault."""
    known = HEAD_WORDS[word].parameters
    drawn: dict[str, float] = {"seed": int(rng.integers(2**31))} if "seed" in known else {}
    if "replies" in known:
        drawn |= {"replies": math.inf, "probability": float(rng.choice([0.01, 0.05, 0.2, 1.0]))}
    elif "probability" in known:
        drawn["probability"] = float(rng.choice([0.02, 0.1, 0.5]))
    if "axis" in known:
        drawn["axis"] = int(rng.integers(3))
    ranges = {
        "delay_s": (0.05, 0.6),
        "offset_rad": (-0.05, 0.05),
        "rate_rad_per_s": (-0.01, 0.01),
        "rate_c_per_s": (20.0, 100.0),
        "angle_rad": (-0.3, 0.3),
    }
    drawn |= {name: float(rng.uniform(*ends)) for name, ends in ranges.items() if name in known}
    if "factor" in known:
        drawn["factor"] = float(rng.uniform(0.05, 0.5) if word == "slow" else rng.uniform(0.3, 0.8))
    return drawn


def run_word(driver: str, word: str, transactions: int, seed: int) -> ServoRow:
    """Run episodes of one word on one driver until so many calls were made, and return what came out."""
    row = ServoRow(driver, word)
    rng = np.random.default_rng([seed, list(DRIVERS).index(driver), WORDS.index(word)])
    while row.calls < transactions:
        with DRIVERS[driver]() as rig, rig.clock.at_work():
            run = ServoRun(rig, row, rng)
            while row.calls < transactions and run.episode():
                pass
    return row
