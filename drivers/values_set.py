"""Which value of a camera's setting a frame has while it is changed: the former, the new one, or unknown."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

from drivers.errors import BadSetting, DriverError

SAME = 1e-6  # of a value that went through the camera's own number format

SETTLE_FRAMES = 4
"""So many frames stamped after a change may still show what was set before it: the one that was being read
out when it was made, and three more."""


@dataclass
class _Setting:
    """A value and when it was in force; ``over_at`` is the first count that cannot show it."""

    value: float | None
    since_s: float
    until_s: float | None = None
    over_at: int | None = None


class ValuesSet:
    """The values of one setting on one stream, as long as a frame may show them; safe from any thread.

    ``value`` is the one in force from the first frame on; None if that is not known.
    """

    def __init__(self, value: float | None) -> None:
        self._settings = [_Setting(value, float("-inf"))]
        self._lock = threading.Lock()

    @property
    def newest(self) -> float | None:
        """The value that was set last; None if that is not known."""
        return self._settings[-1].value

    @property
    def settled(self) -> bool:
        """Whether the last frame could show nothing but the newest value."""
        return len(self._settings) == 1

    def begin(self, began_s: float) -> None:
        """Take in that another one is being set from a moment of CLOCK_MONOTONIC on."""
        with self._lock:
            self._settings.append(_Setting(None, began_s))

    def end(self, value: float | None, ended_s: float) -> None:
        """Take in which one it has become."""
        with self._lock:
            self._settings[-2].until_s = ended_s
            self._settings[-1].value = value

    def change(self, value: float | None, began_s: float, ended_s: float) -> None:
        """Take in that another one was set, between two moments of CLOCK_MONOTONIC."""
        self.begin(began_s)
        self.end(value, ended_s)

    def of(
        self, sequence: int, stamp_s: float, began_s: float | None = None
    ) -> tuple[float | None, float | None]:
        """Return a frame's value and the highest that it may have; None for what is not known.

        Frames are requested in their order; one that was stamped before a change knows nothing of it.
        ``began_s`` is given where a frame's exposure may have begun before its stamp: then a frame counts as
        later than a change only if it began after it.
        """
        if len(self._settings) == 1:
            return self._settings[0].value, self._settings[0].value
        with self._lock:
            return self._of(sequence, stamp_s, stamp_s if began_s is None else began_s)

    def _of(self, sequence: int, stamp_s: float, began_s: float) -> tuple[float | None, float | None]:
        found: list[float | None] = []
        for setting in self._settings:
            if setting.until_s is not None and setting.over_at is None and began_s > setting.until_s:
                setting.over_at = sequence + SETTLE_FRAMES
            if setting.since_s <= stamp_s and (setting.over_at is None or sequence < setting.over_at):
                found.append(setting.value)
        while self._settings[0].over_at is not None and sequence >= self._settings[0].over_at:
            del self._settings[0]
        known = [value for value in found if value is not None]
        if len(known) < len(found):
            return None, None
        highest = max(known)
        return (highest if min(known) == highest else None), highest


SetOne = Callable[[str, float], tuple[float | None, str, str]]
"""Sets one setting, by name; returns its value now, why it was refused, and what bounds its values."""


def change_each(
    wanted: Iterable[tuple[str, float]],
    in_force: Mapping[str, ValuesSet],
    set_one: SetOne,
    now_s: Callable[[], float],
    device: str,
) -> tuple[dict[str, float], list[str], DriverError | None]:
    """Change settings one after the other, and note from which frame on each is in force.

    Returns the new value of each that was changed, as the camera has it; a sentence for each that became
    another than requested; and the error of one that the camera did not take, those behind it left alone.
    """
    became: dict[str, float] = {}
    notes: list[str] = []
    for name, value in wanted:
        if name not in in_force:
            return became, notes, BadSetting(f"it has no control for {name}", device=device)
        in_force[name].begin(now_s())
        now = None
        try:
            now, refused, bounds = set_one(name, value)
        except DriverError as error:
            return became, notes, error
        finally:
            in_force[name].end(now, now_s())
        if refused or now is None:
            reason = refused or "its automatic stays on"
            return became, notes, BadSetting(f"{name} was not changed: {reason}", device=device)
        became[name] = now
        if not math.isclose(now, value, rel_tol=SAME, abs_tol=1e-12):
            notes.append(f"{device}: {name} is {now:.6g} where {value:.6g} was requested{bounds}")
    return became, notes, None
