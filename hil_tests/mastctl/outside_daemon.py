"""A daemon in a process of its own, on devices from outside: a slow head, a camera that hangs."""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from calib.files.mast_file import save_rig
from hil_tests import forks
from hil_tests.mastctl.service_fakes import CONFIG, rig
from hil_tests.waiting import NET_S, until
from mastctl.client import Client, ClientError

GOAL_RAD = 1.9
SPEED_RAD_PER_S = 0.01  # the goal is three minutes away: within a test's net the head does not arrive
SHORT_OF_GOAL_RAD = 1.5  # a head that stands before this was stopped, however slow the machine is

# Devices from outside for daemons of their own process: a head that takes its time, a camera that may hang.
OUTSIDE = (
    f"""
SPEED_RAD_PER_S = {SPEED_RAD_PER_S}
"""
    + """
import os, time
from types import SimpleNamespace

import numpy as np


class Head:
    def __init__(self, log):
        self.log, self.at, self.goal, self.begun = log, 0.0, 0.0, 0.0

    def note(self, word):
        with open(self.log, "a") as log:
            log.write(word + "\\n")

    def pan(self):
        way, gone = self.goal - self.at, SPEED_RAD_PER_S * (time.monotonic() - self.begun)
        return self.goal if gone >= abs(way) else self.at + np.sign(way) * gone

    def read(self):
        pan = float(self.pan())
        moving = pan != self.goal
        return SimpleNamespace(pan_rad=pan, tilt_rad=0.0, moving=moving, time_s=time.monotonic(), faults=[])

    def move(self, pan_rad, tilt_rad, speed_rad_per_s=None):
        self.note("move")
        self.at, self.begun, self.goal = self.pan(), time.monotonic(), pan_rad

    def stop(self):
        self.at = self.goal = self.pan()
        self.note(f"stop {self.goal:.3f}")

    def close(self):
        self.note("close")


class Camera:
    def next_frame(self, exposed_after_s, timeout_s):
        time.sleep(60.0)

    def close(self):
        pass
"""
)


def write_config(folder: Path, listen: str = "{port: 0}", devices: str = OUTSIDE) -> Path:
    """A configuration with devices from outside this repository."""
    save_rig(rig(), folder / "little.yaml")
    (folder / "outside_devices.py").write_text(devices)
    text = CONFIG.format(listen=listen).replace(
        "pan_tilt: {driver: fake}",
        f"pan_tilt: {{driver: 'outside_devices:Head', options: {{log: '{folder / 'head.log'}'}}}}",
    )
    text = text.replace("speed_rad_per_s: 0.5", f"speed_rad_per_s: {SPEED_RAD_PER_S}")
    path = folder / "daemon.yaml"
    path.write_text(text.replace("driver: fake", "driver: 'outside_devices:Camera'"))
    return path


@contextmanager
def daemon_process(
    folder: Path,
    config: Path,
    *,
    stdout: Any = subprocess.PIPE,
    stderr: Any = subprocess.PIPE,
    prepare: Callable[[], object] | None = None,
) -> Iterator[subprocess.Popen[str]]:
    """A daemon in a process of its own, on the devices above; forked, unless something is to be prepared."""
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    command = [*forks.MASTCTL, "run", "--config", str(config)]
    popen = subprocess.Popen if prepare else forks.Popen
    with (
        tempfile.TemporaryDirectory() as temporary,  # killed, it clears nothing away
        popen(
            command, stdout=stdout, stderr=stderr, text=True, env=environment | {"TMPDIR": temporary},
            cwd=folder, preexec_fn=prepare,
        ) as made,
    ):  # fmt: skip
        try:
            yield made
        finally:
            made.kill()


def line(made: subprocess.Popen[str]) -> str:
    assert made.stdout is not None
    return made.stdout.readline().strip()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def answers(url: str) -> bool:
    with contextlib.suppress(ClientError), Client(url, timeout_s=2.0) as client:
        return bool(client.status())
    return False


def under_way(client: Client) -> None:
    """Send the head on its long way and wait until it moves."""
    client.point(pan_rad=GOAL_RAD, tilt_rad=0.0)
    until(lambda: client.status()["moving"], "the move")


def stands_short_of_its_goal(client: Client) -> None:
    until(lambda: not client.status()["moving"], "the rest")
    assert client.status()["joints"]["pan_rad"] < SHORT_OF_GOAL_RAD


class Pipe:
    """A pipe that nobody reads, as small as the kernel makes them."""

    def __init__(self) -> None:
        self.read, self.write = os.pipe()
        fcntl.fcntl(self.write, fcntl.F_SETPIPE_SZ, 4096)

    def fill(self) -> None:
        """Write until nothing more fits."""
        with open(f"/proc/self/fd/{self.write}", "wb", buffering=0, opener=_not_waiting) as end:
            while end.write(b"\n"):  # None when it is full
                pass

    def drain(self, until: bytes) -> bytes:
        """Read until some words came."""
        got = b""
        until_s = time.monotonic() + NET_S
        while until not in got and time.monotonic() < until_s:
            got += os.read(self.read, 4096)
        return got


def _not_waiting(path: str, flags: int) -> int:
    return os.open(path, os.O_WRONLY | os.O_NONBLOCK)
