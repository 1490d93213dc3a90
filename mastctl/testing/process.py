"""The process that a worker's daemons live in, from the side of the tests."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mastctl.testing.rover import RoverError

ANSWER_S = 120.0
"""The time allowed for an answer, seconds: closing a daemon whose devices hang takes longest."""

START_S = 600.0
"""The time allowed for a start, seconds: the first one after an installation compiles the renderer."""

END_S = 5.0


class RoverProcess:
    """A process for one daemon after the other: the compiled renderer and the ground are made once.

    It ends with `close`, and by itself when the process that made it is gone. ``log`` is the file of the
    daemons' stderr, and temporary files go beside it; ``workers`` such processes share the processors.
    """

    def __init__(self, log: Path, workers: int = 1) -> None:
        self.log = log
        self._lock = threading.Lock()
        self._rest = b""
        cores = len(os.sched_getaffinity(0))
        share = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        share["NUMBA_NUM_THREADS"] = str(max(1, cores // max(1, workers)))
        with log.open("ab") as errors:
            self._process = subprocess.Popen(
                # -P: a folder of the project named as one of ours ("drivers") is not taken for it.
                [sys.executable, "-P", "-m", "mastctl.testing.serve", str(os.getpid())],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env={**share, **os.environ, "TMPDIR": str(log.parent)},  # killed, it clears nothing away
                # Ctrl-C is for the tests; the daemon is ended by its fixture, after them.
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        """The process's id."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    def open(self, options: Mapping[str, Any]) -> str:
        """Start a daemon in place of the one before and return its address. Raises RoverError."""
        return str(self._answer({"do": "open", **options}, START_S)["url"])

    def request(self, do: str, **parameters: Any) -> Any:
        """Have an order carried out, and return its answer. Raises RoverError."""
        return self._answer({"do": do, **parameters}, ANSWER_S)

    def close(self) -> None:
        """End it; bounded."""
        process = self._process
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()  # its sign to end
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()

    def _answer(self, order: dict[str, Any], within_s: float) -> Any:
        stdin = self._process.stdin
        assert stdin is not None
        with self._lock:
            try:
                stdin.write(json.dumps(order).encode() + b"\n")
                stdin.flush()
                answer = json.loads(self._line(within_s))
            except (OSError, ValueError) as error:
                code = self._process.poll()
                how = f"it ended with {code}" if code is not None else str(error)
                raise RoverError(f"the daemon's process does not answer: {how}; {self.log}", "gone") from None
        if "error" in answer:
            raise RoverError(answer["error"]["message"], answer["error"]["code"])
        return answer["done"]

    def _line(self, within_s: float) -> bytes:
        """One line of its stdout."""
        assert self._process.stdout is not None
        stdout = self._process.stdout.fileno()
        until_s = time.monotonic() + within_s
        while b"\n" not in self._rest:
            if not select.select([stdout], [], [], max(0.0, until_s - time.monotonic()))[0]:
                raise OSError(f"nothing came within {within_s:g} s")
            data = os.read(stdout, 65536)
            if not data:
                self._process.wait(END_S)
                raise OSError("it hung up")
            self._rest += data
        line, _, self._rest = self._rest.partition(b"\n")
        return line
