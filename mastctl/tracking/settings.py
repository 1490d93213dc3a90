"""How the daemon tracks, from the key ``tracking`` of its configuration."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from mastctl.tracking.choice import HandoffRules


@dataclass(frozen=True)
class TrackingSettings:
    """What may be set about tracking.

    Attributes
    ----------
    handoff
        Which pair looks.
    most_step
        Longest way between two poses that a track is carried over, as a part of the target's range. A tenth
        is a usual step; with three tenths the target is seen so differently that a longer way is taken for a
        pose that jumped.
    start_error
        How far from an asked position the target of a track may turn out to be, as a part of its range.
    named_pairs
        Pairs whose bounds were set; the mast file must have them.
    handoff_log
        Where hand-offs are written down; None: they are forgotten at the daemon's end.
    """

    handoff: HandoffRules = field(default_factory=HandoffRules)
    most_step: float = 0.3
    start_error: float = 0.1
    named_pairs: tuple[str, ...] = ()
    handoff_log: Path | None = None
