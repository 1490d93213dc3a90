"""A recording read again, served anew, or repaired."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Header, Metadata
from mcap.writer import CompressionType, Writer

from calib.errors import BadFile
from calib.files.mast_file import StoredRig, parse_rig
from calib.files.yaml_text import dump_mapping, parse_mapping
from drivers.recordings.frames import McapFrame, items_with_frames, recording_files
from drivers.recordings.mcap_file import BadRecording, McapContents, McapEntry, read_items
from mastctl.packaged import driver_of_hardware
from mastctl.recorder.writer import CHUNK_BYTES, Attached


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
                name, data = ("", b"") if schema is None else (schema.name, schema.data)
                place = channel.topic, channel.message_encoding, name
                if place not in channels:
                    if schema is not None and (name, data) not in schemas:
                        schemas[name, data] = writer.register_schema(name, schema.encoding, data)
                    number = schemas.get((name, data), 0)
                    facts = dict(channel.metadata)
                    channels[place] = writer.register_channel(*place[:2], number, facts)
                writer.add_message(channels[place], one.log_time, one.data, one.publish_time, one.sequence)
    if not started:
        writer.start()
    return found


log = logging.getLogger(__name__)

MAST_SCHEMA = "mastctl/mast/1"
CONFIG_SCHEMA = "mastctl/config/1"

SPEED_RAD_PER_S, WHOLE_TURN_RAD = 1.0, 6.2832  # of a replay without the limits of a configuration


@dataclass(eq=False)
class Recording:
    """A recording, read.

    ``found``: what each of its files holds, and how it ended; ``facts``: the metadata at its start;
    ``masts``: attached mast files by digest, the first one first; ``operations``: the last record of each, by
    id, oldest first; ``frames`` by id.
    """

    path: Path
    files: tuple[Path, ...]
    found: list[McapContents] = field(default_factory=list)
    facts: dict[str, str] = field(default_factory=dict)
    masts: dict[str, tuple[Attached, StoredRig]] = field(default_factory=dict)
    config: Attached | None = None
    operations: dict[str, dict[str, Any]] = field(default_factory=dict)
    handoffs: list[dict[str, Any]] = field(default_factory=list)
    frames: dict[str, McapFrame] = field(default_factory=dict)

    @property
    def first_mast(self) -> tuple[Attached, StoredRig]:
        """The mast file that it began with. Raises BadRecording."""
        if not self.masts:
            raise BadRecording(f"{self.path}: no mast file is attached to it")
        return next(iter(self.masts.values()))

    def summary(self) -> dict[str, Any]:
        """Return what it holds as JSON."""
        return {
            "file": str(self.path),
            "files": len(self.files),
            "size_mb": sum(path.stat().st_size for path in self.files) / 1e6,
            **contents_of(self.found),
            "masts": [{"name": one.name, "digest": digest} for digest, (one, _) in self.masts.items()],
            "config": None if self.config is None else self.config.name,
            "operations": len(self.operations),
            "handoffs": len(self.handoffs),
            "frames": len(self.frames),
            "facts": dict(self.facts),
        }


def read_whole(path: Path) -> Recording:
    """Read a recording, once: a file, or a folder of the ring's segments. Raises BadRecording."""
    files = tuple(recording_files(path))
    one = Recording(path, files)
    for file in files:
        one.found.append(McapContents())
        for item in items_with_frames(file, one.found[-1]):
            if isinstance(item, McapFrame):
                one.frames[str(item.facts["frame_id"])] = item
            elif isinstance(item, Metadata):
                one.facts.update(item.metadata)
            elif isinstance(item, Attachment):
                _attach(one, file, Attached(item.name, bytes(item.data)))
            elif isinstance(item, McapEntry) and item.channel.topic in ("/operation", "/handoff"):
                record = _record(item.message.data)
                if item.channel.topic == "/handoff" and record:
                    one.handoffs.append(record)
                elif isinstance(record.get("id"), str):
                    one.operations[record["id"]] = record
    return one


def _attach(recording: Recording, file: Path, one: Attached) -> None:
    """Keep an attached file by its schema; one that cannot be read is logged."""
    expected = recording.facts.get(f"sha256 {one.name}", one.digest)
    if one.digest != expected and one.digest not in recording.masts:
        log.warning("%s: %s is not what it was when the recording began", file, one.name)
    try:
        schema = parse_mapping(one.data, one.name).get("schema")
        if schema == MAST_SCHEMA:
            recording.masts.setdefault(one.digest, (one, parse_rig(one.data, one.name)))
        elif schema == CONFIG_SCHEMA and recording.config is None:
            recording.config = one
    except BadFile as error:
        log.warning("%s: an attached file cannot be used: %s", file, error)


def _record(data: bytes) -> dict[str, Any]:
    """A record of JSON; empty where another program wrote something else."""
    try:
        record = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def replay_files(recording: Recording, folder: Path, listen: dict[str, Any]) -> Path:
    """Write the mast file and a configuration that serves a recording; return the configuration's path.

    ``listen`` is the configuration's section of that name. Raises BadRecording if no mast file is attached or
    no camera of it took a picture, OSError.
    """
    mast, stored = recording.first_mast
    known = {str(frame.facts["camera"]) for frame in recording.frames.values()} & set(stored.rig.cameras)
    if not known:
        raise BadRecording(f"{recording.path}: holds no picture that could be served")
    name = Path(mast.name).name or "mast.yaml"
    (folder / name).write_bytes(mast.data)
    device = {
        "driver": driver_of_hardware("replayed"),
        "options": {"recording": str(recording.path.resolve())},
    }
    config = {
        "schema": CONFIG_SCHEMA,
        "mast_file": name,
        "listen": listen,
        "pan_tilt": device,
        "cameras": {camera: device for camera in stored.rig.cameras if camera in known},
        "limits": _limits(recording),
    }
    path = folder / "replay.yaml"
    path.write_bytes(dump_mapping(config))
    return path


def _limits(recording: Recording) -> dict[str, Any]:
    """Those of the attached configuration; a whole turn either way without one."""
    if recording.config is not None:
        limits = parse_mapping(recording.config.data, recording.config.name).get("limits")
        if isinstance(limits, dict):
            return limits
    turn = [-WHOLE_TURN_RAD, WHOLE_TURN_RAD]
    return {"pan_rad": turn, "tilt_rad": turn, "speed_rad_per_s": SPEED_RAD_PER_S}
