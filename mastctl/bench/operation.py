"""One bench calibration at a time, carried out by a worker process under a lease of its own.

The daemon starts the worker, publishes what it sends, passes on that a board stands, renews the lease, and
ends the worker: when a client requests it, after a stop, or when another client takes over. A stop waits for
none of this: it is noticed after the head has stopped.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, cast

from calib.errors import BadFile
from calib.files import replace_bytes
from drivers.errors import DriverError
from mastctl.answers import BenchRunRecord, BenchRuns
from mastctl.bench.runs import HOLDER, SHOWN, BenchJob, RunFiles, Runs, board_bytes, known_boards, new_record
from mastctl.control.lease import Caller, Lease, LeaseTable, StopCame
from mastctl.control.publisher import Publisher
from mastctl.errors import BadRequest, MastctlError, NotNow, Unable

log = logging.getLogger(__name__)

LEASE_S, RENEW_S = 30.0, 8.0
TICK_S = 0.25
ENDS_S = 5.0
FREE_BYTES = 500_000_000
"""Sixty pictures of two cameras take a tenth of it."""

Lend = Callable[[str], tuple[str, Callable[[], None]]]
"""Returns a token for a client of this name, and what revokes it."""


def carry_out(job: BenchJob, link: Connection) -> None:
    """Do a job: only the worker's process loads what planning and fitting need."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C of the daemon's terminal is the daemon's
    from mastctl.bench.worker import work

    work(job, link)


@dataclass(eq=False)
class _Work:
    """A run that is at work, or was."""

    folder: RunFiles
    lease: Lease
    revoke_token: Callable[[], None]
    run: BenchRunRecord
    process: SpawnProcess
    link: Connection
    over: threading.Event = field(default_factory=threading.Event)


class BenchOperation:
    """The bench calibrations of one daemon; safe to use from any thread.

    ``masts_folder`` returns the folder of the daemon's mast files; each change is published under the topic
    ``bench``. Only a ``simulated`` rover's board goes by itself where it is requested.
    """

    def __init__(
        self,
        state: Path,
        masts_folder: Callable[[], Path],
        leases: LeaseTable,
        publisher: Publisher,
        simulated: bool,
        work: Callable[[BenchJob, Connection], None] = carry_out,
    ) -> None:
        self.runs = Runs(state)
        self.work = work
        self._masts_folder, self._leases, self._publisher = masts_folder, leases, publisher
        self._simulated = simulated
        self._url = ""
        self._lend: Lend = lambda name: ("", lambda: None)
        self._starting = threading.Lock()
        self._changing = threading.Lock()
        self._work: _Work | None = None
        self._closed = False

    def serve(self, url: str, lend: Lend | None = None) -> None:
        """Let runs begin at an address; ``lend`` where clients need a token."""
        self._url, self._lend = url, lend or self._lend

    @property
    def run(self) -> BenchRunRecord | None:
        """The run that is at work, or the last of this daemon; takes no lock."""
        work = self._work
        return None if work is None else work.run

    def answer(self) -> BenchRuns:
        """Return the answer of ``GET /bench``; reads the folders."""
        now, runs = self.run, [one.summary() for one in self.runs.all()[:SHOWN]]
        for one in runs:
            if now is not None and now["step"] != "over" and one["name"] == now["name"]:
                one["state"], one["sentence"] = "running", ""
        return {
            "run": now,
            "runs": runs,
            "boards": list(known_boards()),
            "folder": str(self.runs.folder),
            "masts_folder": str(self._masts_folder()),
            "simulated": self._simulated,
        }

    def start(self, by: str, last_stop: StopCame | None = None, **wanted: Any) -> BenchRunRecord:
        """Begin a run for a client of a name, or go on with one, and return it.

        The first stop after ``last_stop`` (`LeaseTable.last_stop` at its request; None: that of now) ends the
        worker's right to steer, before the worker itself is ended. ``wanted`` are the fields of
        `mastctl.web.keeping.BenchBody`.

        Raises NotNow ``bench_runs``, ``bench_done`` if the run that is to go on has its verdict; NotKnown
        ``bench_unknown``; BadRequest ``bad_board``, ``bad_run``; Unable ``unwritable``, ``disk_low``,
        ``no_process``, ``closing``.
        """
        with self._alone() as now:
            if now is not None:
                raise NotNow(
                    "bench_runs", f"{now['by']} has a bench calibration running since {now['begun']}"
                )
            if self._closed or not self._url:
                raise Unable("closing", "a bench calibration begins only while the daemon serves")
            masts = self._masts_folder()
            _check_space(masts, self.runs.folder.parent)
            folder, run = self._requested(by, wanted)
            return self._begin(folder, run, masts, last_stop or self._leases.last_stop)

    def stands(self) -> BenchRunRecord:
        """Pass on that the board stands where it was requested.

        Raises NotNow ``bench_idle``, ``nothing_requested``; Unable ``no_process`` if the worker has ended.
        """
        work = self._working()
        if work.run["state"] != "waiting":
            raise NotNow("nothing_requested", "no placement is waited for just now")
        try:
            work.link.send(True)
        except OSError:
            raise Unable("no_process", "the calibration program has ended") from None
        return work.run

    def leave(self, by: str) -> BenchRunRecord:
        """End the run and its motion; it can go on later. Raises NotNow ``bench_idle``."""
        work = self._working()
        self._interrupt(work, "left", f"{by} ended the run")
        return work.run

    def forget(self, name: str) -> BenchRuns:
        """Remove a run that is over, with its pictures and report but not its mast file; return the rest.

        Raises NotNow ``bench_runs`` for the run that is at work, or while one begins; else as `Runs.forget`.
        """
        with self._alone() as now:
            if now is not None and now["name"] == name:
                raise NotNow("bench_runs", f"run {name} is at work; end it first")
            self.runs.forget(name)
        return self.answer()

    def close(self) -> None:
        """End the worker, if one is at work, and begin no other; never raises."""
        self._closed = True
        if self._work is not None:
            self._interrupt(self._work, "closing", "the daemon ended")

    @contextlib.contextmanager
    def _alone(self) -> Iterator[BenchRunRecord | None]:
        """Let nothing else begin or be removed meanwhile; yields the run at work, if any. Raises NotNow."""
        if not self._starting.acquire(blocking=False):
            raise NotNow("bench_runs", "another bench calibration begins just now")
        try:
            yield None if self.run is None or self.run["step"] == "over" else self.run
        finally:
            self._starting.release()

    def _working(self) -> _Work:
        work = self._work
        if work is None or work.over.is_set():
            raise NotNow("bench_idle", "no bench calibration is at work")
        return work

    def _requested(self, by: str, wanted: Mapping[str, Any]) -> tuple[RunFiles, BenchRunRecord]:
        """Return the run's folder with all that it needs, and the run as it begins."""
        keys = {"wanted_px": "wanted_px", "pictures": "most", "by_hand": "by_hand"}
        stated = {keys[key]: wanted[key] for key in keys if wanted.get(key) is not None}
        data = None
        if wanted.get("resume") is not None:
            folder = self.runs.named(wanted["resume"])
            try:
                before = folder.read()
            except BadFile as error:
                raise BadRequest("bad_run", str(error)) from None
            if before["state"] == "done":
                raise NotNow("bench_done", f"run {folder.name} has its verdict; begin another")
            kept = {key: before[key] for key in ("begun", *keys.values())}  # type: ignore[literal-required]
            stated, described = kept | stated, before["board"]
        else:
            data, board = board_bytes(wanted.get("board"), wanted.get("board_file"))
            folder = self.runs.new()
            width_mm, height_mm = (1000 * size_m for size_m in board.size_m)
            described = f"{wanted.get('board') or board.kind}, {width_mm:.0f} x {height_mm:.0f} mm"
        run = new_record(folder.name, by, described, self._simulated, **stated)
        run["by_hand"] = run["by_hand"] or not self._simulated
        try:
            if data is not None:
                replace_bytes(folder.board, data, 0o644)
            folder.write(run)
        except (BadFile, OSError) as error:
            raise Unable("unwritable", f"{folder.path} cannot be written: {error}") from None
        return folder, run

    def _begin(
        self, folder: RunFiles, run: BenchRunRecord, masts: Path, last_stop: StopCame
    ) -> BenchRunRecord:
        inside = Caller(HOLDER, "operate", "inside")
        lease = self._leases.take(inside, f"{run['by']} began it", HOLDER, LEASE_S, last_stop)
        token, revoke_token = self._lend(HOLDER)
        job = BenchJob(run, folder, masts / mast_file(run), self._url, lease.id, token or None)
        context = get_context("spawn")  # a fork would copy the daemon's threads half
        ours, its = context.Pipe()
        process = context.Process(target=self.work, args=(job, its), name=HOLDER, daemon=True)
        work = self._work = _Work(folder, lease, revoke_token, run, process, ours)
        try:
            process.start()
            its.close()
            threading.Thread(target=self._follow, args=(work,), name="bench", daemon=True).start()
        except (OSError, RuntimeError) as error:
            sentence = f"the calibration program cannot be started: {error}"
            self._interrupt(work, "no_process", sentence)
            raise Unable("no_process", sentence) from None
        log.info("bench calibration %s begins, requested by %s", folder.name, run["by"])
        self._publish(work)
        return run

    def _follow(self, work: _Work) -> None:
        """Publish what the worker sends, renew its lease, and end the run where it must end."""
        renew_s = time.monotonic() + RENEW_S
        with work.link:
            while not work.over.is_set():
                if wait([work.link], TICK_S):
                    try:
                        run = work.link.recv()
                    except (EOFError, OSError):
                        work.process.join(ENDS_S)
                        return self._interrupt(work, "program_ended", _how_it_ended(work.process.exitcode))
                    if run["step"] == "over":
                        work.process.join(ENDS_S)  # published afterwards: the next client may steer then
                        return self._end(work, run)
                    with self._changing:
                        work.run = work.run if work.over.is_set() else run
                    self._publish(work)
                try:
                    if time.monotonic() >= renew_s or not self._leases.holds(work.lease.id):
                        self._leases.renew(work.lease.id, LEASE_S)
                        renew_s = time.monotonic() + RENEW_S
                except MastctlError as error:
                    reason = (getattr(error, "detail", None) or {}).get("how", error)
                    code = "stopped" if self._leases.was_stopped(work.lease) else "taken"
                    return self._interrupt(work, code, str(reason))
        return None

    def _interrupt(self, work: _Work, code: str, reason: str) -> None:
        """End a run that has not ended itself."""
        sentence = f"{reason}; everything seen is kept, and the run can go on"
        ended = {"state": "interrupted", "code": code, "sentence": sentence}
        run = {**work.run, **ended, "sentences": [*work.run["sentences"], sentence]}
        self._end(work, cast(BenchRunRecord, run))

    def _end(self, work: _Work, run: BenchRunRecord) -> None:
        """End a run, once: the worker first, then its right to steer with what moves by it."""
        with self._changing:
            if work.over.is_set():
                return
            work.over.set()
        with contextlib.suppress(ValueError, AttributeError):  # it has not been started
            work.process.kill()
        with contextlib.suppress(MastctlError):  # taken over, or over by time
            try:
                self._leases.release(work.lease.id)
            except DriverError as error:
                log.error("the head did not confirm the stop as a bench calibration ended: %s", error)
        work.revoke_token()
        if work.process.pid is not None:
            work.process.join(ENDS_S)
        done = run["state"] == "done"
        made = {
            "mast_file": mast_file(run) if done else None,
            "report": work.folder.name if work.folder.page.is_file() else None,
        }
        work.run = run = cast(BenchRunRecord, {**run, "step": "over", **made})
        try:
            work.folder.write(run)
        except BadFile as error:
            log.error("how the bench calibration ended is not kept: %s", error)
        (log.info if done else log.warning)("bench calibration %s: %s", run["name"], run["sentence"])
        self._publish(work)

    def _publish(self, work: _Work) -> None:
        with self._changing:  # so that no older state is published after a newer one
            self._publisher.publish("bench", "run", work.run)


def mast_file(run: BenchRunRecord) -> str:
    """Return the name of the mast file that a run makes."""
    return f"bench-{run['name']}.yaml"


def _how_it_ended(exitcode: int | None) -> str:
    if exitcode is None or exitcode >= 0:
        return f"the calibration program ended with exit code {exitcode}"
    return f"the calibration program was ended by signal {-exitcode} ({signal.strsignal(-exitcode)})"


def _check_space(masts: Path, state: Path) -> None:
    """Pass if the mast file and the pictures can be written. Raises Unable."""
    try:
        with tempfile.TemporaryFile(dir=masts):
            pass
        free = shutil.disk_usage(state).free
    except OSError as error:
        sentence = f"the mast file would go to {masts}, where this daemon cannot write"
        raise Unable("unwritable", f"{sentence}: {error.strerror or error}") from None
    if free < FREE_BYTES:
        sentence = f"{free / 1e6:.0f} MB are free in {state} where {FREE_BYTES / 1e6:.0f} are needed"
        raise Unable("disk_low", sentence)
