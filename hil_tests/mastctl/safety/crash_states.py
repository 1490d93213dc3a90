"""What a disk may hold after the power went: every state that a file system may leave.

The calls of a piece of code are recorded while they are carried out. A crash is then laid between any two of
them, and after each crash the names and the bytes that had not been synced may be there or not, each by
itself: file systems order neither.
"""

from __future__ import annotations

import errno
import itertools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

CALLS = ("open", "write", "fsync", "replace", "unlink", "link", "close", "fchmod")


@dataclass
class Recorder:
    """Stands before ``os`` for one folder: notes the calls, and fails one of them.

    Attributes
    ----------
    fail_at, error
        The number of the call that fails, and with what.
    """

    folder: Path
    fail_at: int = -1
    error: int = errno.EIO
    calls: list[tuple[Any, ...]] = field(default_factory=list)
    _files: dict[int, str] = field(default_factory=dict)

    def count(self) -> None:
        number = len(self.calls)
        if number == self.fail_at:
            self.calls.append(("failed",))
            raise OSError(self.error, os.strerror(self.error))

    def ours(self, path: Any) -> bool:
        return isinstance(path, (str, os.PathLike)) and Path(path).is_relative_to(self.folder)

    @contextmanager
    def installed(self) -> Iterator[Recorder]:
        """Stand there for a while."""
        true = {name: getattr(os, name) for name in CALLS}

        def opened(path: Any, flags: int, *others: Any, **named: Any) -> int:
            if not self.ours(path):
                return int(true["open"](path, flags, *others, **named))
            if flags & os.O_CREAT:
                self.count()
                self.calls.append(("create", str(path)))
            descriptor = int(true["open"](path, flags, *others, **named))
            self._files[descriptor] = str(path)
            return descriptor

        def written(descriptor: int, data: Any) -> int:
            if descriptor in self._files:
                self.count()
                data = bytes(data)[: max(1, len(data) // 2)]  # a disk takes what it likes
                self.calls.append(("write", self._files[descriptor], data))
            return int(true["write"](descriptor, data))

        def synced(descriptor: int) -> None:
            if descriptor in self._files:
                self.count()
                self.calls.append(("fsync", self._files[descriptor]))
            true["fsync"](descriptor)

        def closed(descriptor: int) -> None:
            self._files.pop(descriptor, None)
            true["close"](descriptor)

        def two(name: str) -> Callable[..., None]:
            def call(source: Any, target: Any, **named: Any) -> None:
                if self.ours(source):
                    self.count()
                    self.calls.append((name, str(source), str(target)))
                true[name](source, target, **named)

            return call

        def unlinked(path: Any, **named: Any) -> None:
            if self.ours(path):
                if not Path(path).exists():
                    raise FileNotFoundError(errno.ENOENT, "no such file", str(path))
                self.count()
                self.calls.append(("unlink", str(path)))
            true["unlink"](path, **named)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(os, "open", opened)
            patch.setattr(os, "write", written)
            patch.setattr(os, "fsync", synced)
            patch.setattr(os, "close", closed)
            patch.setattr(os, "replace", two("replace"))
            patch.setattr(os, "link", two("link"))
            patch.setattr(os, "unlink", unlinked)
            yield self


@dataclass
class _Inode:
    bytes_now: bytes = b""
    bytes_synced: bytes = b""


def crash_states(
    before: dict[str, bytes], calls: list[tuple[Any, ...]], folder: str
) -> Iterator[tuple[int, dict[str, bytes]]]:
    """Yield (calls made, what the folder may hold then): names and bytes, each distinct state once.

    Parameters
    ----------
    before
        Names (whole paths) and bytes that were there, synced.
    calls
        As a `Recorder` noted them.
    folder
        Whose fsync puts the names on the disk.
    """
    for made in range(len(calls) + 1):
        seen = set()
        for state in _after(before, calls[:made], folder):
            key = tuple(sorted(state.items()))
            if key not in seen:
                seen.add(key)
                yield made, state


def _after(before: dict[str, bytes], calls: list[tuple[Any, ...]], folder: str) -> Iterator[dict[str, bytes]]:
    names = {name: _Inode(data, data) for name, data in before.items()}
    durable = dict(names)
    pending: list[tuple[Any, ...]] = []  # changes of names since the folder was synced
    for call in calls:
        if call[0] == "create":
            names[call[1]] = _Inode()
            pending.append(("set", call[1], names[call[1]]))
        elif call[0] == "write":
            names[call[1]].bytes_now += call[2]
        elif call[0] == "fsync" and call[1] == folder:
            durable, pending = dict(names), []
        elif call[0] == "fsync":
            names[call[1]].bytes_synced = names[call[1]].bytes_now
        elif call[0] == "link":
            names[call[2]] = names[call[1]]
            pending.append(("set", call[2], names[call[2]]))
        elif call[0] == "replace":
            names[call[2]] = names.pop(call[1])
            pending.append(("move", call[2], names[call[2]], call[1]))
        elif call[0] == "unlink":
            pending.append(("gone", call[1]))
            del names[call[1]]
    for kept in itertools.product((False, True), repeat=len(pending)):
        held = dict(durable)
        for change in itertools.compress(pending, kept):
            if change[0] in ("set", "move"):
                held[change[1]] = change[2]
            if change[0] == "move":
                held.pop(change[3], None)
            if change[0] == "gone":
                held.pop(change[1], None)
        for whole in (0, 1, 2):  # bytes that were not synced: none, half, all
            yield {name: _bytes(inode, whole) for name, inode in held.items()}


def _bytes(inode: _Inode, whole: int) -> bytes:
    new = inode.bytes_now[len(inode.bytes_synced) :]
    return inode.bytes_synced + new[: len(new) * whole // 2]
