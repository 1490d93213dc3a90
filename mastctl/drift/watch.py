"""The one watch over the mast file in use: what it counts, where it keeps it, and its verdict.

Each source has one journal and one statistic.

    source               journal                        statistic
    pointings            ``pointings.jsonl``            `mastctl.drift.evidence`, of the last days
    hand-offs            ``pointings.jsonl``            the same
    reference images     `mastctl.drift.pictures`       two looks that find a change, one after the other
    panoramas' seams     the panorama's own folder      of the newest panorama
"""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable, Mapping
from pathlib import Path

from calib.errors import BadFile, CalibError
from calib.files.mast_file import StoredRig
from calib.matching.handoff import MatchedHandoff
from drivers.clock import Clock
from mastctl.answers import (
    CalibrationAnswer,
    CalibrationReport,
    CountedPointing,
    MeasuredPointing,
    ResidualVerdict,
    SentinelAnswer,
)
from mastctl.control.machine import StandingFault
from mastctl.control.operations import Operation
from mastctl.drift import evidence
from mastctl.drift.handoffs import handoff_log, line_of
from mastctl.drift.journal import NAME, Journal, JournalThread
from mastctl.drift.pictures import FOLDER, Findings

log = logging.getLogger(__name__)

FILE = "pointings.jsonl"
MOST_BYTES = 4 << 20
"""At which the file is written anew with what still counts; some 6000 samples."""
SHOWN = 50
"""Newest pointings that are shown one by one."""


Found = tuple[ResidualVerdict, tuple[evidence.Judged, ...]]
NOTHING_YET: Found = evidence.no_verdict("few", evidence.TOO_FEW), ()


def sample_journal(folder: Path) -> Journal[MeasuredPointing]:
    """Return the journal of samples in a state folder."""
    return Journal(folder / FILE, "pointings", evidence.sample_of, most_bytes=MOST_BYTES)


class DriftWatch:
    """The verdict on the mast file in use; safe to use from any thread, waits for no file.

    ``folder`` keeps the samples of the last days; ``handoff_path`` gets each hand-off too, if there is one.
    ``slip`` returns what a panorama says against the mast file of a digest. ``clock`` dates faults;
    ``wall_s`` is the time of day, as samples of a week ago may be from before a restart.
    """

    def __init__(
        self,
        folder: Path,
        handoff_path: Path | None,
        mast: StoredRig,
        slip: Callable[[str], str],
        thread: JournalThread,
        clock: Clock,
        wall_s: Callable[[], float] = time.time,
    ) -> None:
        self._mast = mast
        self._slip = slip
        self._thread = thread
        self._clock, self._wall_s = clock, wall_s
        self._journal = sample_journal(folder)
        self._handoffs = None if handoff_path is None else handoff_log(handoff_path)
        self._findings = Findings(folder / FOLDER)
        # Of the journals' thread, read by others
        self._judged = "", NOTHING_YET
        self._faults: Mapping[Path, StandingFault] = {}
        # Of that thread alone
        self._samples: deque[MeasuredPointing] = deque(maxlen=evidence.KEPT)
        self._windows: evidence.Windows | None = None
        self._drifted = False
        thread.put(self._read)
        thread.poll(self._poll)

    def ended(self, mast: StoredRig, operation: Operation) -> None:
        """Count what a pointing measured, if it did; ``mast`` was in use when it began."""
        one = evidence.pointing_sample(operation, mast, self._wall_s())
        if one is not None:
            self._thread.put(lambda: self._count(one))

    def handed_over(self, handoff: MatchedHandoff) -> None:
        """Count a hand-off, and have it logged."""
        mast, time_s = self._mast, self._wall_s()
        self._thread.put(lambda: self._log_handoff(handoff))
        for one in evidence.handoff_samples(handoff, mast, time_s):
            self._thread.put(lambda one=one: self._count(one))  # type: ignore[misc]

    def use_mast(self, mast: StoredRig) -> None:
        """Judge this mast file from now on."""
        self._mast = mast
        self._thread.put(lambda: self._judge_by(mast))

    @property
    def pictures(self) -> SentinelAnswer:
        """What the looks at the reference images say, as ``GET /sentinel`` has it; some seconds old."""
        return self._findings.answer(self._mast.digest)

    def verdict(self) -> CalibrationAnswer:
        """Return whether the mast file is still valid, by all sources, as ``GET /status`` has it.

        ``drifts`` if any of them says so, else that of the residuals; ``sentence``: of each that speaks
        against the mast file; ``since``: when the first of these began, where one says.
        """
        residuals, _ = self._residuals()
        looks, slip = self.pictures, self._slip(self._mast.digest)
        against: list[tuple[str, str | None]] = []
        if residuals["verdict"] == "drifts":
            against.append((residuals["sentence"], residuals["since"]))
        if looks["level"] == "bad":
            against.append((f"reference images: {looks['sentence']}", looks["since"]))
        against += [(f"panorama: {slip}", None)] if slip else []
        return {
            "verdict": "drifts" if against else residuals["verdict"],
            "sentence": "; ".join(reason for reason, _ in against) or residuals["sentence"],
            "pointings": residuals["pointings"],
            "since": min((moment for _, moment in against if moment is not None), default=None),
        }

    def report(self) -> CalibrationReport:
        """Return the verdict with the figures of the samples, and the newest pointings, the newest first."""
        residuals, newest = self._residuals()
        counted: list[CountedPointing] = [
            {**one.sample, "sigma_px": one.sigma_px.tolist(), "chi_square": one.square}
            for one in reversed(newest)
        ]
        return {
            **residuals, **self.verdict(), "newest": counted, "sentinel": self.pictures
        }  # fmt: skip

    def faults(self) -> tuple[StandingFault, ...]:
        """Return which files cannot be written."""
        return tuple(self._faults.values())

    def _residuals(self) -> Found:
        """The verdict of the samples of the mast file in use, and the newest of them."""
        digest, found = self._judged
        return found if digest == self._mast.digest else NOTHING_YET

    # In the journals' thread

    def _read(self) -> None:
        try:
            self._samples.extend(self._journal.read())
        except BadFile as error:
            log.error("%s; earlier pointings do not count", " ".join(str(error).split()))
        self._judge_by(self._mast)

    def _count(self, one: MeasuredPointing) -> None:
        self._samples.append(one)
        recent_s = self._wall_s() - evidence.DAYS * evidence.DAY_S
        counting = [kept for kept in self._samples if kept["time_s"] > recent_s]
        self._write(self._journal.path, lambda: self._journal.append(one, counting))
        if self._windows is not None:
            self._windows.add(one)
            self._judge()

    def _log_handoff(self, handoff: MatchedHandoff) -> None:
        journal = self._handoffs
        if journal is not None:
            self._write(journal.path, lambda: journal.append(line_of(handoff)))

    def _write(self, path: Path, append: Callable[[], None]) -> None:
        """Append to a file; while it refuses there is a fault, and what it lacks counts until a restart."""
        faults = {name: one for name, one in self._faults.items() if name != path}
        try:
            append()
        except BadFile as error:
            message = f"{' '.join(str(error).split())}; the measurements count until the daemon ends"
            fault = StandingFault(NAME, "unwritable", message, self._clock.now_s(), "it can be written")
            if path not in self._faults:
                log.error("%s", message)
            faults[path] = self._faults.get(path, fault)
        self._faults = faults

    def _judge_by(self, mast: StoredRig) -> None:
        try:
            self._windows = evidence.Windows(mast)
        except CalibError as error:
            self._windows = None
            sentence = f"residuals are kept, and judged by nothing: {error}"
            self._judged = mast.digest, (evidence.no_verdict("unknown", sentence), ())
            return
        for one in self._samples:
            self._windows.add(one)
        self._judge()

    def _judge(self) -> None:
        windows = self._windows
        assert windows is not None
        windows.forget(self._wall_s())
        verdict = evidence.verdict_of(windows.evidence(), len(windows.judged))
        pointings = [one for one in windows.judged if one.sample["operation"] != evidence.HANDOFF]
        self._judged = windows.digest, (verdict, tuple(pointings[-SHOWN:]))

    def _poll(self) -> None:
        self._findings.poll()
        verdict = self.verdict()
        drifts = verdict["verdict"] == "drifts"
        if drifts != self._drifted:
            self._drifted = drifts
            if drifts:
                log.warning("the calibration drifts: %s", verdict["sentence"])
            else:
                log.info("the calibration does not drift any more: %s", verdict["sentence"])
