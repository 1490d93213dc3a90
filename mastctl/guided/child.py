"""A program beside the daemon that tells in lines and is answered in lines; nothing here waits for it.

It ends with the daemon however that ends: its answers end then, and it sees that. What it says is read as it
comes and bounded, by length and by rate, so that one that floods costs the daemon next to nothing.
"""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

log = logging.getLogger(__name__)

LONGEST_LINE = 1 << 18
"""Bytes; the longest is the result, some 50 kB of a bench with six cameras."""

BURST, LINES_PER_S = 1000, 50
"""More lines than this come from nobody who works."""

KEPT_WORDS, LONGEST_WORDS = 20, 400
"""Of what it says on stderr: the last lines, cut."""

ENDS_S = 5.0


class GuidedProgram:
    """One process; it is at work from the start on.

    Parameters
    ----------
    command, folder, environment
        What is run, where, and what it finds in its environment beside the daemon's own.
    heard
        Gets each line, bytes, in a thread of its own.
    ended
        Called once, in the same thread, when it is over and all its lines were heard: with its exit code
        (negative: the signal), and the last that it said on stderr.

    Raises
    ------
    OSError
        If it cannot be started.
    """

    def __init__(
        self,
        command: Sequence[str],
        folder: Path,
        environment: Mapping[str, str],
        heard: Callable[[bytes], None],
        ended: Callable[[int, str], None],
    ) -> None:
        self._heard, self._ended = heard, ended
        self._words: deque[str] = deque(maxlen=KEPT_WORDS)
        self._begun_s = time.monotonic()
        self.heard_s = self._begun_s
        self.flooded = False
        self._process = subprocess.Popen(
            list(command),
            cwd=folder,
            env={**os.environ, **environment},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            start_new_session=True,  # a Ctrl-C of the daemon's terminal is the daemon's
        )
        os.set_blocking(self._stdin, False)
        self._saying = threading.Thread(target=self._read_words, name="bench words", daemon=True)
        self._thread = threading.Thread(target=self._work, name="bench lines", daemon=True)
        self._saying.start()
        self._thread.start()

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    @property
    def _stdin(self) -> int:
        assert self._process.stdin is not None
        return self._process.stdin.fileno()

    def answer(self, word: str) -> bool:
        """Send a line; False if it does not take it. Never waits."""
        try:
            return os.write(self._stdin, f"{word}\n".encode()) > 0
        except (OSError, ValueError):
            return False

    def kill(self) -> None:
        """End it and whatever it started, at once; returns before it is over."""
        if self._process.poll() is None:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)

    def join(self, timeout_s: float = ENDS_S) -> bool:
        """Wait until it is over and `ended` has been called; whether that is so."""
        if threading.current_thread() is not self._thread:
            self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _work(self) -> None:
        stream = self._process.stdout
        assert stream is not None
        lines = 0
        try:
            while line := stream.readline(LONGEST_LINE):
                lines += 1
                self.heard_s = time.monotonic()
                if lines > BURST + LINES_PER_S * (self.heard_s - self._begun_s):
                    self.flooded = True
                    self.kill()
                    break
                try:
                    self._heard(line)
                except Exception:  # what it tells must not end who listens
                    log.exception("a line of the calibration could not be taken: %.200r", line)
        except (OSError, ValueError):
            pass
        code = self._over()
        self._ended(code, " / ".join(self._words))

    def _over(self) -> int:
        """Wait for its end, which is near when its lines have ended; let go of its pipes."""
        try:
            code = self._process.wait(ENDS_S)
        except subprocess.TimeoutExpired:
            self.kill()
            code = self._process.wait()
        self._saying.join(ENDS_S)
        for pipe in (self._process.stdin, self._process.stdout, self._process.stderr):
            if pipe is not None:
                with contextlib.suppress(OSError, ValueError):
                    pipe.close()
        return code

    def _read_words(self) -> None:
        stream = self._process.stderr
        assert stream is not None
        with contextlib.suppress(OSError, ValueError):
            while line := stream.readline(4096):
                words = " ".join(line.decode(errors="replace").split())
                if words:
                    self._words.append(words[:LONGEST_WORDS])
