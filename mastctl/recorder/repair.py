"""A recording that a killed daemon left, or segments of the ring, made one whole file with its index."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Header, Metadata
from mcap.writer import CompressionType, Writer

from drivers.recordings.mcap_file import BadRecording, McapContents, McapEntry, read_items
from mastctl.recorder.writer import CHUNK_BYTES


@dataclass(frozen=True)
class Repaired:
    """What a repair found, and where the whole file is."""

    path: Path
    messages: int
    damaged: int
    left_over_bytes: int
    was_complete: bool
    seconds: float


def repair(sources: Sequence[Path], out: Path) -> Repaired:
    """Write all that is whole in some files, in their order, into one; the sources stay as they are.

    Raises BadRecording if a source cannot be read, none of them holds a recording, or ``out`` is there
    already or cannot be written; a half-written ``out`` is taken away.
    """
    try:
        with out.open("xb") as file:
            writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            copy = _Copy(writer)
            try:
                found = [copy.add(source) for source in sources]
                writer.finish()  # type: ignore[no-untyped-call]
            except BaseException:
                with contextlib.suppress(OSError):
                    out.unlink()
                raise
    except FileExistsError:
        raise BadRecording(f"{out}: is there already; another name is expected") from None
    except OSError as error:
        raise BadRecording(f"{out}: cannot be written: {error.strerror or error}") from None
    first = [one.first_ns for one in found if one.first_ns is not None]
    last = [one.last_ns for one in found if one.last_ns is not None]
    return Repaired(
        out,
        sum(one.messages for one in found),
        sum(one.damaged for one in found),
        sum(one.left_over_bytes for one in found),
        all(one.complete for one in found),
        (max(last) - min(first)) / 1e9 if first else 0.0,
    )


class _Copy:
    """Several files copied into one; schemas, channels and attached files that they share stand once."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._started = False
        self._attached: set[tuple[str, bytes]] = set()
        self._channels: dict[tuple[str, str, str], int] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}

    def add(self, source: Path) -> McapContents:
        """Copy one file's records, and return what was found in it."""
        found = McapContents()
        for item in read_items(source, found):
            self._start(item)
            if isinstance(item, Metadata):
                self._writer.add_metadata(item.name, item.metadata)
            elif isinstance(item, Attachment):
                self._attach(item)
            elif isinstance(item, McapEntry):
                one = item.message
                channel = self._channel(item)
                self._writer.add_message(channel, one.log_time, one.data, one.publish_time, one.sequence)
        self._start(None)
        return found

    def _start(self, item: object) -> None:
        if not self._started:
            self._started = True
            self._writer.start(*((item.profile, item.library) if isinstance(item, Header) else ()))

    def _attach(self, one: Attachment) -> None:
        if (one.name, one.data) not in self._attached:
            self._attached.add((one.name, one.data))
            self._writer.add_attachment(one.create_time, one.log_time, one.name, one.media_type, one.data)

    def _channel(self, item: McapEntry) -> int:
        """Return an entry's channel in the copy."""
        channel, schema = item.channel, item.schema
        name = "" if schema is None else schema.name
        place = channel.topic, channel.message_encoding, name
        if place not in self._channels:
            number = 0
            if schema is not None:
                content = schema.name, schema.data
                if content not in self._schemas:
                    self._schemas[content] = self._writer.register_schema(name, schema.encoding, schema.data)
                number = self._schemas[content]
            self._channels[place] = self._writer.register_channel(
                channel.topic, channel.message_encoding, number, dict(channel.metadata)
            )
        return self._channels[place]
