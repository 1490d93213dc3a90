"""All checks of a daemon, from first to last, and the stop at the end of those that move its head."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from mastctl.client import ClientError
from mastctl.conform.checks import Check, Outcome, PromiseBroken, SubjectLost, run_checks
from mastctl.conform.commands import COMMANDS
from mastctl.conform.daemon import Daemon
from mastctl.conform.described import DESCRIBED
from mastctl.conform.motion import MOTION
from mastctl.conform.pictures import PICTURES
from mastctl.conform.refusals import REFUSALS
from mastctl.conform.report import Report
from mastctl.conform.states import STATES
from mastctl.conform.wire import Wire, stopped_for_good
from mastctl.errors import NotNow

log = logging.getLogger(__name__)

CHECKS: Sequence[Check[Daemon]] = (
    *STATES.checks, *PICTURES.checks, *COMMANDS.checks, *MOTION.checks, *REFUSALS.checks, *DESCRIBED.checks,
)  # fmt: skip


@contextmanager
def daemon_under_test(url: str, reach_rad: float) -> Iterator[Daemon]:
    """Connect to a daemon that is at rest.

    Raises
    ------
    NotNow
        ``busy``, if it is at work: a check would get into somebody's way.
    ClientError
        If nobody answers there.
    """
    wire = Wire(url)
    try:
        try:
            daemon = Daemon(wire, reach_rad)
        except SubjectLost as reason:
            raise ClientError("no_daemon", str(reason)) from None
        except PromiseBroken as reason:
            words = f"what answers at {url} is no mastctl daemon: {reason}"
            raise ClientError("bad_answer", words) from None
        at_work = _at_work(daemon.began)
        if at_work:
            raise NotNow("busy", f"the daemon at {url} is at work ({at_work}); check it when it rests")
        yield daemon
    finally:
        wire.close()


def check_daemon(
    daemon: Daemon,
    checks: Sequence[Check[Daemon]],
    motion: bool,
    tell: Callable[[Outcome], object] = lambda outcome: None,
) -> Report:
    """Run checks on a daemon. However it ends, by Ctrl-C too, a head that was moved is stopped.

    Parameters
    ----------
    daemon, checks
        Of whom to ask what; `CHECKS` are all.
    motion
        Whether the head may be moved.
    tell
        Called with each outcome as it comes.
    """
    began_s = time.time()
    left = ""
    try:
        outcomes = run_checks(checks, daemon, motion=motion, tell=tell)
    finally:
        if motion and any(check.moves for check in checks):
            left = _stopped_at_the_end(daemon.wire.url)
    return Report("daemon", daemon.wire.url, began_s, outcomes, left)


def _stopped_at_the_end(url: str) -> str:
    """Stop the head, say why if that was not confirmed. A second Ctrl-C leaves the stop under way."""
    found: list[str] = []

    def stop() -> None:
        found.append(stopped_for_good(url))
        if found[0]:
            log.error("%s", found[0])

    thread = threading.Thread(target=stop, name="stop at the end")
    thread.start()
    thread.join()
    return found[0]


def _at_work(status: dict[str, Any]) -> str:
    """What the daemon is doing, in words; empty at rest."""
    if status.get("operation") is not None:
        return f"operation {status['operation']}"
    if status.get("moving"):
        return "the head moves"
    control = status.get("control")
    if isinstance(control, dict):
        return f"{control.get('holder')} steers"
    track = status.get("track")
    following = isinstance(track, dict) and track.get("state") in ("starting", "tracking")
    return "it follows a target" if following else ""
