"""One MCAP file that a killed daemon leaves readable: chunks of a quarter of a second, written and synced.

The library's writer makes chunks and index. Here mast file and configuration come first with their digests,
and every chunk is written as soon as it is old enough, then synced by a worker that alone waits for the disk
(`drivers.recordings.mcap_file` reads what a kill leaves).

Messages are Foxglove's protobuf messages, and JSON records. The JSON schema of a record is made from its
type: that of the event, or one of `mastctl.recorder.entries`, of what a recording has alone.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections import Counter
from collections.abc import Mapping
from concurrent import futures
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import CompressionType, Writer
from pydantic import TypeAdapter

from calib.files import sync_folder
from calib.files.records import DIALECT
from mastctl.as_json import writable

FINISH_S = 3.0
PROFILE = "mastctl/record/1"
CHUNK_BYTES = 4 << 20
FLUSH_S = 0.25
"""A chunk is written when its first message is this old: half of what may be lost."""


@dataclass(frozen=True)
class Attached:
    """A file that travels with a recording."""

    name: str
    data: bytes

    @property
    def digest(self) -> str:
        """SHA-256 of its bytes, hex."""
        return hashlib.sha256(self.data).hexdigest()


class RecordFile:
    """An MCAP file that grows. Not for several threads at once; the properties may be read by any.

    ``path`` must not exist yet; ``attached``, mast file and configuration, and ``facts``, the metadata
    ``mastctl``, are written first. ``now_s`` by the daemon's clock is ``unix_ns`` by the calendar: one pair a
    file, so that it shows no set-back. ``published_s``: when the messages that are added now were published,
    by `time.monotonic`. Every method raises OSError if the file cannot be written; then it is as a killed
    daemon leaves it.
    """

    def __init__(
        self, path: Path, attached: list[Attached], facts: Mapping[str, str], now_s: float, unix_ns: int
    ) -> None:
        self.path = path
        self._now_s, self._unix_ns = now_s, unix_ns
        self.published_s = time.monotonic()
        self._file = path.open("xb")
        self._writer = Writer(self._file, chunk_size=1 << 40, compression=CompressionType.ZSTD)
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._counts: Counter[int] = Counter()
        self._open_since_s: float | None = None
        self._disk = futures.ThreadPoolExecutor(1, "recorder sync")
        self._synced: futures.Future[None] = self._disk.submit(sync_folder, path.parent)
        self._sync_since_s = time.monotonic()
        self._written = self._gathered = 0
        self._attached: set[str] = set()
        try:
            self._writer.start(PROFILE, "mastctl")
            digests = {f"sha256 {one.name}": one.digest for one in attached}
            times = {"monotonic_s": repr(now_s), "unix_ns": str(unix_ns)}
            self._writer.add_metadata("mastctl", {**facts, **times, **digests})
            for one in attached:
                self.attach(one, now_s)
            self.flush()
        except BaseException:
            self.abandon()
            path.unlink(missing_ok=True)  # there is nothing in it
            raise

    @property
    def size(self) -> int:
        """Bytes written, and those of the chunk that is gathered."""
        return self._written + self._gathered

    @property
    def disk_waits_s(self) -> float:
        """How long the disk has not answered, seconds."""
        return 0.0 if self._synced.done() else time.monotonic() - self._sync_since_s

    def ns(self, time_s: float) -> int:
        """Return a moment of the daemon's clock as nanoseconds since 1970."""
        return max(0, self._unix_ns + round((time_s - self._now_s) * 1e9))

    def attach(self, one: Attached, time_s: float) -> None:
        """Put a file into the recording, unless the same is in it."""
        if one.digest not in self._attached:
            self._attached.add(one.digest)
            self._writer.flush()  # type: ignore[no-untyped-call]  # what was gathered comes before it
            times = self.ns(time_s), self.ns(time_s)
            self._writer.add_attachment(*times, one.name, "application/yaml", one.data)

    def add_json(self, topic: str, record: Mapping[str, Any], time_s: float, kind: Any = None) -> None:
        """Add one JSON message; ``kind`` is the type of its record, any object without one."""
        data = json.dumps(writable(record), separators=(",", ":")).encode()
        self._add(topic, f"mastctl.{topic.rpartition('/')[2]}", kind, data, time_s)

    def add_message(self, topic: str, message: Message, time_s: float) -> None:
        """Add one of Foxglove's messages."""
        kind = type(message)
        self._add(topic, kind.DESCRIPTOR.full_name, kind, message.SerializeToString(), time_s)

    def flush_if_due(self, now_s: float) -> None:
        """Write the gathered chunk if it is old enough."""
        if self._open_since_s is not None and now_s - self._open_since_s >= FLUSH_S:
            self.flush()

    def flush(self) -> None:
        """Write what was gathered, and have the disk keep it."""
        self._open_since_s = None
        self._gathered = 0
        self._writer.flush()  # type: ignore[no-untyped-call]
        self._written = self._file.tell()
        if self._synced.done():
            self._sync()

    def finish(self, *, wait: bool = True) -> None:
        """Write the index and close the file; wait until it is on the disk, some seconds at most, or not."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.flush()
            self._sync()
            if wait and futures.wait([self._synced], FINISH_S).done:
                self._synced.result()
        finally:
            self.abandon()

    def abandon(self) -> None:
        """Close the file as it is; a repair makes it whole."""
        self._disk.submit(self._file.close)
        self._disk.shutdown(wait=False)

    def _sync(self) -> None:
        """Have the disk keep what was written. Raises OSError if it did not keep what was before."""
        if self._synced.done():
            self._synced.result()
        self._sync_since_s = time.monotonic()
        self._synced = self._disk.submit(os.fdatasync, self._file.fileno())

    def _add(self, topic: str, schema: str, kind: Any, data: bytes, time_s: float) -> None:
        channel = self._channels.get((topic, schema))
        if channel is None:
            encoding, schema_encoding, text = _encodings(schema, kind)
            if schema not in self._schemas:
                self._schemas[schema] = self._writer.register_schema(schema, schema_encoding, text)
            channel = self._writer.register_channel(topic, encoding, self._schemas[schema])
            self._channels[topic, schema] = channel
        if self._open_since_s is None:
            self._open_since_s = self.published_s
        self._counts[channel] += 1
        self._gathered += len(data)
        time_ns = self.ns(time_s)
        self._writer.add_message(channel, time_ns, data, time_ns, self._counts[channel])
        if self._gathered > CHUNK_BYTES:
            self.flush()


@cache
def _encodings(name: str, kind: Any) -> tuple[str, str, bytes]:
    """The encoding of a kind of message, that of its schema, and the schema."""
    if (descriptor := getattr(kind, "DESCRIPTOR", None)) is not None:
        files = FileDescriptorSet()
        _add_file(files, descriptor.file, set())
        return MessageEncoding.Protobuf, SchemaEncoding.Protobuf, bytes(files.SerializeToString())
    schema = {"type": "object"} if kind is None else TypeAdapter(kind).json_schema(mode="serialization")
    data = json.dumps(schema | {"$schema": DIALECT, "title": name}).encode()
    return MessageEncoding.JSON, SchemaEncoding.JSONSchema, data


def _add_file(files: FileDescriptorSet, file: FileDescriptor, seen: set[str]) -> None:
    """Add a protobuf message's file with all that it imports, as MCAP wants its schema."""
    if file.name not in seen:
        seen.add(file.name)
        for other in file.dependencies:
            _add_file(files, other, seen)
        file.CopyToProto(files.file.add())
