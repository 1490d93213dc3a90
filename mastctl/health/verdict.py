"""What the evidence means, in one sentence and as JSON."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Literal

from mastctl.health.evidence import Evidence
from mastctl.health.windows import FALSE_ALARMS_PER_DAY, FEWEST, LOG_THRESHOLD

Word = Literal["good", "drifts", "few", "unknown"]

AS_LIKELY = math.log(20.0)
"""Cameras whose evidence is nearer than this to the strongest one's cannot be told from it."""


@dataclass(frozen=True)
class Verdict:
    """Whether pointings come out as the mast file predicts.

    Attributes
    ----------
    word
        ``good``; ``drifts``; ``few`` pointings yet; ``unknown``: the mast file does not say how sure it is.
    sentence
        What that means.
    pointings
        How many count.
    since
        When the first of those was that speak against it (ISO 8601, UTC); None unless it drifts.
    times
        As how many times as large as expected residuals are, rms, all that is common taken out.
    turned
        By camera: how far it seems turned about each axis of the frame that it is mounted on, with one
        sigma, and the decimal logarithm of the evidence for that.
    """

    word: Word
    sentence: str
    pointings: int = 0
    since: str | None = None
    times: float | None = None
    log10_evidence: float | None = None
    turned: dict[str, dict[str, Any]] = field(default_factory=dict)

    def told(self) -> dict[str, Any]:
        """Return the short form, of ``GET /status``."""
        return {
            "verdict": self.word,
            "sentence": self.sentence,
            "pointings": self.pointings,
            "since": self.since,
        }

    def told_whole(self) -> dict[str, Any]:
        """Return all of it."""
        return self.told() | {
            "times_expected": self.times,
            "log10_evidence": self.log10_evidence,
            "log10_threshold": LOG_THRESHOLD / math.log(10),
            "false_alarms_per_day": FALSE_ALARMS_PER_DAY,
            "cameras": self.turned,
        }


NOTHING_YET = Verdict("few", f"fewer than {FEWEST} pointings with this mast file have a residual")


def verdict_of(evidence: Evidence | None, pointings: int) -> Verdict:
    """Return what is to be said of the evidence of the loudest window."""
    if evidence is None:
        return Verdict("few", NOTHING_YET.sentence, pointings)
    since = datetime.fromtimestamp(evidence.since_s, UTC).isoformat(timespec="seconds")
    drifts = evidence.log_evidence >= LOG_THRESHOLD
    return Verdict(
        "drifts" if drifts else "good",
        _what_drifts(evidence, since) if drifts else "residuals are as the mast file predicts",
        pointings,
        since if drifts else None,
        evidence.times,
        evidence.log_evidence / math.log(10),
        {
            name: {
                "turn_rad": list(one.turn_rad),
                "sigma_rad": list(one.sigma_rad),
                "log10_evidence": one.log_evidence / math.log(10),
            }
            for name, one in evidence.turned.items()
        },
    )


def _what_drifts(evidence: Evidence, since: str) -> str:
    """What drifts, by how much, since when, and what to do."""
    which = f"{evidence.count + 1} pointings since {since}"
    strongest = max(evidence.turned.values(), key=lambda one: one.log_evidence, default=None)
    if strongest is None or evidence.log_wider >= strongest.log_evidence:
        return (
            f"residuals are {evidence.times:.1f} times as large as the mast file, counts and matches explain "
            f"({which}), and no one camera accounts for it: look at the head's mount and gears, or calibrate "
            "again"
        )
    likely = {
        name: one
        for name, one in sorted(evidence.turned.items(), key=lambda item: -item[1].log_evidence)
        if one.log_evidence > strongest.log_evidence - AS_LIKELY
    }
    cameras = " or ".join(likely)
    size = f"{1e3 * strongest.size_rad:.1f} ± {1e3 * strongest.size_sigma_rad:.1f} mrad"
    return (
        f"{cameras} looks {size} beside where the mast file has it ({which}): look at its mount, then "
        "calibrate again"
    )
