"""The result of the looks at a reference: whether something has changed, by how much, and since when."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from itertools import takewhile
from pathlib import Path
from typing import Any, Literal

from calib.errors import BadFile
from mastctl.answers import SentinelTold
from mastctl.watch.journal import JournalThread
from mastctl.watch.reference import LOOKS, REFERENCE, Reference, read_looks, read_reference

log = logging.getLogger(__name__)

CONFIRMED = 2
"""So many looks one after the other must see a change before it is reported."""

OLD_DAYS = 7.0
"""What was found by a look longer ago than this is reported with the age first."""

SILENT = 3
"""So many looks since the last that knew anything, and it is not known any more that all is well."""


def standing(reference: Reference, looks: Sequence[Mapping[str, Any]], now: datetime) -> SentinelTold:
    """Return what the looks at a reference say together; ``now`` for how long ago.

    ``bad`` for a change that two looks see, ``unsure`` for no look, one, or silent ones.
    """
    level, sentence, since = _judged(reference, looks, now)
    last = looks[-1]["time"] if looks else None
    return {
        "level": level, "sentence": sentence, "looks": len(looks), "since": since, "last_look": last,
        "age_s": _age_of(last, now), "reference": reference.time,
    }  # fmt: skip


def _judged(
    reference: Reference, looks: Sequence[Mapping[str, Any]], now: datetime
) -> tuple[Literal["good", "unsure", "bad"], str, str | None]:
    """The level, its sentence, and the first look that saw the change (ISO 8601)."""
    telling = [look for look in looks if look["views"]]
    if not telling:
        sentence = (
            f"no look yet at the reference of {ago(reference.time, now)}"
            if not looks
            else f"{_looks(len(looks))} saw nothing they knew: night, fog, other light, another place? "
            f"The last {ago(looks[-1]['time'], now)}"
        )
        return "unsure", sentence, None
    last = telling[-1]
    silent = len(looks) - 1 - max(at for at, look in enumerate(looks) if look["views"])
    blind = f"; {_looks(silent)} since then saw nothing they knew" if silent else ""
    seen = f"last looked {ago(last['time'], now)}"
    if not last["changed"]:
        sentence = f"nothing has changed, {_looks(len(telling))}, {seen}{blind}"
        return "good" if silent < SILENT else "unsure", sentence, None
    alike = len(list(takewhile(lambda look: look["changed"], reversed(telling))))
    first = telling[-alike]["time"]
    if alike < CONFIRMED:
        return "unsure", f"{last['sentence']}, seen once {ago(first, now)}: look again{blind}", first
    old = (age := age_s(last["time"], now)) is not None and age > 86400.0 * OLD_DAYS
    sentence = f"{last['sentence']}, since {for_long(first, now)}{f' ({seen})' if old else ''}{blind}"
    return "bad", sentence, first


def _age_of(look: str | None, now: datetime) -> float | None:
    """How long ago a look was, seconds."""
    age = None if look is None else age_s(look, now)
    return None if age is None else max(age, 0.0)


def findings(folder: Path, mast_digest: str, now: datetime | None = None) -> SentinelTold:
    """Return what a folder says, as ``GET /sentinel`` has it; ``mast_digest``: of the mast file in use."""
    reference, looks, wrong = read_folder(folder)
    if reference is None:
        return {
            "level": "unsure" if wrong else "none",
            "sentence": wrong or "no reference pictures have been taken",
            "looks": 0, "since": None, "last_look": None, "age_s": None, "reference": None,
        }  # fmt: skip
    found = standing(reference, looks, now or datetime.now(UTC))
    if reference.mast_digest != mast_digest:
        sentence = f"the reference is of another mast file: take a new one ({found['sentence']})"
        found |= {"level": "unsure", "sentence": sentence}
    return found


def read_folder(folder: Path) -> tuple[Reference | None, list[dict[str, Any]], str]:
    """Return a folder's reference and looks, and what is wrong with them; (None, [], '') without any."""
    if not (folder / REFERENCE).is_file():
        return None, [], ""
    try:
        reference = read_reference(folder)
        return reference, read_looks(folder, reference), ""
    except BadFile as error:
        return None, [], str(error)


def _looks(count: int) -> str:
    return f"{count} look" + "s" * (count != 1)


def age_s(time: str, now: datetime) -> float | None:
    """Return how long ago a time (ISO 8601) was, seconds; less than 0: it is to come; None: it is none."""
    try:
        return (now - datetime.fromisoformat(time).astimezone(UTC)).total_seconds()
    except (ValueError, TypeError, OverflowError):
        return None


def for_long(time: str, now: datetime) -> str:
    """Return how long ago that was, as ``3 days``."""
    age = age_s(time, now)
    if age is None:
        return "an unknown time"
    hours = abs(age) / 3600.0
    if hours < 1.0:
        text = f"{60.0 * hours:.0f} min"
    else:
        text = f"{hours:.0f} h" if hours < 48.0 else f"{hours / 24.0:.0f} days"
    return text if age > -90.0 else f"a time {text} ahead of this clock"


def ago(time: str, now: datetime) -> str:
    """Return when that was, as ``3 days ago``."""
    age = age_s(time, now)
    text = for_long(time, now)
    return f"at {text}" if age is None or age <= -90.0 else f"{text} ago"


RENEWED_S = 60.0
"""Sentences say how long ago something was, and are made anew so often."""


class SentinelFindings:
    """What the looks in a folder say, as of a few seconds ago; reading it waits for nothing."""

    def __init__(self, folder: Path, mast_digest: Callable[[], str], thread: JournalThread) -> None:
        self._folder = folder
        self._mast_digest = mast_digest
        self._found: SentinelTold | None = None
        self._level = "none"
        self._read: object = None
        thread.poll(self._poll)

    def summary(self) -> SentinelTold | None:
        """Return the answer of ``GET /sentinel``, None before the folder was read for the first time."""
        found = self._found
        return found and {**found, "age_s": _age_of(found["last_look"], datetime.now(UTC))}

    # In the journals' thread

    def _poll(self) -> None:
        mark = self._mark(), self._mast_digest(), datetime.now(UTC).timestamp() // RENEWED_S
        if mark != self._read:
            self._read = mark
            self._publish(findings(self._folder, mark[1]))

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

    def _publish(self, found: SentinelTold) -> None:
        """Publish findings; a change that comes or goes is logged."""
        before, self._level, self._found = self._level, found["level"], found
        if self._level == "bad" and before != "bad":
            log.warning("drift sentinel: %s", found["sentence"])
        elif before == "bad" and self._level != "bad":
            log.info("drift sentinel: %s", found["sentence"])
