"""The process that carries a bench calibration out beside its daemon, whose head it turns as a client.

Choosing poses and fitting keep a processor busy for minutes. In a process of their own they delay no stop,
and the daemon can end them at once.
"""

from __future__ import annotations

import logging
import os
import threading
from collections.abc import Mapping
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, cast

from calib.plan.placements import Placement
from calib.targets.board_file import load_board
from mastctl.answers import BenchProgress, BenchResult, BenchRunRecord, BenchStep
from mastctl.as_json import as_json
from mastctl.bench.known import BenchKnowledge
from mastctl.bench.mast import DaemonMast, SimulatedBoard
from mastctl.bench.result import saved
from mastctl.bench.run import BenchRun
from mastctl.bench.runs import HOLDER, BenchJob
from mastctl.bench.survey import keep_former, open_survey
from mastctl.client import Client
from mastctl.errors import error_body, one_line

log = logging.getLogger(__name__)

BESIDE = 5
"""Niceness: the daemon comes first."""

MOST_SENTENCES, LONGEST_SENTENCE = 40, 400
MOST_ON_CURVE = 600


def work(job: BenchJob, link: Connection) -> None:
    """Carry a run out. Sends it through ``link`` at each change; receives True when a board stands."""
    os.nice(BESIDE)
    reporter = LinkReporter(job.run, link)
    try:
        with Client(job.url, name=HOLDER, token=job.token) as client:
            client.use_lease(job.lease_id)
            board = load_board(job.folder.board)
            reporter.change(board_m=list(board.size_m))
            mast = DaemonMast(client, list(client.status()["cameras"]), board)
            folder = open_survey(job.folder.seen, board, mast.head)
            keep_former(folder.path, client.mast_file())
            known = BenchKnowledge(mast.head, folder, board, reporter.say)
            simulated = SimulatedBoard(client, board, mast.head.rig) if job.run["simulated"] else None
            run = BenchRun(mast, known, reporter, job.run["wanted_px"], job.run["most"], simulated)
            run.run()
            reporter.step("check")
            checked = run.check()
            reporter.step("fit")
            report = job.folder.page.parent
            reporter.done(saved(folder.survey(), known.fit(), mast.head.rig, job.out, report, checked))
    except Exception as error:
        body = error_body(error)
        if body["code"] == "internal":
            log.exception("the calibration met a defect of the program")
        reporter.end("interrupted", body["code"], body["message"])


class LinkReporter:
    """Keeps a run up to date and sends it to the daemon at each change; see `Reporter`.

    The process ends with the link: the lease is not renewed any more.
    """

    def __init__(self, run: BenchRunRecord, link: Connection) -> None:
        self.run, self._link = run, link
        self._stands: SimpleQueue[bool] = SimpleQueue()
        threading.Thread(target=self._receive, name="bench answers", daemon=True).start()

    def change(self, **changed: Any) -> None:
        """Send the run with some of its fields changed."""
        self.run = cast(BenchRunRecord, {**self.run, **changed})
        self._link.send(self.run)

    def say(self, sentence: str) -> None:
        """Add a sentence."""
        sentences = [*self.run["sentences"], one_line(sentence, LONGEST_SENTENCE)]
        self.change(sentences=sentences[-MOST_SENTENCES:])

    def step(self, step: BenchStep) -> None:
        """Send what is done from now on."""
        self.change(step=step, state="running")

    def progress(self, now: BenchProgress) -> None:
        """Send how far the run is."""
        curve = [one for one in self.run["curve"] if one[0] < now["pictures"]]
        if now["predicted_px"] is not None:
            curve.append([float(now["pictures"]), now["predicted_px"]])
        self.change(curve=curve[-MOST_ON_CURVE:], **now)

    def place(self, name: str, placement: Placement) -> None:
        """Request a placement, and wait until a client confirms that the board stands."""
        by_hand = self.run["by_hand"]
        while by_hand and not self._stands.empty():
            self._stands.get()  # of a placement before
        described = {**as_json(placement), "description": str(placement), "needs_confirmation": by_hand}
        self.change(
            requested={"name": name, **described},
            placements=self.run["placements"] + 1,
            step="place",
            state="waiting" if by_hand else "running",
        )
        if by_hand:
            self._stands.get()
        self.step("search")

    def done(self, document: Mapping[str, Any]) -> None:
        """Send the result; ``document`` is what the command prints with ``--json``."""
        result = {key: document.get(key) for key in BenchResult.__annotations__}
        self.change(result=result)
        self.end("done", None, f"verdict: {document['verdict']['words']}")

    def end(self, state: str, code: str | None, sentence: str) -> None:
        """Send the end."""
        self.say(sentence)
        self.change(state=state, step="over", code=code, sentence=self.run["sentences"][-1])

    def _receive(self) -> None:
        try:
            while True:
                self._stands.put(self._link.recv())
        except (EOFError, OSError):
            os._exit(1)
