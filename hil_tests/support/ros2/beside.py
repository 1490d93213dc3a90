"""The adapter and a program that knows only ROS, as processes beside a daemon."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from hil_tests.support.ros2.prefix import variables

HERE = Path(__file__).resolve().parent
ENDS_S = 30.0


class PeerFailed(Exception):
    """What the program that knows only ROS said instead of a result."""


class RosPeer:
    """A process of `hil_tests.support.ros2.peer`; each of its verbs is a method."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def __getattr__(self, verb: str) -> Any:
        def ask(*arguments: Any) -> Any:
            lines_in, lines_out = self._process.stdin, self._process.stdout
            assert lines_in is not None and lines_out is not None
            lines_in.write(json.dumps([verb, *arguments]) + "\n")
            lines_in.flush()
            answer = json.loads(lines_out.readline())
            if "error" in answer:
                raise PeerFailed(f"{verb} {arguments}: {answer['error']}")
            return answer["ok"]

        return ask


def _environment(prefix: Path, domain: int) -> dict[str, str]:
    return os.environ | variables(prefix) | {"ROS_DOMAIN_ID": str(domain)}


@contextlib.contextmanager
def adapter(
    prefix: Path, url: str, domain: int, log: Path, more: Sequence[str] = ()
) -> Iterator[subprocess.Popen[str]]:
    """Run `mastctl ros2`, ready when it says so. Raises RuntimeError with the last it said."""
    command = [sys.executable, "-m", "mastctl", "ros2", "--url", url, *more]
    with (
        log.open("w") as said,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=said, text=True, env=_environment(prefix, domain)
        ) as process,
    ):
        try:
            assert process.stdout is not None
            if "/mastctl is a node" not in process.stdout.readline():
                raise RuntimeError(f"the adapter did not start: {log.read_text()[-500:]}")
            yield process
        finally:
            process.terminate()
            try:
                process.wait(ENDS_S)
            except subprocess.TimeoutExpired:
                process.kill()


@contextlib.contextmanager
def peer(prefix: Path, domain: int) -> Iterator[RosPeer]:
    """Run a program that knows only ROS: by the prefix's own Python, which has no mastctl."""
    environment = _environment(prefix, domain) | {"PYTHONSAFEPATH": "1"}
    command = [str(prefix / "bin" / "python"), str(HERE / "peer.py")]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd="/"
    ) as process:
        try:
            yield RosPeer(process)
        finally:
            process.terminate()
