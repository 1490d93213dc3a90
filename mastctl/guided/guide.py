"""One bench calibration at a time, carried out by a program beside the daemon, under a lease of its own.

The daemon's part is small: it starts ``mastctl calibrate bench`` with its own address, keeps what that
tells, hands on that a board stands, renews the lease while the program lives, and ends it: when somebody asks
for that, when a stop was pressed, when somebody else took over, when it falls silent. A stop waits for none
of it: it is heard of after the head has been told.
"""

from __future__ import annotations

import contextlib
import logging
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

from calib.errors import BadFile
from drivers.errors import DriverError
from mastctl.answers import BenchState, BenchTold
from mastctl.control.caller import Caller
from mastctl.control.lease import Lease, LeaseTable, StopCame
from mastctl.control.publisher import Published, Publisher, ThreadSubscription
from mastctl.errors import BadRequest, MastctlError, NotNow, Unable
from mastctl.guided.child import GuidedProgram
from mastctl.guided.runs import GuidedFolder, Runs, board_bytes, keep_board, known_boards
from mastctl.guided.told import GuidedRun, ended, heard

log = logging.getLogger(__name__)

HOLDER = "bench calibration"
LEASE_S, RENEW_S = 30.0, 8.0
LOOK_S = 0.5
SILENT_S = 900.0
"""A search all over the limits takes minutes, and says little; longer than this hangs."""

TOLD_S = 2.0
"""So long it is waited to hear who pressed a stop that has ended the lease already."""

LINGERS_S = 10.0
"""After it has told its end a program is given so long to be over."""

FREE_BYTES = 500_000_000
"""Sixty pictures of two cameras take a tenth of it."""

GOES_ON = "everything seen is kept, and the run can go on"


class Stopper(Protocol):
    """What of `mastctl.service.stopping.Stopping` ends what the program has begun."""

    def stop(self, reason: str = ...) -> str | None: ...


class Operating(Protocol):
    """What of `mastctl.control.operations.OperationRunner` says what runs."""

    @property
    def running(self) -> str | None: ...


@dataclass(frozen=True)
class WayIn:
    """How a program of this machine comes in.

    Attributes
    ----------
    url
        The daemon's address.
    lend
        Makes a token for a program, that holds until the second of what it returns is called; None where
        nobody needs one.
    """

    url: str
    lend: Callable[[str], tuple[str, Callable[[], None]]] | None = None


@dataclass(frozen=True)
class RunRequest:
    """What is asked for when a run begins or goes on.

    Attributes
    ----------
    board, board_file
        The name of a packaged board, or the text of a BOARD.yaml; neither for a run that goes on.
    resume
        The name of a run that was interrupted.
    wanted_px, pictures
        As of the command; None: as usual, or as the run had it.
    by_hand
        Whether somebody places a simulated board; a real one always waits for that.
    """

    board: str | None = None
    board_file: str | None = None
    resume: str | None = None
    wanted_px: float | None = None
    pictures: int | None = None
    by_hand: bool | None = None


@dataclass(eq=False)
class _Work:
    """A run that is at work, or was."""

    folder: GuidedFolder
    lease: Lease
    give_back: Callable[[], None]
    run: GuidedRun
    child: GuidedProgram | None = None
    outcome: GuidedRun | None = None
    over: threading.Event = field(default_factory=threading.Event)


def command_of(folder: GuidedFolder, asked: dict[str, Any], door: WayIn, mast_file: Path) -> list[str]:
    """Return the command that carries a run out."""
    words = [sys.executable, "-m", "mastctl", "calibrate", "bench", "--lines", "--url", door.url]
    words += ["--board", str(folder.board), "--out", str(mast_file), "--survey", str(folder.seen)]
    words += ["--report", str(folder.report), "--wanted-px", repr(asked["wanted_px"])]
    words += ["--pictures", str(asked["pictures"])]
    return [*words, "--by-hand"] if asked["by_hand"] else words


class Guide:
    """The guided calibrations of one daemon; safe to use from any thread.

    Parameters
    ----------
    state
        The daemon's state folder.
    masts_folder
        Says where the daemon's mast files lie.
    leases, stopping, operations
        Who steers; what ends what the program has begun; whether anything runs.
    publisher
        Is told each change (topic ``bench``), and tells of stops and of the lease.
    simulated
        Whether the rover is: only there somebody may choose not to place the board.
    command
        Makes the command of a run.

    Attributes
    ----------
    door
        How the program comes in; without it nothing begins.
    """

    def __init__(
        self,
        state: Path,
        masts_folder: Callable[[], Path],
        leases: LeaseTable,
        stopping: Stopper,
        operations: Operating,
        publisher: Publisher,
        simulated: bool,
        command: Callable[[GuidedFolder, dict[str, Any], WayIn, Path], Sequence[str]] = command_of,
    ) -> None:
        self.runs = Runs(state)
        self.door: WayIn | None = None
        self._masts_folder = masts_folder
        self._leases, self._stopping, self._operations = leases, stopping, operations
        self._publisher = publisher
        self._simulated = simulated
        self._command = command
        self._starting = threading.Lock()
        self._telling = threading.Lock()
        self._publishing = threading.Lock()
        self._work: _Work | None = None
        self._closed = False

    @property
    def run(self) -> GuidedRun | None:
        """The run that is at work, or the last of this daemon; takes no lock."""
        work = self._work
        return None if work is None else work.run

    def told(self) -> BenchTold:
        """Return what ``GET /bench`` tells; reads the folders."""
        now = self.run
        working = None if now is None or now.over else now.name
        runs = list(self.runs.listed())
        for one in runs:
            if one["name"] == working:
                one["state"], one["sentence"] = "running", ""
        return {
            "run": None if now is None else now.told(),
            "runs": runs,
            "boards": list(known_boards()),
            "folder": str(self.runs.folder),
            "masts_folder": str(self._masts_folder()),
            "simulated": self._simulated,
        }

    def start(self, wanted: RunRequest, who: str, last_stop: StopCame | None = None) -> GuidedRun:
        """Begin a run, or go on with one, and return it.

        Parameters
        ----------
        wanted, who
            What is asked for, and by whom.
        last_stop
            `mastctl.control.lease.LeaseTable.last_stop` when it was asked for: the next stop ends the
            program's right to steer, before the program itself is ended. None: that of now.

        Raises
        ------
        NotNow
            ``bench_runs``; ``bench_done`` if the run that is to go on has its verdict.
        NotKnown
            ``bench_unknown``.
        BadRequest
            ``bad_board``, ``bad_run``.
        Unable
            ``unwritable``, ``disk_low``, ``no_process``, ``closing``.
        """
        if not self._starting.acquire(blocking=False):
            raise NotNow("bench_runs", "another bench calibration begins just now")
        try:
            return self._start(wanted, who, last_stop or self._leases.last_stop)
        finally:
            self._starting.release()

    def stands(self) -> GuidedRun:
        """Hand on that the board stands where it was asked for.

        Raises
        ------
        NotNow
            ``bench_idle``; ``nothing_asked`` if no placement is waited for.
        Unable
            ``no_process`` if the program does not take it.
        """
        work = self._working()
        if work.run.state != "asking":
            raise NotNow("nothing_asked", "no placement is waited for just now")
        if work.child is None or not work.child.answer("stands"):
            raise Unable("no_process", "the calibration program does not take the answer; it may have ended")
        return work.run

    def leave(self, who: str) -> GuidedRun:
        """End the run and what it moves; it can go on later. Raises NotNow ``bench_idle``, DriverError."""
        work = self._working()
        self._finish(work, "interrupted", "left", f"{who} ended the run; {GOES_ON}", and_motion=True)
        return work.run

    def forget(self, name: str) -> BenchTold:
        """Remove a run that is over, with all it saw and its report; return what is left, as `told`.

        Its mast file stays where it is.

        Raises
        ------
        NotNow
            ``bench_runs`` for the run that is at work, or while one begins.
        NotKnown
            ``bench_unknown``.
        Unable
            ``unwritable``.
        """
        if not self._starting.acquire(blocking=False):
            raise NotNow("bench_runs", "a bench calibration begins just now")
        try:
            now = self.run
            if now is not None and not now.over and now.name == name:
                raise NotNow("bench_runs", f"run {name} is at work; end it first")
            self.runs.forget(name)
        finally:
            self._starting.release()
        return self.told()

    def close(self) -> None:
        """End the program, if one is at work, and begin no other; never raises."""
        self._closed = True
        work = self._work
        if work is not None and not work.over.is_set():
            self._finish(work, "interrupted", "closing", f"the daemon ended; {GOES_ON}")

    # Begin

    def _start(self, wanted: RunRequest, who: str, last_stop: StopCame) -> GuidedRun:
        now, door = self.run, self.door
        if now is not None and not now.over:
            raise NotNow("bench_runs", f"{now.by} has a bench calibration running since {now.begun}")
        if self._closed or door is None:
            raise Unable("closing", "the daemon begins no bench calibration before it serves, or as it ends")
        masts = self._masts_folder()
        _check_room(masts, self.runs.folder.parent)
        folder, asked = self._asked(wanted, who)
        inside = Caller(HOLDER, "operate", "inside")
        lease = self._leases.take(inside, f"{who} began it", HOLDER, LEASE_S, last_stop)
        text, give_back = (None, lambda: None) if door.lend is None else door.lend(HOLDER)
        run = GuidedRun(
            folder.name,
            asked["begun"],
            who,
            by_hand=asked["by_hand"] or not self._simulated,
            wanted_px=asked["wanted_px"],
            most=asked["pictures"],
        )
        work = _Work(folder, lease, give_back, run)
        self._work = work
        environment = {"MASTCTL_LEASE": lease.id}
        if text is not None:
            environment["MASTCTL_TOKEN"] = text
        try:
            work.child = GuidedProgram(
                self._command(folder, asked, door, masts / asked["mast_file"]),
                folder.path,
                environment,
                lambda line: self._heard(work, line),
                lambda code, words: self._ended(work, code, words),
            )
            threading.Thread(target=self._watch, args=(work,), name="bench watch", daemon=True).start()
        except (OSError, RuntimeError) as error:
            words = f"the calibration program cannot be started: {error}"
            self._finish(work, "interrupted", "no_process", words)
            raise Unable("no_process", words) from None
        log.info("bench calibration %s begins, asked for by %s", folder.name, who)
        self._publish(work)
        return work.run

    def _asked(self, wanted: RunRequest, who: str) -> tuple[GuidedFolder, dict[str, Any]]:
        """The run's folder with all that it needs, and what is asked of it."""
        if wanted.resume is not None:
            folder = self.runs.named(wanted.resume)
            try:
                before, end = folder.asked(), folder.end()
                before |= {"begun": str(before["begun"]), "mast_file": str(before["mast_file"])}
            except BadFile as error:
                raise BadRequest("bad_run", str(error)) from None
            except KeyError as error:
                words = f"{folder.path / 'run.json'}: {error.args[0]} is missing; begin another run"
                raise BadRequest("bad_run", words) from None
            if end is not None and end.get("state") == "done":
                raise NotNow("bench_done", f"run {folder.name} has its verdict; begin another")
        else:
            data, board = board_bytes(wanted.board, wanted.board_file)
            folder = self.runs.new()
            keep_board(folder, data)
            before = {
                "begun": datetime.now(UTC).isoformat(timespec="seconds"),
                "mast_file": f"bench-{folder.name}.yaml",
                "board": f"{wanted.board or board.kind}, {_mm(board.size_m)}",
            }
        asked = {
            **before,
            "by": who,
            "wanted_px": float(_first(wanted.wanted_px, before.get("wanted_px"), 0.2)),
            "pictures": int(_first(wanted.pictures, before.get("pictures"), 60)),
            "by_hand": bool(_first(wanted.by_hand, before.get("by_hand"), False)) and self._simulated,
        }
        try:
            folder.keep_asked(asked)
            (folder.path / "end.json").unlink(missing_ok=True)
        except (BadFile, OSError) as error:
            raise Unable("unwritable", str(error)) from None
        return folder, asked

    # While it is at work

    def _working(self) -> _Work:
        work = self._work
        if work is None or work.over.is_set():
            raise NotNow("bench_idle", "no bench calibration is at work")
        return work

    def _heard(self, work: _Work, line: bytes) -> None:
        """Take a line; the end is told when the program is over, so that who hears it may steer."""
        with self._telling:
            if work.over.is_set() or work.outcome is not None:
                return
            new = heard(work.run, line)
            if new.over:
                work.outcome = new
                return
            work.run = new
        self._publish(work)

    def _ended(self, work: _Work, code: int, words: str) -> None:
        """The program is over."""
        outcome = work.outcome
        if outcome is not None:
            self._finish(work, outcome.state, outcome.code, outcome.sentence)
            return
        if work.child is not None and work.child.flooded:
            why = "printed more than can be read, and was ended"
        elif code < 0:
            why = f"was ended by {_signal(-code)}"
        else:
            why = f"ended with exit code {code}" + (f" ({words[-400:]})" if words else "")
        self._finish(work, "interrupted", "program_ended", f"the calibration program {why}; {GOES_ON}")

    def _watch(self, work: _Work) -> None:
        """Renew the lease, and end the run where it must end."""
        renew_s = time.monotonic() + RENEW_S
        with self._publisher.subscribe("command", "lease", known=False) as news:
            while not work.over.is_set() and not news.closed:
                stopped = next(filter(None, map(_stop_of, news.wait(LOOK_S))), None)
                if work.over.is_set():
                    return
                if stopped is None and self._leases.was_stopped(work.lease):
                    stopped = _who_stopped(news)
                if stopped is not None:
                    words = f"{stopped}, {GOES_ON}"
                    self._finish(work, "interrupted", "stopped", words, and_motion=True)
                    return
                try:
                    if time.monotonic() >= renew_s or not self._leases.holds(work.lease.id):
                        self._leases.renew(work.lease.id, LEASE_S)
                        renew_s = time.monotonic() + RENEW_S
                except MastctlError as error:
                    self._finish(work, "interrupted", "taken", f"{error}; {GOES_ON}")
                    return
                self._check_alive(work)

    def _check_alive(self, work: _Work) -> None:
        """End a program that hangs."""
        child = work.child
        if child is None:
            return
        silent_s = time.monotonic() - child.heard_s
        if work.outcome is not None and silent_s > LINGERS_S:
            child.kill()
        elif work.run.state != "asking" and silent_s > SILENT_S:
            words = f"the calibration program said nothing for {silent_s:.0f} s and was ended; {GOES_ON}"
            self._finish(work, "interrupted", "silent", words, and_motion=True)

    def _finish(
        self, work: _Work, state: BenchState, code: str | None, sentence: str, *, and_motion: bool = False
    ) -> None:
        """End a run, once: the program first, then its right to steer, then what it has moving."""
        with self._telling:
            if work.over.is_set():
                return
            outcome = work.outcome
            work.over.set()
        if work.child is not None:
            work.child.kill()
        ours = self._leases.holds(work.lease.id)
        with contextlib.suppress(MastctlError):  # taken over, or over by time
            self._leases.release(work.lease.id)
        if and_motion and ours and self._operations.running is not None:
            try:
                self._stopping.stop(sentence)
            except DriverError as error:
                log.error("the head did not confirm the stop as a bench calibration ended: %s", error)
        work.give_back()
        if work.child is not None:
            work.child.join()
        self._keep_end(work, ended(outcome or work.run, state, code, sentence))

    def _keep_end(self, work: _Work, run: GuidedRun) -> None:
        """Write down how it ended, and tell it."""
        if run.state == "done":
            try:
                run = replace(run, mast_file=str(work.folder.asked()["mast_file"]))
            except (BadFile, KeyError) as error:
                log.error("the run's own words are lost: %s", error)
        if work.folder.page.is_file():
            run = replace(run, report=work.folder.name)
        try:
            work.folder.keep_end(run)
        except BadFile as error:
            log.error("how the bench calibration ended is not kept: %s", error)
        work.run = run
        (log.info if run.state == "done" else log.warning)("bench calibration %s: %s", run.name, run.sentence)
        self._publish(work)

    def _publish(self, work: _Work) -> None:
        """Tell how it is now; in turn, so that nobody hears an older word after a newer one."""
        with self._publishing:
            self._publisher.publish("bench", "run", work.run)


def _stop_of(one: Published) -> str | None:
    """Who pressed stop and whether the head confirmed it, if that is what was published."""
    if one.topic != "command" or one.value.get("command") not in ("stop", "estop") or "ended" in one.value:
        return None
    what = "stop" if one.value["command"] == "stop" else "the emergency stop"
    stands = "the head stands still" if one.value.get("result") == "ok" else "the head did not confirm it"
    return f"{one.value.get('who', 'somebody')} pressed {what}; {stands}"


def _who_stopped(news: ThreadSubscription) -> str:
    """Who pressed the stop that has ended the lease: it is published when the head has confirmed it."""
    until_s = time.monotonic() + TOLD_S
    while (left_s := until_s - time.monotonic()) > 0.0 and not news.closed:
        stopped = next(filter(None, map(_stop_of, news.wait(left_s))), None)
        if stopped is not None:
            return stopped
    return "a stop was requested"


def _check_room(masts: Path, state: Path) -> None:
    """Pass if the mast file and the pictures can be written. Raises Unable."""
    try:
        with tempfile.TemporaryFile(dir=masts):
            pass
    except OSError as error:
        words = f"the mast file would go to {masts}, where this daemon cannot write"
        raise Unable("unwritable", f"{words}: {error.strerror or error}") from None
    try:
        free = shutil.disk_usage(state).free
    except OSError as error:
        raise Unable("unwritable", f"{state}: {error.strerror or error}") from None
    if free < FREE_BYTES:
        words = f"{free / 1e6:.0f} MB are free in {state} where {FREE_BYTES / 1e6:.0f} are needed"
        raise Unable("disk_low", words)


def _signal(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _first(*values: Any) -> Any:
    return next(value for value in values if value is not None)


def _mm(size_m: tuple[float, float]) -> str:
    return f"{1000 * size_m[0]:.0f} x {1000 * size_m[1]:.0f} mm"
