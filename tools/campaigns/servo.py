"""Drive real servo drivers on faulty simulated hardware, thousands of calls a fault; see that nothing lies.

For each driver and each fault word (and random mixtures): episodes of a healthy phase, a fault, and recovery.
All the time the head is read, moved and stopped at random. What is true is asked of the simulated motors.
Counted are readings that are wrong (a faultless reading away from every true angle of the call by more than
1.5 counts, or from those within 0.15 s of its stamp), moments outside the limits, failures to recover,
threads and descriptors left behind, and the time from the begin of a fault to the first error or fault in
words, and from its end to a good reading.

An encoder that lies (``wrong``, ``drifting``, ``garbage``) cannot be told from a moving axis by its bytes;
for those words the worst error of a reading that calls itself settled and healthy is told instead.

    .venv/bin/python -m tools.campaigns.servo --cases 10000 --seed 1
    .venv/bin/python -m tools.campaigns.servo --minutes 480 --driver ptu_pty
    .venv/bin/python -m tools.campaigns.servo --openings 100

With ``--openings`` a healthy Dynamixel head fresh from the factory is opened so many times under each fault
that repeats, holds back, swaps or misnames replies, with ``on_hardware_error: reboot``. Told is how often it
opened, how often a servo was rebooted, and how often one was not set as an open head has to have left it.
"""

from __future__ import annotations

import json
import logging
import math
import secrets
import statistics
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from drivers.errors import DriverError, HardwareFault
from drivers.faults import HEAD_WORDS
from drivers.interfaces import Reading
from mastctl.cli.output import at_least, positive_number
from tools.campaigns.servo_rigs import (
    LIMITS_RAD,
    HeadRig,
    as_opened,
    dynamixel,
    feetech,
    fresh_servos,
    opened_on,
    pelco,
    ptu,
    visca,
)
from tools.command import end, heading, line, new_file, options

DRIVERS: dict[str, Callable[[], AbstractContextManager[HeadRig]]] = {
    "dynamixel_pty": partial(dynamixel, watchdog_s=0.3, reply_timeout_s=0.05),
    "ptu_pty": ptu,
    "dynamixel": partial(dynamixel, watchdog_s=0.3, reply_timeout_s=0.05, turned=True),
    "feetech": partial(feetech, lease_s=0.2, reply_timeout_s=0.05, turned=True),
    "feetech_echo": partial(feetech, lease_s=0.2, reply_timeout_s=0.05, echoes=True, turned=True),
    "scs": partial(feetech, "SCS0009", lease_s=0.2, reply_timeout_s=0.05, turned=True),
    "ptu": partial(ptu, turned=True),
    "visca": partial(visca, turned=True),
    "pelco": partial(pelco, turned=True),
    "pelco_p": partial(pelco, "P", turned=True),
}
"""Those without ``_pty`` on a turned clock, without real time."""
MIXTURE = "mixture"
WORDS = (*HEAD_WORDS, MIXTURE)
LYING = ("wrong", "drifting", "garbage")
OF_THE_MECHANISM = ("stuck", "silent", "slow", "overload", "voltage_dip", "temperature_ramp", *LYING)
"""Words under which the head is moved once and then watched for some seconds."""
NEVER_A_FAULT = ("duplicate", "noise", "slow", "misnamed", "not_a_number", *LYING)
"""Words that a good driver may live through without a word."""

AWAY_PERIOD_S = 0.02  # between calls while the head is away: polled as a service polls it
PERIOD_S = 0.004  # between calls otherwise
RECOVERY_S = 20.0
OPENING_TRIES = 5
EPISODE_S = (0.3, 3.0)
WATCHED_S = (3.0, 5.0)
WRONG_COUNTS = 1.5
OLD_S = 0.15  # on a busy machine the simulated unit itself comes tens of milliseconds late
AGE_STEP_S, OLDEST_S = 0.005, 1.0
OPENINGS: tuple[tuple[str, dict[str, float]], ...] = (
    ("duplicate", {"probability": 1.0}),
    ("duplicate", {"probability": 0.1}),
    ("late", {"probability": 1.0, "delay_s": 0.06}),
    ("late", {"probability": 0.3, "delay_s": 0.09}),
    ("late", {"probability": 1.0, "delay_s": 0.12}),
    ("swapped", {"probability": 0.2}),
    ("misnamed", {"probability": 0.2}),
)


@dataclass
class ServoRow:
    """What came out for one driver and one word."""

    driver: str
    word: str
    seed: int
    calls: int = 0
    errors: int = 0
    wrong: int = 0
    outside: int = 0
    episodes: int = 0
    unseen: int = 0
    power_cycles: int = 0
    lost: int = 0
    left_over: int = 0
    worst_lie_rad: float = 0.0
    oldest_s: float = 0.0
    detect_s: list[float] = field(default_factory=list)
    recover_s: list[float] = field(default_factory=list)
    complaints: list[str] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """Whether nothing happened that must not."""
        return not (self.wrong or self.outside or self.lost or self.left_over)


class ReadingJudge:
    """Compares readings with the true angles, and true angles with the limits."""

    def __init__(self, rig: HeadRig, row: ServoRow, lying: bool) -> None:
        self._rig, self._row, self.lying = rig, row, lying
        self._seen_s = self._rig.clock.now_s()

    def reading(self, reading: Reading, began_s: float, ended_s: float) -> None:
        """Judge one reading of a call."""
        if reading.faults:
            return
        truths = self._truths(began_s, ended_s)
        away = 0.0
        for axis, angle in enumerate((reading.pan_rad, reading.tilt_rad)):
            seen = [truth[axis] for truth in truths]
            away = max(away, min(seen) - angle, angle - max(seen))
        if self.lying:
            if not reading.moving:
                self._row.worst_lie_rad = max(self._row.worst_lie_rad, away)
        elif not away <= WRONG_COUNTS * self._rig.count_rad:
            self._row.wrong += 1
            self._complain(f"a reading was {away:.6f} rad away from the truth: {reading}")
        elif (age_s := self._age_s(reading, ended_s)) > 0:
            self._row.oldest_s = max(self._row.oldest_s, age_s)
            if age_s > OLD_S:
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
        words = self._set_faults()
        detected_s = self._under_fault()
        if detected_s is not None:
            self._row.detect_s.append(detected_s)
        elif not set(words) <= set(NEVER_A_FAULT):
            self._row.unseen += 1
        self._rig.panel.clear()
        return self._recover()

    def _set_faults(self) -> tuple[str, ...]:
        rng = self._rng
        mixed = self._row.word == MIXTURE
        words = tuple(rng.choice(list(HEAD_WORDS), int(rng.integers(2, 4)), replace=False)) if mixed else ()
        words = words or (self._row.word,)
        self._judge.lying = bool(set(words) & set(LYING))  # and until the next fault is set
        for word in words:
            self._rig.panel.set("pan_tilt", word, **_parameters(word, rng))
        return words

    def _under_fault(self) -> float | None:
        """Use the head while the fault lasts; return when it was first told."""
        watched = self._row.word in OF_THE_MECHANISM
        began_s, length_s = self._rig.clock.now_s(), self._rng.uniform(*(WATCHED_S if watched else EPISODE_S))
        told: list[float] = []
        if watched:
            with suppress(DriverError):
                self._move()
        self._drive(lambda calls, spent_s: spent_s >= length_s, told, only_read=watched)
        return told[0] - began_s if told else None

    def _move(self) -> None:
        """Send the head anywhere."""
        low, high = zip(*LIMITS_RAD, strict=True)
        self._rig.head.move(*self._rng.uniform(low, high))

    def _drive(
        self,
        enough: Callable[[int, float], bool],
        told: list[float] | None = None,
        only_read: bool = False,
    ) -> None:
        """Read, move and stop at random."""
        began_s, calls = self._rig.clock.now_s(), 0
        while not enough(calls, self._rig.clock.now_s() - began_s):
            calls += 1
            self._row.calls += 1
            dice = 1.0 if only_read else self._rng.random()
            started_s = self._rig.clock.now_s()
            try:
                if dice < 0.012:
                    self._move()
                elif dice < 0.015:
                    self._rig.head.stop()
                else:
                    reading = self._rig.head.read()
                    ended_s = self._rig.clock.now_s()
                    self._judge.reading(reading, started_s, ended_s)
                    if reading.faults and told is not None:
                        told.append(ended_s)
            except DriverError:
                self._row.errors += 1
                ended_s = self._rig.clock.now_s()
                if told is not None:
                    told.append(ended_s)
                self._rig.clock.sleep(max(0.0, AWAY_PERIOD_S - (ended_s - started_s)))
            else:
                self._rig.clock.sleep(PERIOD_S)
        self._judge.limits()

    def _recover(self) -> bool:
        """Wait for a healthy reading and a move that is taken; False if it has to be switched off and on."""
        began_s, read, hardware, last = self._rig.clock.now_s(), False, False, ""
        while self._rig.clock.now_s() - began_s < RECOVERY_S:
            self._row.calls += 1
            started_s = self._rig.clock.now_s()
            try:
                if not read:
                    reading = self._rig.head.read()
                    ended_s = self._rig.clock.now_s()
                    self._judge.reading(reading, started_s, ended_s)
                    read = not reading.faults
                    hardware = hardware or bool(reading.faults)
                    if read:
                        self._row.recover_s.append(ended_s - began_s)
                if read or hardware:
                    self._rig.head.stop()
                    self._rig.head.move(0.0, 0.0)
                    if read:
                        return True
            except HardwareFault:
                self._row.power_cycles += 1
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


def run_word(driver: str, word: str, transactions: int, seed: int, until_s: float = math.inf) -> ServoRow:
    """Run episodes of one word on one driver until so many calls were made, and return what came out."""
    row = ServoRow(driver, word, seed)
    rng = np.random.default_rng([seed, list(DRIVERS).index(driver), WORDS.index(word)])
    threads, descriptors = set(threading.enumerate()), _descriptors()
    while row.calls < transactions and time.monotonic() < until_s:
        with ExitStack() as stack:
            rig = _opened(stack, driver)
            stack.enter_context(rig.clock.at_work())
            run = ServoRun(rig, row, rng)
            while row.calls < transactions and time.monotonic() < until_s and run.episode():
                pass
    waited_s = time.monotonic() + 10.0
    while not set(threading.enumerate()) <= threads and time.monotonic() < waited_s:
        time.sleep(0.05)
    row.left_over = len(set(threading.enumerate()) - threads) + max(0, _descriptors() - descriptors)
    return row


def _opened(stack: ExitStack, driver: str) -> HeadRig:
    """A new rig; on a machine so busy that even a healthy head comes late it may take some tries."""
    for _ in range(OPENING_TRIES):
        with suppress(DriverError):
            return stack.enter_context(DRIVERS[driver]())
    return stack.enter_context(DRIVERS[driver]())


def _descriptors() -> int:
    return len(list(Path("/proc/self/fd").iterdir()))


def told(row: ServoRow) -> str:
    """One line of the table."""
    lie = f"{row.worst_lie_rad * 1e3:.1f}" if row.word in (*LYING, MIXTURE) else "-"
    return line(
        row.driver, row.word, row.calls, row.episodes, row.errors, row.wrong, f"{1e3 * row.oldest_s:.0f}",
        lie, row.outside, row.left_over, row.lost, row.power_cycles, row.unseen,
        _times(row.detect_s), _times(row.recover_s),
    )  # fmt: skip


HEADING = heading(
    (
        "driver", "word", "calls", "episodes", "errors", "wrong", "worst age, ms", "worst lie, mrad",
        "outside", "left over", "not back", "power cycles", "unseen", "detect, ms: median, worst",
        "recover, ms: median, worst",
    )
)  # fmt: skip


def _times(values: Sequence[float]) -> str:
    if not values:
        return "-"
    return f"{1e3 * statistics.median(values):.0f}, {1e3 * max(values):.0f}"


def run_all(
    drivers: Iterable[str], words: Iterable[str], transactions: int, seed: int, until_s: float
) -> list[ServoRow]:
    """Run every word on every driver and print a line each."""
    rows = []
    for driver in drivers:
        for word in words:
            rows.append(run_word(driver, word, transactions, seed, until_s))
            print(told(rows[-1]), flush=True)
            for words_said in rows[-1].complaints:
                print(f"    {words_said}", flush=True)
            if time.monotonic() >= until_s:
                return rows
    return rows


def run_openings(openings: int, seed: int) -> bool:
    """Open a healthy head again and again under each of `OPENINGS`; returns whether nothing was wrong."""
    print(heading(("fault", "opened", "not opened", "reboots", "not as told")), flush=True)
    good = True
    for word, parameters in OPENINGS:
        opened = reboots = untrue = 0
        for number in range(openings):
            with fresh_servos() as (wire, panel, servos):
                panel.set("pan_tilt", word, replies=math.inf, seed=seed + number, **parameters)
                with suppress(DriverError), opened_on(wire) as head:
                    opened += 1
                    untrue += not all(as_opened(servo, head) for servo in servos)
                panel.clear()
                reboots += sum(servo.restarts for servo in servos)
        told = ", ".join(f"{name} {value:g}" for name, value in parameters.items())
        print(line(f"{word}, {told}", opened, openings - opened, reboots, untrue), flush=True)
        good = good and not reboots and not untrue
    return good


def main() -> int:
    """Run the campaign; exit 1 if a position was wrong, a limit passed, or something did not come back."""
    parser = options(__doc__, 10_000, "calls a driver and word", seed=None, tasks=False)
    parser.add_argument(
        "--minutes", type=positive_number, metavar="T", help="go on with new seeds for so long"
    )
    parser.add_argument("--seed", type=at_least(0), metavar="S", help="chosen and printed when left out")
    parser.add_argument("--driver", choices=list(DRIVERS), action="append", help="one or more (default all)")
    parser.add_argument("--word", choices=WORDS, action="append", help="one or more (default all)")
    parser.add_argument(
        "--openings", type=at_least(1), help="only open a head so many times under each fault"
    )
    parser.add_argument("--out", type=new_file, help="file for the rows as JSON lines")
    args = parser.parse_args()
    logging.getLogger("drivers").setLevel(logging.CRITICAL)
    seed = secrets.randbelow(2**31) if args.seed is None else args.seed
    if args.openings is not None:
        return 0 if run_openings(args.openings, seed) else 1
    until_s = math.inf if args.minutes is None else time.monotonic() + 60 * args.minutes
    drivers, words = args.driver or DRIVERS, args.word or WORDS
    rows: list[ServoRow] = []
    while True:
        print(f"seed {seed}, {args.cases} calls a driver and word\n{HEADING}", flush=True)
        rows += run_all(drivers, words, args.cases, seed, until_s)
        if args.out is not None:
            with suppress(OSError), args.out.open("a", encoding="utf-8") as file:
                file.writelines(json.dumps(asdict(row)) + "\n" for row in rows)
        if args.minutes is None or time.monotonic() >= until_s:
            break
        seed += 1
    bad = [row for row in rows if not row.good]
    print(f"{sum(row.calls for row in rows)} calls, {len(bad)} of {len(rows)} rows with a failure")
    return 1 if bad else 0


if __name__ == "__main__":
    end(main)
