"""The verdict of the last days' residuals on the mast file.

Windows begin every six hours and last until now; each is judged by itself, so that what began on Tuesday is
not watered down by Monday. A window's evidence exceeds 4000 by chance in one of 4000 at most, however many
pointings come and whenever it is looked at; with four windows a day that is one false alarm in a thousand
days. The pointing that is farthest off does not count in a window: one false match is no drift.
"""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import reduce
from operator import add, sub
from pathlib import Path
from typing import Literal

import numpy as np

from calib.errors import CalibError
from calib.files.mast_file import StoredRig
from calib.geometry.covariance import stored_covariance
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from mastctl.answers import CalibrationAnswer, CountedPointing, ResidualVerdict, SelfCheck, SentinelAnswer
from mastctl.control.operations import Operation
from mastctl.watch.evidence import (
    Evidence,
    Expected,
    Judge,
    Measured,
    Sums,
    expected,
    measured_by,
    pointing_journal,
    sums_of,
)
from mastctl.watch.journal import JournalThread

log = logging.getLogger(__name__)

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

    Raises CalibError if it has no covariance, or one that is none: then nothing can be expected of it.
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
        if one["mast_digest"] != self._digest:
            return None
        try:
            depends = expected(self._rig, self._parameters, self._cameras, one)
        except CalibError:
            return None
        total = depends.noise_px2 + depends.rates @ self._covariance @ depends.rates.T
        off = np.array(one["off_px"])
        sigma = np.sqrt(np.diag(total)).tolist()
        square = float(off @ np.linalg.solve(total, off))
        judged = Judged(one, depends, (sigma[0], sigma[1]), square)
        span = math.floor(one["time_s"] / SPAN_S)
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
        """Return that of the window with the strongest; None with too few pointings."""
        found: Evidence | None = None
        spans = sorted(self._spans, reverse=True)
        for number in range(1, len(spans) + 1):
            window = spans[:number]
            sums = reduce(add, (self._sums[span] for span in window))
            if sums.count < FEWEST:
                continue
            worst = max((one for span in window for one in self._spans[span]), key=lambda one: one.square)
            doubtful = [one for span in window for one in self._spans[span] if not one.measured["confirmed"]]
            kept = sums - _sums(worst)
            without = (_sums(one) for one in doubtful if one is not worst)
            now = self._judge.weigh(kept, reduce(sub, without, kept))
            if found is None or now.log_evidence > found.log_evidence:
                found = now
        return found


def _sums(one: Judged) -> Sums:
    return sums_of(one.expected, one.measured["off_px"], one.measured["time_s"])


AS_LIKELY = math.log(20.0)
"""Cameras whose evidence is nearer than this to the strongest one's cannot be distinguished from it."""


def residual_verdict(
    verdict: Literal["good", "drifts", "few", "unknown"],
    sentence: str,
    pointings: int = 0,
    since: str | None = None,
    evidence: Evidence | None = None,
) -> ResidualVerdict:
    """Return a verdict with the figures of its evidence.

    ``since``: when the first of those pointings was that speak against the mast file (ISO 8601, UTC).
    """
    turned = {} if evidence is None else evidence.turned
    return {
        "verdict": verdict,
        "sentence": sentence,
        "pointings": pointings,
        "since": since,
        "times_expected": None if evidence is None else evidence.times,
        "log10_evidence": None if evidence is None else evidence.log_evidence / math.log(10),
        "log10_threshold": LOG_THRESHOLD / math.log(10),
        "false_alarms_per_day": FALSE_ALARMS_PER_DAY,
        "cameras": {
            name: {
                "turn_rad": list(one.turn_rad),
                "sigma_rad": list(one.sigma_rad),
                "log10_evidence": one.log_evidence / math.log(10),
            }
            for name, one in turned.items()
        },
    }


TOO_FEW = f"fewer than {FEWEST} pointings with this mast file have a residual"


def verdict_of(evidence: Evidence | None, pointings: int) -> ResidualVerdict:
    """Return the verdict on the evidence of the strongest window."""
    if evidence is None:
        return residual_verdict("few", TOO_FEW, pointings)
    if evidence.log_evidence < LOG_THRESHOLD:
        return residual_verdict("good", "residuals are as the mast file predicts", pointings, None, evidence)
    since = datetime.fromtimestamp(evidence.since_s, UTC).isoformat(timespec="seconds")
    return residual_verdict("drifts", _what_drifts(evidence, since), pointings, since, evidence)


def _what_drifts(evidence: Evidence, since: str) -> str:
    """What drifts, by how much, since when, and what to do."""
    which = f"{evidence.count + 1} pointings since {since}"
    strongest = max(evidence.turned.values(), key=lambda one: one.log_evidence, default=None)
    if strongest is None or evidence.log_wider >= strongest.log_evidence:
        return (
            f"residuals are {evidence.times:.1f} times as large as the mast file, counts and matches explain "
            f"({which}), and no one camera accounts for it. Check the head's mount and gears, or calibrate "
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


def mast_verdict(
    residuals: ResidualVerdict, looks: SentinelAnswer | None, handoffs: SelfCheck, panorama: str
) -> CalibrationAnswer:
    """Return the verdict as ``GET /status`` has it under ``calibration``.

    ``panorama``: what the seams of the last one say, empty for nothing. ``drifts`` if any of these says so,
    else that of the residuals; ``sentence``: of each that speaks against the mast file; ``since``: when the
    first of these began, where one says.
    """
    against: list[tuple[str, str | None]] = []
    if residuals["verdict"] == "drifts":
        against.append((residuals["sentence"], residuals["since"]))
    if looks is not None and looks["level"] == "bad":
        against.append((f"reference pictures: {looks['sentence']}", looks["since"]))
    against += [(f"hand-offs: {one['sentence']}", None) for one in handoffs["offsets"]]
    against += [(f"panorama: {panorama}", None)] if panorama else []
    return {
        "verdict": "drifts" if against else residuals["verdict"],
        "sentence": "; ".join(reason for reason, _ in against) or residuals["sentence"],
        "pointings": residuals["pointings"],
        "since": min((moment for _, moment in against if moment is not None), default=None),
    }


SHOWN = 50
"""Newest pointings that are shown one by one."""


class CalibrationHealth:
    """The verdict of residuals on the mast file in use; safe to use from any thread, waits for no file.

    ``folder`` keeps the pointings of the last days; ``wall_s`` is the time of day, seconds since 1970, as
    pointings of a week ago may be from before a restart.
    """

    def __init__(
        self, folder: Path, mast: StoredRig, thread: JournalThread, wall_s: Callable[[], float] = time.time
    ) -> None:
        self._journal = pointing_journal(folder)
        self._thread = thread
        self._wall_s = wall_s
        self._mast = mast
        self._known: deque[Measured] = deque(maxlen=KEPT)
        self._windows: Windows | None = None
        self._judges_by = mast  # in the thread: it comes to the one in use by and by
        self._newest: tuple[Judged, ...] = ()
        self.verdict = residual_verdict("few", TOO_FEW)
        thread.put(lambda: self._known.extend(self._journal.earlier()))
        thread.put(lambda: self._judge_by(mast))

    def ended(self, mast: StoredRig, operation: Operation) -> None:
        """Keep what a pointing measured, if it did; ``mast`` was in use when it began."""
        one = measured_by(operation, mast, self._wall_s())
        if one is not None:
            self._thread.put(lambda: self._count(one))

    def use_mast(self, mast: StoredRig) -> None:
        """Judge by this mast file from now on."""
        self._mast = mast
        self.verdict, self._newest = residual_verdict("few", TOO_FEW), ()
        self._thread.put(lambda: self._judge_by(mast))

    def newest(self) -> list[CountedPointing]:
        """Return the newest pointings that count, the newest first."""
        return [
            {**one.measured, "sigma_px": list(one.sigma_px), "chi_square": one.square}
            for one in reversed(self._newest)
        ]

    @property
    def write_error(self) -> str | None:
        """Why pointings are not kept over a restart, None if they are."""
        return self._journal.unwritten or None

    # In the journals' thread

    def _count(self, one: Measured) -> None:
        self._known.append(one)
        recent_s = self._wall_s() - DAYS * DAY_S
        self._journal.keep(one, [kept for kept in self._known if kept["time_s"] > recent_s])
        if self._windows is not None:
            self._windows.add(one)
            self._judge()

    def _judge_by(self, mast: StoredRig) -> None:
        self._judges_by = mast
        try:
            self._windows = Windows(mast.rig, mast.digest)
        except CalibError as error:
            self._windows = None
            sentence = f"residuals are kept, and judged by nothing: {error}"
            self._set_verdict(residual_verdict("unknown", sentence), ())
            return
        for one in self._known:
            self._windows.add(one)
        self._judge()

    def _judge(self) -> None:
        assert self._windows is not None
        self._windows.forget(self._wall_s())
        pointings = self._windows.pointings
        verdict = verdict_of(self._windows.evidence(), len(pointings))
        self._set_verdict(verdict, tuple(pointings[-SHOWN:]))

    def _set_verdict(self, verdict: ResidualVerdict, newest: tuple[Judged, ...]) -> None:
        """Publish a verdict, unless another mast file is in use by now."""
        if self._judges_by is not self._mast:
            return
        before, self.verdict, self._newest = self.verdict, verdict, newest
        if verdict["verdict"] == "drifts" and before["verdict"] != "drifts":
            log.warning("the calibration drifts: %s", verdict["sentence"])
        elif before["verdict"] == "drifts" and verdict["verdict"] != "drifts":
            log.info("the calibration does not drift any more: %s", verdict["sentence"])
