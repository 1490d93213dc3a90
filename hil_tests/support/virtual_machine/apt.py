"""Debian's package manager, which something else may be using: then this waits, and says for whom.

``DPkg::Lock::Timeout`` makes apt wait without a word, and for dpkg's locks only, not for those of the package
lists and of the downloads. So what counts is apt's own word: refused for a lock, it is asked again.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path

WAIT_S = 600.0
AGAIN_S, TOLD_AGAIN_S = 2.0, 30.0
LOCKED = re.compile(r"Could not get lock (\S+?)(?:\.| -) (?:It is held by process (\d+) \(([^)]*)\))?")

Tell = Callable[[str], None]


class Busy(Exception):
    """Something else kept the package manager for all the time that one waits; the message says who."""


def apt_get(
    *arguments: str,
    tell: Tell,
    cwd: Path | None = None,
    wait_s: float = WAIT_S,
    again_s: float = AGAIN_S,
    told_again_s: float = TOLD_AGAIN_S,
) -> subprocess.CompletedProcess[str]:
    """Run apt-get quietly, and again for as long as it is refused for a lock that something else holds.

    Parameters
    ----------
    arguments
        What comes after ``apt-get -qq``.
    tell
        Is given a sentence when the waiting begins, whenever another holds the lock, now and then meanwhile,
        and when it ends.
    cwd
        Where it runs, and where ``download`` puts its file.
    wait_s, again_s, told_again_s
        The longest wait; how often apt is asked; how often one is told.

    Raises
    ------
    Busy
        If the lock is still held after `wait_s`.
    """
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive", "LC_ALL": "C.UTF-8"}
    began_s, told_s, told_who = time.monotonic(), 0.0, ""
    while True:
        done = subprocess.run(
            ["apt-get", "-qq", *arguments],
            cwd=cwd, env=environment, capture_output=True, text=True, errors="replace",
        )  # fmt: skip
        waited_s = time.monotonic() - began_s
        refused = LOCKED.search(done.stderr) if done.returncode != 0 else None
        if refused is None:
            if told_who:
                tell(f"the package manager is free after {waited_s:.0f} s")
            return done
        path, number, name = refused.groups()
        who = f"process {number} ({name})" if number else "another process"
        if waited_s >= wait_s:
            raise Busy(f"the package manager was busy for {wait_s / 60:g} min, now {who} holds {path}")
        if who != told_who:
            tell(f"waiting for {who}, which holds {path}, for {wait_s / 60:g} min at most")
            told_s, told_who = waited_s, who
        elif waited_s - told_s >= told_again_s:
            tell(f"still waiting for {who} after {waited_s:.0f} s")
            told_s = waited_s
        time.sleep(again_s)


def install(programs: Mapping[str, str], tell: Tell) -> str:
    """See to programs, Debian's package by name; by apt-get where they are missing and we may.

    Returns the missing packages and how to get them, empty when all are there.
    """
    missing = sorted({debian for program, debian in programs.items() if not shutil.which(program)})
    if not missing:
        return ""
    command = ["install", "-y", "--no-install-recommends", *missing]
    told = f"{', '.join(missing)}; as root on Debian: apt-get {' '.join(command)}"
    if os.geteuid() != 0 or not shutil.which("apt-get"):
        return told
    tell(f"installing {', '.join(missing)}")
    try:
        apt_get("update", tell=tell)
        done = apt_get(*command, tell=tell)
    except Busy as busy:
        return f"{told}; just now {busy}"
    if done.returncode == 0:
        return ""
    return f"{told}, which failed just now: {' '.join(done.stderr.split())[-200:]}"
