"""What the looks at a reference say together: has something changed, at once or slowly, and since when."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import BadFile
from calib.geometry.rigid import FloatArray
from mastctl.watch.reference import LOOKS, REFERENCE, Reference, read_looks, read_reference

log = logging.getLogger(__name__)

CONFIRMED = 2
"""So many looks one after the other must name the same change before it is told."""

OLD_DAYS = 7.0
"""What was found by a look longer ago than this is told with the age first."""

SILENT = 3
"""So many looks since the last that knew anything, and it is not known any more that all is well."""

SLOW_LOOKS, SLOW_GAIN = 5, 9.0
"""A change is told as slow if so many looks follow a slope better than a step, by so much of chi-square."""


@dataclass(frozen=True)
class SentinelStanding:
    """What the looks say together.

    level
        ``good``, ``bad`` for a change that two looks name alike, ``unsure`` for none, one, or silent ones.
    sentence
        For a person.
    looks
        How many there were.
    since
        The first look that saw the change; of a slow one, when it began (ISO 8601). None without a change.
    """

    level: str
    sentence: str
    looks: int
    since: str | None


def standing(reference: Reference, looks: Sequence[Mapping[str, Any]], now: datetime) -> SentinelStanding:
    """Return what the looks at a reference say together; ``now`` for how long ago."""
    telling = [look for look in looks if look["views"]]
    if not telling:
        words = (
            f"no look yet at the reference of {ago(reference.time, now)}"
            if not looks
            else f"{_looks(len(looks))} saw nothing they knew: night, fog, other light, another place? "
            f"The last {ago(looks[-1]['time'], now)}"
        )
        return SentinelStanding("unsure", words, len(looks), None)
    last = telling[-1]
    silent = len(looks) - 1 - max(at for at, look in enumerate(looks) if look["views"])
    blind = f"; {_looks(silent)} since then saw nothing they knew" if silent else ""
    seen = f"last looked {ago(last['time'], now)}"
    if not last["named"]:
        words = f"nothing has changed, {_looks(len(telling))}, {seen}{blind}"
        return SentinelStanding("good" if silent < SILENT else "unsure", words, len(looks), None)
    alike = 0
    for look in reversed(telling):
        if look["named"] != last["named"]:
            break
        alike += 1
    first = telling[-alike]["time"]
    if alike < CONFIRMED:
        words = f"{last['sentence']}, seen once {ago(first, now)}: look again{blind}"
        return SentinelStanding("unsure", words, len(looks), first)
    course = slow_course(reference.time, telling, last["named"])
    if course is not None:
        per_day, first = course
        rate = f"{1e3 * abs(per_day):.2g} {_unit(last['named'])} a day"
        words = f"grown slowly, {rate}, since {for_long(first, now)}"
    else:
        words = f"since {for_long(first, now)}"
    old = (age := age_s(last["time"], now)) is not None and age > 86400.0 * OLD_DAYS
    words = f"{last['sentence']}, {words}{f' ({seen})' if old else ''}{blind}"
    return SentinelStanding("bad", words, len(looks), first)


def findings(folder: Path, mast_digest: str) -> dict[str, Any]:
    """Return what a folder says, as ``GET /sentinel`` tells it; ``mast_digest``: of the mast file in use."""
    return told(*read_folder(folder), mast_digest, datetime.now(UTC))


def read_folder(folder: Path) -> tuple[Reference | None, list[dict[str, Any]], str]:
    """Return a folder's reference and looks, and what is wrong with them; (None, [], '') without any."""
    if not (folder / REFERENCE).is_file():
        return None, [], ""
    try:
        reference = read_reference(folder)
        return reference, read_looks(folder, reference), ""
    except BadFile as error:
        return None, [], str(error)


def told(
    reference: Reference | None,
    looks: Sequence[Mapping[str, Any]],
    wrong: str,
    mast_digest: str,
    now: datetime,
) -> dict[str, Any]:
    """Return what `read_folder` found as the daemon tells it."""
    found: dict[str, Any] = {
        "level": "none", "sentence": "no reference pictures have been taken", "looks": 0, "since": None,
        "last_look": None, "age_s": None, "reference": None,
    }  # fmt: skip
    if wrong:
        return {**found, "level": "unsure", "sentence": wrong}
    if reference is None:
        return found
    says = standing(reference, looks, now)
    level, sentence = says.level, says.sentence
    if reference.mast_digest != mast_digest:
        level, sentence = "unsure", f"the reference is of another mast file: take a new one ({sentence})"
    last = looks[-1]["time"] if looks else None
    return {
        "level": level, "sentence": sentence, "looks": says.looks, "since": says.since, "last_look": last,
        "age_s": None if last is None or (age := age_s(last, now)) is None else max(age, 0.0),
        "reference": reference.time,
    }  # fmt: skip


def slow_course(begin: str, looks: Sequence[Mapping[str, Any]], what: str) -> tuple[float, str] | None:
    """Return by how much a change grows a day and since when, None if it came at once.

    Fitted to what each look measured of it: nothing until some moment, then a slope, against nothing until
    some moment, then a step.

    Parameters
    ----------
    begin
        When the reference was taken.
    looks
        Those that told something, oldest first.
    what
        The change's name.
    """
    days, sizes, sigmas = _history(begin, looks, what)
    if len(days) < SLOW_LOOKS or not (np.diff(days) >= 0.0).all():
        return None
    steps = [_left_chi2((days >= onset).astype(np.float64), sizes, sigmas)[0] for onset in days]
    onsets = np.concatenate([[0.0], days[:-2]])
    slopes = [_left_chi2(np.maximum(days - onset, 0.0), sizes, sigmas) for onset in onsets]
    best = int(np.argmin([left for left, _ in slopes]))
    left, per_day = slopes[best]
    if left > min(steps) - SLOW_GAIN:
        return None
    since = begin if best == 0 else next(
        look["time"] for look in looks if _days(begin, look["time"]) >= onsets[best]
    )  # fmt: skip
    return per_day, since


def _left_chi2(shape: FloatArray, sizes: FloatArray, sigmas: FloatArray) -> tuple[float, float]:
    """Chi-square that a course of this shape leaves, and its factor."""
    weights = 1.0 / sigmas**2
    factor = float(np.sum(weights * shape * sizes) / max(np.sum(weights * shape**2), 1e-300))
    return float(np.sum(weights * (sizes - factor * shape) ** 2)), factor


def _history(begin: str, looks: Sequence[Mapping[str, Any]], what: str) -> tuple[FloatArray, ...]:
    """Days since the reference, size of a change along its main axis, its sigma; of each look that has it."""
    main = None
    rows: list[tuple[float, float, float]] = []
    for look in reversed(looks):
        try:
            measured = look["changes"][what]
            values, sigma = (np.array(measured[key], dtype=np.float64) for key in ("values", "sigma"))
            main = int(np.abs(values).argmax()) if main is None else main
            row = _days(begin, look["time"]), float(values[main]), float(sigma[main])
        except (KeyError, TypeError, ValueError, IndexError):
            continue
        if np.isfinite(row).all() and row[2] > 0.0:
            rows.append(row)
    table = np.array(rows[::-1]).reshape(-1, 3)
    return table[:, 0], table[:, 1], table[:, 2]


def _unit(what: str) -> str:
    return "‰" if what.endswith("refocused") else "mrad"


def _looks(count: int) -> str:
    return f"{count} look" + "s" * (count != 1)


def _days(begin: str, end: str) -> float:
    passed = datetime.fromisoformat(end).astimezone(UTC) - datetime.fromisoformat(begin).astimezone(UTC)
    return passed.total_seconds() / 86400.0


def age_s(time: str, now: datetime) -> float | None:
    """Return how long ago a time (ISO 8601) was, seconds; less than 0: it is to come; None: it is none."""
    try:
        return (now - datetime.fromisoformat(time).astimezone(UTC)).total_seconds()
    except (ValueError, TypeError, OverflowError):
        return None


def for_long(time: str, now: datetime) -> str:
    """Return how long ago in words: ``3 days``."""
    age = age_s(time, now)
    if age is None:
        return "an unknown time"
    hours = abs(age) / 3600.0
    if hours < 1.0:
        words = f"{60.0 * hours:.0f} min"
    else:
        words = f"{hours:.0f} h" if hours < 48.0 else f"{hours / 24.0:.0f} days"
    return words if age > -90.0 else f"a time {words} ahead of this clock"


def ago(time: str, now: datetime) -> str:
    """Return when that was in words: ``3 days ago``."""
    age = age_s(time, now)
    words = for_long(time, now)
    return f"at {words}" if age is None or age <= -90.0 else f"{words} ago"


POLL_S = 2.0
ANEW_S = 60.0
"""Sentences hold how long ago something was, and are made anew so often."""

CLOSE_S = 2.0


class SentinelFindings:
    """What the looks in a folder say, as of a few seconds ago; reading it waits for nothing.

    Parameters
    ----------
    folder
        Where a sentinel keeps its reference and looks; need not be there.
    mast_digest
        Returns that of the mast file in use.
    """

    def __init__(self, folder: Path, mast_digest: Callable[[], str]) -> None:
        self._folder = folder
        self._mast_digest = mast_digest
        self._found: dict[str, Any] | None = None
        self._level = "none"
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._work, name="sentinel findings", daemon=True)
        self._thread.start()

    def told(self) -> dict[str, Any] | None:
        """Return what ``GET /sentinel`` tells, None before it was read for the first time."""
        found = self._found
        if found is None or found["last_look"] is None:
            return found
        age = age_s(found["last_look"], datetime.now(UTC))
        return {**found, "age_s": None if age is None else max(age, 0.0)}

    def close(self) -> None:
        """Read no more; bounded."""
        self._ended.set()
        self._thread.join(CLOSE_S)

    # In the thread

    def _work(self) -> None:
        known: object = None
        while True:
            mark = self._mark(), self._mast_digest(), datetime.now(UTC).timestamp() // ANEW_S
            if mark != known:
                known = mark
                try:
                    self._say(findings(self._folder, mark[1]))
                except Exception:  # a file that nobody foresaw must not end the watch
                    log.exception("the sentinel's findings in %s met a defect of the program", self._folder)
            if self._ended.wait(POLL_S):
                return

    def _mark(self) -> tuple[tuple[int, int] | None, ...]:
        """What changes whenever one of the files does."""
        marks: list[tuple[int, int] | None] = []
        for name in (REFERENCE, LOOKS):
            try:
                about = (self._folder / name).stat()
            except OSError:
                marks.append(None)
            else:
                marks.append((about.st_mtime_ns, about.st_size))
        return tuple(marks)

    def _say(self, found: dict[str, Any]) -> None:
        """Let findings be known; a change that comes or goes is logged."""
        before, self._level, self._found = self._level, found["level"], found
        if self._level == "bad" and before != "bad":
            log.warning("drift sentinel: %s", found["sentence"])
        elif before == "bad" and self._level != "bad":
            log.info("drift sentinel: %s", found["sentence"])
