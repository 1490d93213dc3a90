"""A check of a rig or a device, the outcomes of many as a report, and the check of a camera's settings."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from typing import Any, Literal

from drivers.errors import DriverError
from drivers.interfaces import CameraSetting
from mastctl.client import ClientError

SETTING_FRAMES = 20  # so many may be of unknown settings after a change
SETTING_PART = 0.05  # of its value a setting is changed by, one step at least
ROUNDING = 1e-6


class PromiseBroken(AssertionError):
    """What was promised does not hold; the message says what was found and what would be right."""


class NotTried(Exception):
    """The check does not apply to this device or daemon, or could not tell; the message says why."""


class SubjectLost(Exception):
    """What is tested does not answer any more: the checks that would follow cannot be tried."""


@dataclass(frozen=True)
class Check:
    """One promise, a sentence, and the function that tests it.

    ``name`` is ``group.name``; ``moves``: whether the head moves for it, or would if the promise were broken.
    ``test`` returns a short text of what was measured, and raises PromiseBroken or NotTried.
    """

    name: str
    promise: str
    moves: bool
    test: Callable[[Any], str | None]


@dataclass(frozen=True)
class CheckOutcome:
    """The outcome of a check; ``message`` says what was measured, what is wrong, or why it was skipped."""

    name: str
    promise: str
    state: Literal["passed", "failed", "skipped"]
    message: str
    duration_s: float


@dataclass(frozen=True)
class ConformReport:
    """The outcomes of the checks of one rig; ``subject`` is the daemon's address.

    ``may_move`` is why the head may still move, one sentence; empty when it was stopped, or never moved.
    """

    subject: str
    outcomes: Sequence[CheckOutcome]
    may_move: str = ""

    @property
    def conforms(self) -> bool:
        """Whether no check failed, one at least passed, and the head is at rest."""
        return self.counts["failed"] == 0 < self.counts["passed"] and not self.may_move

    @property
    def counts(self) -> dict[str, int]:
        """How many passed, failed and were skipped."""
        counted = Counter(outcome.state for outcome in self.outcomes)
        return {"passed": counted["passed"], "failed": counted["failed"], "skipped": counted["skipped"]}

    def as_json(self) -> dict[str, Any]:
        """Return it as JSON."""
        return {
            "kind": "daemon",
            "subject": self.subject,
            "conforms": self.conforms,
            **self.counts,
            "may_move": self.may_move,
            "duration_s": sum(outcome.duration_s for outcome in self.outcomes),
            "checks": [asdict(outcome) for outcome in self.outcomes],
        }


def expect(holds: object, message: str) -> None:
    """Raise PromiseBroken unless something holds."""
    if not holds:
        raise PromiseBroken(message)


def outcome_of(check: Check, rig: Any) -> CheckOutcome:
    """Run one check. Raises SubjectLost."""
    began_s = time.monotonic()
    state: Literal["passed", "failed", "skipped"] = "failed"
    try:
        state, message = "passed", check.test(rig) or ""
    except NotTried as reason:
        state, message = "skipped", str(reason)
    except SubjectLost:
        raise
    except (PromiseBroken, DriverError, ClientError) as error:
        if isinstance(error, ClientError) and error.code == "no_daemon":
            raise SubjectLost(str(error)) from None
        message = str(error)
    except Exception as error:  # a daemon of another version may answer anything
        message = f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
    return CheckOutcome(check.name, check.promise, state, message, time.monotonic() - began_s)


def settings_tried(
    read: Callable[[], Sequence[CameraSetting]],
    adjust: Callable[[str, float], Sequence[str]],
    of_a_frame: Callable[[], Mapping[str, float | None]],
) -> str:
    """Try each setting of a camera that may be changed now but focus, and return their names.

    Each is changed by a little, read back, seen on new frames, and put back. A focus is left alone: its motor
    may not come back to the calibrated place. ``read`` and ``adjust`` are as in `drivers.interfaces.Camera`;
    ``of_a_frame`` returns the settings of a frame exposed from now on. Raises PromiseBroken, and NotTried if
    there is none to try.
    """

    def value_of(name: str) -> float | None:
        return next((one.value for one in read() if one.name == name), None)

    def change(name: str, other: float) -> None:
        """Set another value, and follow it to a frame."""
        notes = adjust(name, other)
        now = value_of(name)
        if now is None:
            raise PromiseBroken(f"{name} is not known after it was set to {other:.6g}")
        message = f"{name} is {now:.6g} where {other:.6g} was set, and no note says so"
        expect(_same(now, other) or notes, message)
        for _ in range(SETTING_FRAMES):
            value = of_a_frame().get(name)
            if value is not None:
                message = f"a frame exposed after {name} was set to {now:.6g} has {value:.6g}"
                expect(_same(value, now), message)
                return
        raise PromiseBroken(f"none of {SETTING_FRAMES} frames after {name} was set has its value")

    tried = []
    for one in read():
        other = _beside(one)
        if other is None or one.value is None:
            continue
        try:
            change(one.name, other)
        except BaseException:
            with suppress(Exception):  # the first error counts
                adjust(one.name, one.value)
            raise
        adjust(one.name, one.value)
        back = value_of(one.name)
        message = f"{one.name} is {back} where {one.value:.6g} was put back"
        expect(back is not None and _same(back, one.value), message)
        tried.append(one.name)
    if not tried:
        raise NotTried("it has no setting but focus that can be changed now")
    return ", ".join(tried)


def _beside(one: CameraSetting) -> float | None:
    """A value beside the present one, within the bounds; None if it is not to be tried."""
    if one.name == "focus" or one.value is None or one.automatic or one.refusal:
        return None
    by = max(one.step, SETTING_PART * abs(one.value)) or SETTING_PART * (one.maximum - one.minimum)
    if one.step:
        by = math.floor(by / one.step + ROUNDING) * one.step
    within = (other for other in (one.value + by, one.value - by) if one.minimum <= other <= one.maximum)
    return next(within, None) if by > 0.0 else None


def _same(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=ROUNDING, abs_tol=1e-12)
