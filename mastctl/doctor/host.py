"""The machine itself: is its clock right, has its disk room, may this process open enough files?"""

from __future__ import annotations

import ctypes
import os
import resource
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path

from drivers.hardware import BUILT_IN, InstalledDriver
from drivers.sim.kept import MOST_BYTES, kept_bytes, kept_home
from mastctl.doctor.findings import Finding

LEAST_FREE_BYTES = 1_000_000_000  # the recorder's ring of some minutes of two cameras
LEAST_DESCRIPTORS = 256
BUILT = datetime(2025, 1, 1, tzinfo=UTC)  # no clock that is right says less
_NOT_SYNCHRONISED = 0x40  # STA_UNSYNC of adjtimex(2)


class _Timex(ctypes.Structure):
    """The beginning of struct timex, and room for the rest; only ``status`` is read."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_long * 64),
    )


def clock_status() -> int | None:
    """Return the kernel's status bits of the wall clock, None if it does not tell."""
    told = _Timex()
    return None if ctypes.CDLL(None).adjtimex(ctypes.byref(told)) < 0 else told.status


def examine_clock(
    now_s: Callable[[], float] = time.time, status: Callable[[], int | None] = clock_status
) -> Finding:
    """Look at the wall clock, which dates records, logs and mast files; motion does not depend on it."""
    now = datetime.fromtimestamp(now_s(), UTC)
    if now < BUILT:
        words = f"the clock says {now:%Y-%m-%d}, which is past"
        return Finding("clock", "bad", words, "set it: records and mast files are dated by it")
    bits = status()
    if bits is None or bits & _NOT_SYNCHRONISED:
        words = f"the clock says {now:%Y-%m-%d %H:%M} UTC and follows no time server"
        return Finding("clock", "unsure", words, "install chrony or switch systemd-timesyncd on")
    return Finding("clock", "good", f"{now:%Y-%m-%d %H:%M} UTC, kept by a time server")


def examine_folder(what: str, folder: Path) -> Iterator[Finding]:
    """Look whether a folder, or the one that it would be made in, may be written and has room."""
    there = next(one for one in (folder, *folder.parents) if one.exists())
    if not there.is_dir():
        yield Finding(what, "bad", f"{there} is no folder", "name another, or move it away")
        return
    if not os.access(there, os.W_OK | os.X_OK):
        words = f"{there} may not be written by this user"
        yield Finding(what, "bad", words, f'sudo chown "$USER" {there}, or name another folder')
        return
    free = shutil.disk_usage(there).free
    told = f"{folder}: {free / 1e9:.1f} GB free"
    if free < LEAST_FREE_BYTES:
        yield Finding(what, "unsure", told, "make room: what happened before a fault may not be recorded")
    else:
        yield Finding(what, "good", told)


def examine_drivers(installed: Sequence[InstalledDriver]) -> Iterator[Finding]:
    """List the drivers that installed packages offer, and those that cannot be meant by their name."""
    names = [(one.kind, one.name) for one in installed]
    for one in installed:
        what, told = f"driver {one.name}", f"for a {one.kind}: {one.factory} of {one.package}"
        if one.name in BUILT_IN:
            words = f"{told}; mastctl's own driver of this name is used instead"
            yield Finding(what, "unsure", words, f"name it {one.factory} in the configuration")
        elif names.count((one.kind, one.name)) > 1:
            words = f"{told}; another package offers one of this name"
            yield Finding(what, "unsure", words, "uninstall one of them, or name the factory itself")
        else:
            yield Finding(what, "good", told)


def examine_kept() -> Finding:
    """Look how much is kept of what takes long to make, and how much that can become."""
    sizes = {kind: kept_bytes(kind) for kind in MOST_BYTES}
    kinds = ", ".join(f"{kind} {size / 1e6:.0f}" for kind, size in sizes.items())
    most = sum(MOST_BYTES.values())
    told = f"{kept_home()}: {sum(sizes.values()) / 1e6:.0f} MB ({kinds}) of at most {most / 1e6:.0f} MB"
    return Finding("kept", "good", told)


def examine_descriptors() -> Finding:
    """Look how many files, sockets and devices a process of this user may have open."""
    most = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    told = f"{most} files and connections at once"
    if most != resource.RLIM_INFINITY and most < LEAST_DESCRIPTORS:
        return Finding(
            "descriptors", "unsure", told, f"ulimit -n {LEAST_DESCRIPTORS} or more, LimitNOFILE= of the unit"
        )
    return Finding("descriptors", "good", told if most != resource.RLIM_INFINITY else "as many as there are")
