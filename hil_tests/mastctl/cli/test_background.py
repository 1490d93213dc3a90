"""Commands in the background of a terminal: none reads its keystrokes, which would stop it (SIGTTIN).

A program in the background that reads its terminal is stopped by SIGTTIN (termios(3), "Job control").
"""

from __future__ import annotations

import os
import pty
import signal
import sys
from collections.abc import Callable

import pytest

from mastctl.signals import may_read_stdin


def in_a_session(asks: Callable[[], bool], background: bool) -> int:
    """Exit code (1: true) of a process whose stdin is its session's terminal, in its background or not."""
    process, terminal = pty.fork()
    if process == 0:  # a session of its own, in the foreground of its terminal
        if background:
            signal.signal(signal.SIGTTOU, signal.SIG_IGN)
            leader = os.fork()
            if leader == 0:
                os.setpgid(0, 0)
                os.tcsetpgrp(0, os.getpgrp())
                signal.pause()
            while os.tcgetpgrp(0) == os.getpgrp():
                pass
        sys.stdin = os.fdopen(0)
        os._exit(int(asks()))
    _, status = os.waitpid(process, 0)
    os.close(terminal)  # hangs up on whoever is left
    return os.waitstatus_to_exitcode(status)


@pytest.mark.parametrize("background", [False, True])
def test_only_a_job_in_the_foreground_reads_its_terminal(background: bool) -> None:
    assert in_a_session(may_read_stdin, background) == (0 if background else 1)


def test_a_pipe_is_read_wherever_the_job_is(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.close(write)
    with os.fdopen(read) as pipe:
        monkeypatch.setattr(sys, "stdin", pipe)
        assert may_read_stdin()
