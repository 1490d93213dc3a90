"""Signals that end a process: which they are, and an end in order instead of a death on the spot.

Also the two that stop a job in the background when it uses its terminal: SIGTTIN and SIGTTOU.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

# The program's own defects; after these nothing can be trusted to run.
_DEFECTS = {
    signal.SIGSEGV, signal.SIGBUS, signal.SIGFPE, signal.SIGILL, signal.SIGABRT, signal.SIGTRAP,
    signal.SIGSYS,
}  # fmt: skip
# Those that end no process, or cannot be caught; Python ignores SIGPIPE and SIGXFSZ: there the write fails.
_OTHERS = {
    signal.SIGCHLD, signal.SIGURG, signal.SIGWINCH, signal.SIGCONT, signal.SIGPIPE, signal.SIGXFSZ,
    signal.SIGTSTP, signal.SIGTTIN, signal.SIGTTOU, signal.SIGKILL, signal.SIGSTOP,
}  # fmt: skip

ENDING: frozenset[int] = frozenset(map(int, signal.valid_signals() - _DEFECTS - _OTHERS))
"""Every signal that ends a process by default and can be caught."""


class Ended(KeyboardInterrupt):
    """A signal requested the end. Every handler of Ctrl-C handles it too."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(f"ended by signal {number}")


def may_read_stdin() -> bool:
    """Return whether stdin can be read: not a terminal while this job is in its background (SIGTTIN)."""
    try:
        return not sys.stdin.isatty() or os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp()
    except (OSError, ValueError, AttributeError):  # closed, no file, or another session's terminal
        return False


def write_from_background() -> None:
    """Let a job in the background write to its terminal whatever ``stty tostop`` says."""
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)


def wanted() -> tuple[int, ...]:
    """Return the ending signals but those that the parent process wants ignored, as nohup does SIGHUP."""
    kept = {int(signal.SIGTERM), int(signal.SIGINT)}
    return tuple(n for n in sorted(ENDING) if n in kept or signal.getsignal(n) is not signal.SIG_IGN)


@contextmanager
def raised(*also: int) -> Iterator[None]:
    """Raise Ended in the main thread at the first ending signal inside the block; later ones do nothing.

    SIGINT stays a KeyboardInterrupt each time, unless it is named in ``also``. Signals that are handled or
    ignored already stay as they are.
    """
    requested = False

    def end(number: int, frame: object) -> None:
        nonlocal requested
        if not requested:
            requested = True
            raise Ended(number)

    before = {n: signal.getsignal(n) for n in ENDING}
    ours = [n for n, handler in before.items() if handler is signal.SIG_DFL or n in also]
    try:
        for number in ours:
            signal.signal(number, end)
    except ValueError:  # not the main thread, which handles signals
        ours = []
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, before[number])


def end_with_parent() -> None:
    """Have this process, which multiprocessing started, end when the process that started it is gone."""
    from multiprocessing import parent_process  # late: commands that end signals start no process

    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, name="end with parent", daemon=True).start()
