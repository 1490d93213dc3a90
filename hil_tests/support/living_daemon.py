"""A daemon in a process of its own for campaigns and benchmarks: configuration, answers, vitals."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil
import yaml

from mastctl.config import load_config
from mastctl.packaged import default_config

_WIRES = {"dynamixel": "dynamixel", "ptu": "flir_ptu"}
_ANSWER_S = 30.0
_ENDS_S = 30.0
_KEPT_S = 2.0  # the daemon closes what has been idle for 5 s


def simulated(
    folder: Path, head: str, cameras: tuple[str, ...], more: Mapping[str, Any] | None = None
) -> Path:
    """Write the configuration of a simulated rover into a folder and return its path.

    Parameters
    ----------
    folder
        Gets the configuration, a second mast file and the daemon's state.
    head
        ``memory``, or the real driver on simulated bytes: ``dynamixel`` or ``ptu``.
    cameras
        Those of the packaged rover that are opened.
    more
        Further keys of the configuration.
    """
    packaged = default_config().resolve()
    document = yaml.safe_load(packaged.read_text())
    mast = packaged.parent / document["mast_file"]
    for name in ("mast.yaml", "other_mast.yaml"):
        (folder / name).write_bytes(mast.read_bytes())
    document["listen"] = {"port": 0}
    document["mast_file"] = "mast.yaml"
    document["cameras"] = {name: document["cameras"][name] for name in cameras}
    document["simulation"]["rover"] = str(packaged.parent / document["simulation"]["rover"])
    document["simulation"]["samples"] = 1
    document["state"] = {"folder": str(folder / "state")}
    if head in _WIRES:
        document["simulation"]["wire"] = _WIRES[head]
        del document["simulation"]["head"]  # the wire's own
    return written(folder, {**document, **(more or {})})


def written(folder: Path, document: Mapping[str, Any]) -> Path:
    """Write a configuration into a folder and return its path. Raises BadFile if it is none."""
    path = folder / "rover.yaml"
    path.write_text(yaml.safe_dump(dict(document)))
    load_config(path)
    return path


@contextlib.contextmanager
def started(
    config: Path, environment: Mapping[str, str] | None = None
) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Run a daemon: its process and its port; what it says goes to ``daemon.log`` beside its configuration.

    ``environment`` stands before this process's own.

    Raises
    ------
    RuntimeError
        If it did not start, with the last it said.
    """
    log = config.with_name("daemon.log")
    command = [sys.executable, "-m", "mastctl", "run", "--config", str(config)]
    with (
        log.open("w") as said,
        subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=said, text=True, env={**os.environ, **(environment or {})}
        ) as daemon,
    ):
        try:
            assert daemon.stdout is not None
            url = daemon.stdout.readline().strip()
            if not url:
                raise RuntimeError(f"the daemon did not start: {log.read_text()[-500:]}")
            yield daemon, int(url.rpartition(":")[2])
        finally:
            daemon.terminate()
            try:
                daemon.wait(_ENDS_S)
            except subprocess.TimeoutExpired:
                daemon.kill()


class Asker:
    """One client of a daemon, with one connection that is kept; for one thread. A context manager.

    Parameters
    ----------
    port, name
        Where the daemon listens, and what the client calls itself.
    """

    def __init__(self, port: int, name: str) -> None:
        self._name = name
        self._there = http.client.HTTPConnection("127.0.0.1", port, timeout=_ANSWER_S)
        self._asked_s = 0.0

    def ask(
        self, method: str, path: str, body: object = None, headers: Mapping[str, str] | None = None
    ) -> tuple[int, Mapping[str, str], bytes]:
        """Return status, headers (names in small letters) and body of an answer. Raises OSError."""
        sent = {"Mastctl-Client": self._name, **(headers or {})}
        if time.monotonic() - self._asked_s > _KEPT_S:
            self._there.close()
        data = None
        if body is not None:
            data, sent["Content-Type"] = json.dumps(body), "application/json"
        try:
            self._there.request(method, f"/api/v1{path}", data, sent)
            answer = self._there.getresponse()
            got = answer.read()
            self._asked_s = time.monotonic()
        except (OSError, http.client.HTTPException) as error:
            self._there.close()
            raise OSError(f"{method} {path}: {error!r}") from None
        return answer.status, {name.lower(): value for name, value in answer.getheaders()}, got

    def __enter__(self) -> Asker:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._there.close()


@dataclass(frozen=True)
class Vitals:
    """Memory of a process in RAM, 10⁶ bytes; its threads, and its descriptors in all and of each kind."""

    rss_mb: float
    threads: int
    descriptors: int
    open_files: Mapping[str, int]


def vitals(pid: int) -> Vitals:
    """Return the vitals of a process now. Raises psutil.NoSuchProcess if it is gone."""
    process, kinds = psutil.Process(pid), Counter[str]()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):
            kinds[_kind(str(link.readlink()))] += 1
    return Vitals(process.memory_info().rss / 1e6, process.num_threads(), sum(kinds.values()), kinds)


def _kind(target: str) -> str:
    """``socket:[123]`` as ``socket``; a file by its name."""
    return target.partition(":[")[0] if ":[" in target else Path(target).name
