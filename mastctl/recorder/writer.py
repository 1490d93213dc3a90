"""One MCAP file that a killed daemon leaves readable: chunks of a quarter of a second, written and synced.

The library's writer buffers, does not sync, and writes its index at the end. Here the file is unbuffered,
mast file and configuration stand at its start with their digests, and every chunk is written whole at once
and then synced by a thread that alone waits for the disk (`drivers.recordings.mcap_file` reads what is left).
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from google.protobuf.message import Message
from mcap.writer import CompressionType, Writer

from mastctl.recorder.schemas import described

FINISH_S = 3.0


class Sync:
    """Has a file's bytes on the disk soon after each `ask`; nobody else waits for the disk.

    Parameters
    ----------
    descriptor
        Of the file; closed by `finish`.
    folder
        Where the file was just made: its name is put on the disk first.
    """

    def __init__(self, descriptor: int, folder: Path) -> None:
        self._descriptor = descriptor
        self._folder = folder
        self._asked = threading.Event()
        self._last = False
        self._since_s: float | None = None
        self._error: OSError | None = None
        self._thread = threading.Thread(target=self._work, name="recorder sync", daemon=True)
        self._thread.start()

    @property
    def waits_s(self) -> float:
        """How long the disk has not answered, seconds; 0 while nothing is asked of it."""
        since_s = self._since_s
        return 0.0 if since_s is None else time.monotonic() - since_s

    def ask(self) -> None:
        """Have all that was written so far put on the disk. Raises OSError if that failed before."""
        if self._error is not None:
            raise self._error
        self._asked.set()

    def finish(self, *, wait: bool) -> None:
        """Put the rest on the disk and close the file; wait for it, some seconds at most, or not.

        Raises
        ------
        OSError
            If it failed, and that is known.
        """
        self._last = True
        self._asked.set()
        if wait:
            self._thread.join(FINISH_S)
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        try:
            self._sync_folder()
            while not self._last:
                self._asked.wait()
                self._asked.clear()
                self._sync()
            self._sync()
        finally:
            os.close(self._descriptor)

    def _sync(self) -> None:
        self._since_s = time.monotonic()
        try:
            os.fdatasync(self._descriptor)
        except OSError as error:
            self._error = error
        finally:
            self._since_s = None

    def _sync_folder(self) -> None:
        try:
            folder = os.open(self._folder, os.O_RDONLY | os.O_DIRECTORY)
            try:
                os.fsync(folder)
            finally:
                os.close(folder)
        except OSError as error:
            self._error = error


PROFILE = "mastctl/record/1"
CHUNK_BYTES = 4 << 20
FLUSH_S = 0.25
"""A chunk is written when its first message is this old: a quarter of what may be lost."""

_NS = 1_000_000_000


@dataclass(frozen=True)
class Attached:
    """A file that travels with a recording."""

    name: str
    data: bytes
    media_type: str = "application/yaml"

    @property
    def digest(self) -> str:
        """SHA-256 of its bytes, hex."""
        return hashlib.sha256(self.data).hexdigest()


@dataclass(frozen=True)
class Clocks:
    """What ties the daemon's clock to the calendar: one pair for a file, so that a clock set back does not
    show in it.
    """

    monotonic_s: float
    unix_ns: int

    def ns(self, time_s: float) -> int:
        """Return a moment of the daemon's clock as nanoseconds since 1970."""
        return max(0, self.unix_ns + round((time_s - self.monotonic_s) * 1e9))


class RecordFile:
    """An MCAP file that grows. Not for several threads at once.

    Parameters
    ----------
    path
        Made; it must not exist yet.
    attached
        Mast file and configuration, written first.
    facts
        Words about the recording: metadata ``mastctl``.
    clocks
        Stamps the messages.

    Raises
    ------
    OSError
        From every method, if the file cannot be written. Then it is as a killed daemon leaves it.
    """

    def __init__(
        self, path: Path, attached: list[Attached], facts: Mapping[str, str], clocks: Clocks
    ) -> None:
        self.path = path
        self.clocks = clocks
        self._file = path.open("xb", buffering=0)
        self._writer = Writer(_Whole(self._file), chunk_size=1 << 40, compression=CompressionType.ZSTD)  # type: ignore[arg-type]
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: dict[int, int] = {}
        self._open_since_s: float | None = None
        self._sync = Sync(os.dup(self._file.fileno()), path.parent)
        self._gathered = 0
        self._size = 0
        self._attached: set[str] = set()
        try:
            self._begin(attached, facts)
        except BaseException:
            self.abandon()
            path.unlink(missing_ok=True)  # there is nothing in it
            raise

    def _begin(self, attached: list[Attached], facts: Mapping[str, str]) -> None:
        self._writer.start(PROFILE, "mastctl")
        digests = {f"sha256 {one.name}": one.digest for one in attached}
        clocks = {"monotonic_s": repr(self.clocks.monotonic_s), "unix_ns": str(self.clocks.unix_ns)}
        self._writer.add_metadata("mastctl", {**facts, **clocks, **digests})
        for one in attached:
            self.attach(one, self.clocks.unix_ns)
        self.flush()

    def attach(self, one: Attached, time_ns: int) -> None:
        """Put a file into the recording, unless the same is in it."""
        if one.digest in self._attached:
            return
        self._attached.add(one.digest)
        self._writer.flush()  # type: ignore[no-untyped-call]  # what was gathered comes before it
        self._writer.add_attachment(time_ns, time_ns, one.name, one.media_type, one.data)

    @property
    def size(self) -> int:
        """Bytes written, and those of the chunk that is gathered."""
        return self._size + self._gathered

    @property
    def size_mb(self) -> float:
        """`size` in 10⁶ bytes; asked from any thread."""
        return self._size / 1e6

    @property
    def in_place(self) -> bool:
        """Whether it is still what its path names: nobody deleted or moved it. Asks the disk."""
        try:
            return os.path.samestat(self.path.stat(), os.fstat(self._file.fileno()))
        except (FileNotFoundError, NotADirectoryError):
            return False

    def add_json(self, topic: str, kind: str, told: Mapping[str, Any], time_s: float, now_s: float) -> None:
        """Add one JSON message; ``kind`` names its schema. ``now_s`` is the flush's clock."""
        data = json.dumps(told, allow_nan=False, separators=(",", ":")).encode()
        self._add(topic, f"mastctl.{kind}", data, time_s, now_s)

    def add_message(self, topic: str, message: Message, time_s: float, now_s: float) -> None:
        """Add one of Foxglove's messages."""
        self._add(topic, message.DESCRIPTOR.full_name, message.SerializeToString(), time_s, now_s)

    def flush_if_due(self, now_s: float) -> bool:
        """Put the gathered chunk on the disk if it is old enough; return whether it was."""
        if self._open_since_s is None or now_s - self._open_since_s < FLUSH_S:
            return False
        self.flush()
        return True

    def flush(self) -> None:
        """Write what was gathered, and have it put on the disk."""
        self._open_since_s = None
        self._gathered = 0
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._sync.ask()
        self._size = self._file.tell()

    @property
    def disk_waits_s(self) -> float:
        """How long the disk has not answered, seconds; asked from any thread."""
        return self._sync.waits_s

    def finish(self, *, wait: bool = True) -> None:
        """Write the index and close the file; wait until it is on the disk, or not."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._file.close()
            self._sync.finish(wait=wait)

    def abandon(self) -> None:
        """Close the file as it is; a repair makes it whole."""
        self._file.close()
        with contextlib.suppress(OSError):
            self._sync.finish(wait=False)

    def _add(self, topic: str, schema: str, data: bytes, time_s: float, now_s: float) -> None:
        channel = self._channels.get((topic, schema))
        if channel is None:
            channel = self._channel(topic, schema)
        if self._open_since_s is None:
            self._open_since_s = now_s
        number = self._counts[channel] = self._counts.get(channel, 0) + 1
        time_ns = self.clocks.ns(time_s)
        self._gathered += len(data)
        self._writer.add_message(channel, time_ns, data, time_ns, number)
        if self._gathered > CHUNK_BYTES:
            self.flush()

    def _channel(self, topic: str, schema: str) -> int:
        known = described(schema)
        if schema not in self._schemas:
            self._schemas[schema] = self._writer.register_schema(schema, known.schema, known.data)
        channel = self._writer.register_channel(topic, known.message, self._schemas[schema])
        self._channels[topic, schema] = channel
        return channel


class _Whole:
    """An unbuffered file whose writes are whole or an error: the kernel may take only a part of one."""

    def __init__(self, file: Any) -> None:
        self._file = file

    def write(self, data: Any) -> int:
        view = memoryview(data)
        while view:
            view = view[self._file.write(view) :]
        return len(data)

    def tell(self) -> int:
        return int(self._file.tell())

    def flush(self) -> None:
        """Nothing is held back."""
