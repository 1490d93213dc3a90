"""The pointings of the last days, and since when they speak against the mast file.

Windows begin every six hours and last until now; each is judged by itself, so that what began on Tuesday is
not watered down by Monday. A window's evidence exceeds 4000 by chance in one of 4000 at most, however many
pointings come and whenever it is looked at; with four windows a day that is one false alarm in a thousand
days. The pointing that is farthest off does not count in a window: one false match is no drift.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add, sub

import numpy as np

from calib.errors import CalibError
from calib.geometry.covariance import stored_covariance
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from mastctl.health.evidence import Evidence, Judge, Sums, sums_of
from mastctl.health.expected import Expected, expected
from mastctl.health.measured import Measured

DAYS = 7
DAY_S = 86400.0
SPAN_S = 6 * 3600.0
FALSE_ALARMS_PER_DAY = 1e-3
LOG_THRESHOLD = math.log(DAY_S / SPAN_S / FALSE_ALARMS_PER_DAY)
FEWEST = 3
"""Pointings that a judgement needs."""
KEPT = 2000
"""Newest pointings that count."""


@dataclass(frozen=True, eq=False)
class Judged:
    """A pointing, what it depends on, and how far off it is by itself.

    ``sigma_px``: one sigma of each coordinate, of everything together; ``square``: of both, over that.
    """

    measured: Measured
    expected: Expected
    sigma_px: tuple[float, float]
    square: float


class Windows:
    """The pointings with one mast file; used by one thread.

    Parameters
    ----------
    rig, mast_digest
        The mast file.

    Raises
    ------
    CalibError
        If it has no covariance, or one that is none: then nothing can be expected of it.
    """

    def __init__(self, rig: Rig, mast_digest: str) -> None:
        covariance = stored_covariance(rig)
        if covariance is None:
            raise CalibError("the mast file does not say how sure it is (fit.covariance)")
        self._rig = rig
        self._digest = mast_digest
        self._parameters = covariance.names
        self._covariance: FloatArray = covariance.covariance
        self._cameras = tuple(rig.cameras)
        self._judge = Judge(covariance.covariance, self._cameras)
        self._spans: dict[int, list[Judged]] = {}
        self._sums: dict[int, Sums] = {}

    @property
    def pointings(self) -> Sequence[Judged]:
        """Those that count, oldest first."""
        return [one for span in sorted(self._spans) for one in self._spans[span]]

    def add(self, one: Measured) -> Judged | None:
        """Count a pointing; None if it is of another mast file, or cannot be judged by this one."""
        if one.mast_digest != self._digest:
            return None
        try:
            depends = expected(self._rig, self._parameters, self._cameras, one)
        except CalibError:
            return None
        total = depends.noise_px2 + depends.rates @ self._covariance @ depends.rates.T
        off = np.array(one.off_px)
        sigma = np.sqrt(np.diag(total)).tolist()
        square = float(off @ np.linalg.solve(total, off))
        judged = Judged(one, depends, (sigma[0], sigma[1]), square)
        span = math.floor(one.time_s / SPAN_S)
        sums = _sums(judged)
        self._sums[span] = self._sums[span] + sums if span in self._sums else sums
        self._spans.setdefault(span, []).append(judged)
        return judged

    def forget(self, now_s: float) -> None:
        """Let go of what is older than the days that count, and of what is too many."""
        oldest = math.floor((now_s - DAYS * DAY_S) / SPAN_S)
        for span in sorted(self._spans):
            too_many = sum(map(len, self._spans.values())) > KEPT and len(self._spans) > 1
            if span < oldest or too_many:
                del self._spans[span], self._sums[span]

    def evidence(self) -> Evidence | None:
        """Return that of the window which speaks loudest; None with too few pointings."""
        found: Evidence | None = None
        spans = sorted(self._spans, reverse=True)
        for number in range(1, len(spans) + 1):
            window = spans[:number]
            sums = reduce(add, (self._sums[span] for span in window))
            if sums.count < FEWEST:
                continue
            worst = max((one for span in window for one in self._spans[span]), key=lambda one: one.square)
            doubtful = [one for span in window for one in self._spans[span] if not one.measured.confirmed]
            kept = sums - _sums(worst)
            without = (_sums(one) for one in doubtful if one is not worst)
            now = self._judge.weigh(kept, reduce(sub, without, kept))
            if found is None or now.log_evidence > found.log_evidence:
                found = now
        return found


def _sums(one: Judged) -> Sums:
    return sums_of(one.expected, one.measured.off_px, one.measured.time_s)
