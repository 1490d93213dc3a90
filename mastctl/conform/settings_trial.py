"""Settings of a camera tried while it runs: changed by a little, read back, seen on new frames, put back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress

from drivers.interfaces import CameraSetting
from mastctl.conform.checks import NotTried, PromiseBroken, expect

FRAMES = 20  # so many may be of unknown settings after a change
PART = 0.05  # of its value a setting is changed by, one step at least
ROUNDING = 1e-6


def settings_tried(
    read: Callable[[], Sequence[CameraSetting]],
    adjust: Callable[[str, float], Sequence[str]],
    of_a_frame: Callable[[], Mapping[str, float | None]],
) -> str:
    """Try each setting that may be changed now but focus, and return their names.

    A focus is left alone: its motor may not come back to the calibrated place. ``read`` and ``adjust`` are as
    in `drivers.interfaces.Camera`; ``of_a_frame`` returns the settings of a frame exposed from now on. Raises
    PromiseBroken, and NotTried if there is none to try.
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
        for _ in range(FRAMES):
            value = of_a_frame().get(name)
            if value is not None:
                message = f"a frame exposed after {name} was set to {now:.6g} has {value:.6g}"
                expect(_same(value, now), message)
                return
        raise PromiseBroken(f"none of {FRAMES} frames after {name} was set has its value")

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
    by = max(one.step, PART * abs(one.value)) or PART * (one.maximum - one.minimum)
    if one.step:
        by = math.floor(by / one.step + ROUNDING) * one.step
    within = (other for other in (one.value + by, one.value - by) if one.minimum <= other <= one.maximum)
    return next(within, None) if by > 0.0 else None


def _same(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=ROUNDING, abs_tol=1e-12)
