"""poll(2) itself: Python's own also reads the clock, which may cost as much as the poll."""

from __future__ import annotations

import ctypes
import math
import select

_poll = ctypes.CDLL(None).poll  # lets go of Python's lock


class _PollFd(ctypes.Structure):
    _fields_ = (("fd", ctypes.c_int), ("events", ctypes.c_short), ("revents", ctypes.c_short))


class Poll:
    """Waits until one of some descriptors can be read. For one thread."""

    def __init__(self, *descriptors: int) -> None:
        self._entries = (_PollFd * len(descriptors))(*[_PollFd(fd, select.POLLIN, 0) for fd in descriptors])
        self._count = ctypes.c_ulong(len(descriptors))

    def wait(self, timeout_s: float) -> bool:
        """Return whether there is something; False after the time, and earlier if a signal comes between."""
        return bool(_poll(self._entries, self._count, max(0, math.ceil(1e3 * timeout_s))) > 0)

    def events(self, index: int) -> int:
        """Return what the last `wait` that returned True found of a descriptor, as bits of `select`."""
        return int(self._entries[index].revents)
