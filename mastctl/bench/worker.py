"""The process that carries a bench calibration out beside its daemon, whose head it turns as a client; and
the mast file that it leaves, or a folder that is fitted again.

Choosing poses and fitting keep a processor busy for minutes. In a process of their own they delay no stop,
and the daemon can end them at once.
"""

from __future__ import annotations

import logging
import math
import os
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, cast

from calib.adjust.result import BenchCalibration
from calib.geometry.rig import Rig
from calib.plan.placements import Placement
from calib.survey.records import Survey
from calib.targets.board_file import load_board
from mastctl import signals
from mastctl.answers import BenchResult, BenchRunRecord
from mastctl.as_json import as_json
from mastctl.bench.known import BenchKnowledge
from mastctl.bench.mast import DaemonMast, SimulatedBoard
from mastctl.bench.run import BenchRun, Checked
from mastctl.bench.runs import HOLDER, BenchJob
from mastctl.bench.survey import fit_in_frame, open_survey
from mastctl.calibration.landing import expected_pointing
from mastctl.calibration.run import checked_survey, conclude, mast_document, picked, with_fit
from mastctl.calibration.verdict import judge
from mastctl.client import Client
from mastctl.errors import error_body, one_line
from mastctl.report.pages import Table

log = logging.getLogger(__name__)

BESIDE = 5
"""Niceness: the daemon comes first."""

MOST_SENTENCES, LONGEST_SENTENCE = 40, 400


def work(job: BenchJob, link: Connection) -> None:
    """Carry a run out. Sends it through ``link`` at each change; receives True when a board stands."""
    os.nice(BESIDE)
    signals.end_with_parent()  # its lease is not renewed any more
    reporter = LinkReporter(job.run, link)
    try:
        with Client(job.url, name=HOLDER, token=job.token) as client:
            client.use_lease(job.lease_id)
            board = load_board(job.folder.board)
            reporter.change(board_m=list(board.size_m))
            mast = DaemonMast(client, list(client.status()["cameras"]), board)
            folder = open_survey(job.folder.seen, board, mast.head, mast_file=client.mast_file())
            known = BenchKnowledge(mast.head, folder, board, reporter.say)
            simulated = SimulatedBoard(client, board, mast.head.rig) if job.run["simulated"] else None
            run = BenchRun(mast, known, reporter, job.run["wanted_px"], job.run["most"], simulated)
            run.run()
            checked = run.check()
            report = job.folder.page.parent
            document = saved(folder.survey(), known.fit(), mast.head.rig, job.out, report, checked)
            reporter.change(result={key: document.get(key) for key in BenchResult.__annotations__})
            reporter.end("done", None, f"verdict: {document['verdict']['words']}")
    except Exception as error:
        body = error_body(error)
        if body["code"] == "internal":
            log.exception("the calibration met a defect of the program")
        reporter.end("interrupted", body["code"], body["message"])


class LinkReporter:
    """Keeps a run up to date and sends it to the daemon at each change; see `Reporter`."""

    def __init__(self, run: BenchRunRecord, link: Connection) -> None:
        self.run, self._link = run, link

    def change(self, **changed: Any) -> None:
        """Send the run with some of its fields changed."""
        run = {**self.run, **changed}
        if changed.get("predicted_px") is not None:
            before = [one for one in run["curve"] if one[0] < run["pictures"]]
            run["curve"] = [*before, [float(run["pictures"]), run["predicted_px"]]]
        self.run = cast(BenchRunRecord, run)
        self._link.send(self.run)

    def say(self, sentence: str) -> None:
        """Add a sentence."""
        sentences = [*self.run["sentences"], one_line(sentence, LONGEST_SENTENCE)]
        self.change(sentences=sentences[-MOST_SENTENCES:])

    def place(self, name: str, placement: Placement) -> None:
        """Request a placement, and wait until a client confirms that the board stands."""
        by_hand = self.run["by_hand"]
        while self._link.poll():
            self._link.recv()  # of a placement before
        described = {**as_json(placement), "description": str(placement), "needs_confirmation": by_hand}
        self.change(
            requested={"name": name, **described},
            placements=self.run["placements"] + 1,
            step="place",
            state="waiting" if by_hand else "running",
        )
        if by_hand:
            self._link.recv()
        self.change(step="search", state="running")

    def end(self, state: str, code: str | None, sentence: str) -> None:
        """Send the end."""
        self.say(sentence)
        self.change(state=state, step="over", code=code, sentence=self.run["sentences"][-1])


def fit_again(
    survey: Survey, out: Path, report: Path | None, mast_at: Sequence[float] | None, former: Rig | None
) -> dict[str, Any]:
    """Fit a bench's folder again, and return what `saved` does; the rest is of `fit_in_frame`.

    Raises SurveyRefused if something is missing, BenchNotFitted if the images do not determine a rig; nothing
    is written then.
    """
    checked_survey(survey)
    return saved(survey, fit_in_frame(survey, mast_at, former), former, out, report)


def saved(
    survey: Survey,
    fit: BenchCalibration,
    former: Rig | None,
    out: Path,
    report: Path | None,
    checked: Checked | None = None,
) -> dict[str, Any]:
    """Judge a fit, save the mast file and the report if one is requested, and return all as JSON.

    ``checked`` was measured at the end of a run. ``calibrated_px``, ``counts_px``: what the calibration, and
    the encoders' counts alone, leave of a first pointing, rms per axis; ``pictures`` of the camera with most.
    """
    verdict = judge(survey, fit)
    if former is not None:
        fit = replace(fit, notes=(*fit.notes, *_former_notes(fit, former)))
    rig = with_fit(fit, survey, verdict)
    rig = rig if former is None else with_former(rig, former)
    pointing = expected_pointing(fit)
    cameras = Counter(image.camera for image in fit.images if image.purpose != "check")
    numbers: dict[str, Any] = {
        "calibrated_px": None if pointing is None else pointing[0].rms_px(pointing[1]),
        "counts_px": None if pointing is None else pointing[0].by_counts_px(fit.joint_rad),
        "placements": len(fit.rover_from_board),
        "pictures": max(cameras.values(), default=0),
    }
    own: dict[str, Any] = {"worth": Table(("quantity", "value"), list(_worth(numbers, checked)))}
    if checked is not None:
        own |= {"pointings": checked.table(), "promised_px": checked.promised_px}
    file, _, page = conclude(survey, fit, verdict, rig, out, report, former, **own)
    document = {
        **mast_document(file),
        **numbers,
        **picked(fit, "seconds", "notes"),
        "survey": {"folder": str(survey.folder), "digest": survey.digest},
        "report": None if page is None else str(page),
    }
    keys = "promised_px", "pointings", "pointing_rms_px", "pointing_promised_px"
    return document if checked is None else {**document, "check": picked(checked, *keys)}


def with_former(rig: Rig, former: Rig) -> Rig:
    """Return the rig with the former one's name, and its body cameras that were not tied to the head."""
    body = {n: c for n, c in former.cameras.items() if c.on == "rover" and n not in rig.cameras}
    cameras = {**rig.cameras, **body}
    order = [*(n for n in former.cameras if n in cameras), *(n for n in cameras if n not in former.cameras)]
    stereo = {**{n: p for n, p in former.stereo.items() if set(p) <= set(cameras)}, **rig.stereo}
    return replace(rig, name=former.name, cameras={n: cameras[n] for n in order}, stereo=stereo)


def _former_notes(fit: BenchCalibration, former: Rig) -> Iterator[str]:
    """A note on each camera that the former mast file has and no image shows."""
    for name, camera in former.cameras.items():
        if name in fit.rig.cameras:
            continue
        if camera.on == "rover":
            yield f"camera {name} stays in the mast file as the former one has it"
        else:
            yield (
                f"camera {name} is not in the mast file any more: the head is another frame now, and none of "
                "its images shows the board"
            )


def _worth(numbers: Mapping[str, Any], checked: Checked | None) -> Iterator[tuple[str, str]]:
    if numbers["calibrated_px"] is not None:
        yield "first pointing, rms an axis, by the calibration", px(numbers["calibrated_px"])
        yield "the same by the encoders' counts alone", px(numbers["counts_px"])
    if checked is not None and checked.pointing_rms_px is not None:
        x, y = checked.pointing_rms_px
        measured = f"{x:.2f}, {y:.2f} px, promised {checked.pointing_promised_px:.2f}"
        yield f"pointed at {len(checked.pointings)} corners, rms x and y", measured
    yield "taken", f"{numbers['placements']} placements, {numbers['pictures']} pictures a camera"


def px(value: float | None) -> str:
    """Return pixels as a person reads them."""
    if value is None or not math.isfinite(value):
        return "? px"
    return f"{value:.2f} px" if value < 10 else f"{value:.0f} px"
