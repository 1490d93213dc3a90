"""Reads an MCAP file from front to end: whole, cut off anywhere, or damaged in the middle.

The library's own readers trust the index at the end of a file, which a killed writer has not written, and end
at the first record that is cut off. Here every record that is whole counts (https://mcap.dev/spec: an opcode,
a length, the content), and every chunk whose checksum is right; others are counted and passed over. Nothing
is taken from the index.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata, Schema
from mcap.stream_reader import breakup_chunk

from calib.files import open_plain
from drivers.errors import DriverError

MAGIC = b"\x89MCAP0\r\n"
LARGEST_RECORD = 1 << 30
"""A longer record is damage: no writer wrote that length."""

_FRAME = struct.Struct("<BQ")
_END = frozenset((Opcode.DATA_END, Opcode.FOOTER))


class BadRecording(DriverError):
    """A file that is no recording, or cannot be read."""

    code = "bad_recording"
    exit_code = 2


@dataclass
class McapContents:
    """The findings while a file was read; they grow as the reading goes on.

    ``complete``: the file was ended by its writer, index and all. ``damaged`` chunks and records are passed
    over. Up to ``whole_bytes`` records are whole; the rest was being written when the writer died.
    """

    complete: bool = False
    damaged: int = 0
    whole_bytes: int = 0
    left_over_bytes: int = 0
    messages: int = 0
    first_ns: int | None = None
    last_ns: int | None = None
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)


@dataclass(frozen=True)
class McapEntry:
    """One message with its channel, and its schema (None where the channel names none).

    ``at`` is where in the file the record begins that holds it: what `read_at` wants.
    """

    schema: Schema | None
    channel: Channel
    message: Message
    at: int


Item = Header | Attachment | Metadata | McapEntry


def is_mcap(path: Path) -> bool:
    """Return whether a file begins like an MCAP file; False for one that cannot be read."""
    try:
        with open_plain(path) as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def read_items(path: Path, found: McapContents | None = None) -> Iterator[Item]:
    """Yield what a file holds, in its order: header, attachments, metadata, messages.

    Raises BadRecording if it cannot be read, or does not begin like an MCAP file; an empty one is a recording
    of nothing. Damage further on is passed over.
    """
    contents = found if found is not None else McapContents()
    try:
        with open_plain(path) as file:
            size = file.seek(0, io.SEEK_END)
            file.seek(0)
            begin = file.read(len(MAGIC))
            if begin != MAGIC and MAGIC.startswith(begin):  # its writer died before its first record
                contents.left_over_bytes = len(begin)
                return
            if begin != MAGIC:
                raise BadRecording(f"{path}: is no MCAP file; a recording of mastctl is expected")
            yield from _items(file, size, contents)
    except OSError as error:
        raise BadRecording(f"{path}: cannot be read: {error.strerror or error}") from None


def read_at(path: Path, entry: McapEntry) -> bytes:
    """Return a message's content again, without reading what stands before it.

    ``entry`` may have lost its own content since it was read. Raises BadRecording.
    """
    try:
        with open_plain(path) as file:
            file.seek(entry.at)
            opcode, length = _FRAME.unpack(file.read(_FRAME.size))
            if length > LARGEST_RECORD:
                raise ValueError("it has changed")
            contents = McapContents(channels={entry.channel.id: entry.channel})
            for one in _record(opcode, file.read(length), contents, entry.at):
                if isinstance(one, McapEntry) and _same(one.message, entry.message):
                    return one.message.data
    except (OSError, ValueError, struct.error) as error:
        raise BadRecording(f"{path}: cannot be read again: {error}") from None
    raise BadRecording(f"{path}: has changed since it was read first")


def _same(one: Message, other: Message) -> bool:
    """Whether two are one message of a file."""
    return (one.channel_id, one.sequence, one.log_time) == (other.channel_id, other.sequence, other.log_time)


def _items(file: BinaryIO, size: int, contents: McapContents) -> Iterator[Item]:
    """Walk over the records after the magic."""
    contents.whole_bytes = file.tell()
    while True:
        at = file.tell()
        head = file.read(_FRAME.size)
        if len(head) < _FRAME.size:
            break
        opcode, length = _FRAME.unpack(head)
        if opcode == 0 or length > min(LARGEST_RECORD, size - file.tell()):
            break
        content = file.read(length)
        contents.whole_bytes = file.tell()
        if opcode in _END:
            contents.complete = _ends_whole(file, size)
            contents.whole_bytes = size if contents.complete else contents.whole_bytes - length - _FRAME.size
            break
        yield from _record(opcode, content, contents, at)
    contents.left_over_bytes = size - contents.whole_bytes


def _ends_whole(file: BinaryIO, size: int) -> bool:
    """Whether the file ends with the magic, as a finished one does."""
    file.seek(max(0, size - len(MAGIC)))
    return file.read(len(MAGIC)) == MAGIC


def _record(opcode: int, content: bytes, contents: McapContents, at: int) -> Iterator[Item]:
    """What one record holds; a damaged one holds nothing."""
    if opcode == Opcode.CHUNK:
        try:
            chunk = Chunk.read(_stream(content))
            if chunk.uncompressed_size > LARGEST_RECORD:
                raise ValueError("a chunk that claims to be larger than any is")
            inside = breakup_chunk(chunk, validate_crc=True)
        except Exception:  # whatever a library says of bytes that are no chunk
            contents.damaged += 1
            return
        for inner in inside:
            yield from _known(inner, contents, at)
        return
    read = _READ.get(opcode)
    if read is None:
        return
    try:
        one = read(content)
    except Exception:  # as above
        contents.damaged += 1
        return
    yield from _known(one, contents, at)


def _known(one: object, contents: McapContents, at: int) -> Iterator[Item]:
    """Keep schemas and channels, hand on the rest, each message with its channel."""
    if isinstance(one, Schema):
        contents.schemas[one.id] = one
    elif isinstance(one, Channel):
        contents.channels[one.id] = one
    elif isinstance(one, Message):
        channel = contents.channels.get(one.channel_id)
        if channel is None:  # its channel was in a damaged chunk
            contents.damaged += 1
            return
        contents.messages += 1
        contents.first_ns = (
            one.log_time if contents.first_ns is None else min(contents.first_ns, one.log_time)
        )
        contents.last_ns = one.log_time if contents.last_ns is None else max(contents.last_ns, one.log_time)
        yield McapEntry(contents.schemas.get(channel.schema_id), channel, one, at)
    elif isinstance(one, Header | Attachment | Metadata):
        yield one


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(content))


_READ: dict[int, Callable[[bytes], object]] = {
    Opcode.HEADER: lambda content: Header.read(_stream(content)),
    Opcode.SCHEMA: lambda content: Schema.read(_stream(content)),
    Opcode.CHANNEL: lambda content: Channel.read(_stream(content)),
    Opcode.MESSAGE: lambda content: Message.read(_stream(content), len(content)),
    Opcode.ATTACHMENT: lambda content: Attachment.read(_stream(content)),
    Opcode.METADATA: lambda content: Metadata.read(_stream(content)),
}
