"""Whether a unit still knows where its axes are. No I/O: it is told what was seen and what the unit said.

A unit counts steps and has no encoder. Inside its limits an axis runs into a limit switch (``!P``, ``!T``)
only when it has lost count; of an axis that stands still that is damaged bytes or a restart, so all of the
unit has to be checked again, its positions too. An axis that is somewhere else after the line was down has
lost count as well.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping

from drivers.flir_ptu.axis import StepAxis
from drivers.flir_ptu.options import DEVICE

log = logging.getLogger(__name__)

BRAKING_S = 0.5  # an axis that was under way when it was seen last may have gone on for so long
HIT = (
    "the {axis} axis ran into its limit switch, so the unit has lost count of its position; "
    "home it (mastctl ptu home)"
)
JUMPED = (
    "{axis} was at {before:.4f} rad before the unit or its line was away and is at {after:.4f} rad now, "
    "so the unit may have lost count; home it (mastctl ptu home)"
)


class StepCount:
    """What speaks against the positions that a unit tells.

    Attributes
    ----------
    lost
        By axis, why its count is lost, in words; empty while it is good. It stays lost.
    doubted
        Where the axes stood, rad, when a limit hit was told of one that stood still; empty if none was. To
        be checked, and then to be told by `look_back`.
    halt_owed
        Whether a moving axis has hit its limit since the unit was halted last (who halts it clears this).
    """

    def __init__(self) -> None:
        self.lost: dict[str, str] = {}
        self.doubted: dict[str, float] = {}
        self.halt_owed = False

    def hit(self, axis: str, axes: Mapping[str, StepAxis]) -> None:
        """Note a limit hit told of an axis; ``axes`` as they are known, empty before the unit is checked."""
        if self.doubted:
            return
        if axes and all(one.rests for one in axes.values()):
            log.warning("%s: a limit hit is told of the %s axis, which stands still", DEVICE, axis)
            self.doubted = {name: one.angle_rad for name, one in axes.items()}
            return
        self.halt_owed = True
        if axis not in self.lost:
            self.lost[axis] = HIT.format(axis=axis)
            log.warning("%s: %s", DEVICE, self.lost[axis])

    def look_back(self, axes: Mapping[str, StepAxis]) -> None:
        """Compare the axes, checked anew, with where they stood when a limit hit was told; that is over."""
        stood, self.doubted = self.doubted, {}
        for name, before_rad in stood.items():
            if abs(axes[name].angle_rad - before_rad) > 1.5 * axes[name].position_rad:
                self._note_jump(name, before_rad, axes[name].angle_rad)

    def compare(self, before: StepAxis, after: StepAxis) -> None:
        """Note a position, ``after``, that the axis cannot have reached since it was seen ``before``."""
        if before.seen is None or after.seen is None or after.name in self.lost:
            return
        ways = [before.angle_rad]
        slack_rad = 1.5 * max(before.position_rad, after.position_rad)
        if before.next_target is not None or not before.at_target:  # it may have gone on, and braked
            ends = (before.target, before.next_target)
            ways += [before.rad_from_position(end) for end in ends if end is not None]
            slack_rad += BRAKING_S * (before.speed or before.fastest) * before.position_rad
        if not min(ways) - slack_rad <= after.angle_rad <= max(ways) + slack_rad:
            self._note_jump(after.name, before.angle_rad, after.angle_rad)

    def _note_jump(self, axis: str, before_rad: float, after_rad: float) -> None:
        """An axis is where it cannot be by itself."""
        words = JUMPED.format(axis=axis, before=before_rad, after=after_rad)
        self.lost[axis] = words
        log.warning("%s: %s", DEVICE, words)
