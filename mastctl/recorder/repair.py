"""A recording that a killed daemon left, or segments of the ring, made one whole file with its index."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Header, Metadata
from mcap.writer import CompressionType, Writer

from drivers.recordings.mcap_file import BadRecording, McapContents, McapEntry, read_items
from mastctl.recorder.writer import CHUNK_BYTES


def contents_of(found: Sequence[McapContents]) -> dict[str, Any]:
    """Return what some files hold together: ``messages``, ``seconds``, and how far they are whole."""
    first = [one.first_ns for one in found if one.first_ns is not None]
    last = [one.last_ns for one in found if one.last_ns is not None]
    return {
        "messages": sum(one.messages for one in found),
        "seconds": (max(last) - min(first)) / 1e9 if first else 0.0,
        "complete": all(one.complete for one in found),
        "damaged": sum(one.damaged for one in found),
        "left_over_bytes": sum(one.left_over_bytes for one in found),
    }


def repair(sources: Sequence[Path], out: Path) -> dict[str, Any]:
    """Write all that is whole in some files, in their order, into one; return `contents_of` the sources.

    The sources stay as they are. Raises BadRecording if one cannot be read, none of them holds a recording,
    or ``out`` is there already or cannot be written; a half-written ``out`` is taken away.
    """
    try:
        with out.open("xb") as file:
            writer = Writer(file, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
            try:
                found = _copied(sources, writer)
                writer.finish()  # type: ignore[no-untyped-call]
            except BaseException:
                with contextlib.suppress(OSError):
                    out.unlink()
                raise
    except FileExistsError:
        raise BadRecording(f"{out}: is there already; another name is expected") from None
    except OSError as error:
        raise BadRecording(f"{out}: cannot be written: {error.strerror or error}") from None
    return contents_of(found)


def _copied(sources: Sequence[Path], writer: Writer) -> list[McapContents]:
    """Copy files into one; schemas, channels and attached files that they share are in it once."""
    found: list[McapContents] = []
    attached = set[tuple[str, bytes]]()
    schemas, channels = dict[tuple[str, bytes], int](), dict[tuple[str, str, str], int]()
    started = False
    for source in sources:
        found.append(McapContents())
        for item in read_items(source, found[-1]):
            if not started:
                writer.start(*((item.profile, item.library) if isinstance(item, Header) else ()))
                started = True
            if isinstance(item, Metadata):
                writer.add_metadata(item.name, item.metadata)
            elif isinstance(item, Attachment) and (item.name, item.data) not in attached:
                attached.add((item.name, item.data))
                times = item.create_time, item.log_time
                writer.add_attachment(*times, item.name, item.media_type, item.data)
            elif isinstance(item, McapEntry):
                one, channel, schema = item.message, item.channel, item.schema
                place = channel.topic, channel.message_encoding, "" if schema is None else schema.name
                if place not in channels:
                    number = 0
                    if schema is not None and (schema.name, schema.data) not in schemas:
                        number = writer.register_schema(schema.name, schema.encoding, schema.data)
                        schemas[schema.name, schema.data] = number
                    elif schema is not None:
                        number = schemas[schema.name, schema.data]
                    channels[place] = writer.register_channel(
                        channel.topic, channel.message_encoding, number, dict(channel.metadata)
                    )
                writer.add_message(channels[place], one.log_time, one.data, one.publish_time, one.sequence)
    if not started:
        writer.start()
    return found
