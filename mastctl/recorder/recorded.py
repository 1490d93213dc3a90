"""A recording read again, served anew, or repaired."""

from __future__ import annotations

import contextlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Header, Metadata
from mcap.writer import CompressionType, Writer

from calib.errors import BadFile
from calib.files.mast_file import StoredRig, parse_rig
from calib.files.yaml_text import dump_mapping, parse_mapping
from drivers.recordings.frames import McapFrame, read_frames, recording_files
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


log = logging.getLogger(__name__)

MAST_SCHEMA = "mastctl/mast/1"
CONFIG_SCHEMA = "mastctl/config/1"

SPEED_RAD_PER_S, WHOLE_TURN_RAD = 1.0, 6.2832  # of a replay without the limits of a configuration


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording, read.

    ``found``: what each of its files holds, and how it ended; ``facts``: the metadata at its start;
    ``masts``: attached mast files by digest, the first one first; ``operations``: the last record of each, by
    id, oldest first; ``frames`` by id.
    """

    path: Path
    files: tuple[Path, ...]
    found: tuple[McapContents, ...]
    facts: Mapping[str, str]
    masts: Mapping[str, tuple[Attached, StoredRig]]
    config: Attached | None
    operations: Mapping[str, Mapping[str, Any]]
    handoffs: tuple[Mapping[str, Any], ...]
    frames: Mapping[str, McapFrame]

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
    """Read a recording: a file, or a folder of the ring's segments. Raises BadRecording."""
    files = tuple(recording_files(path))
    found, facts, masts = [], dict[str, str](), dict[str, tuple[Attached, StoredRig]]()
    configs: list[Attached] = []
    operations, handoffs = dict[str, Mapping[str, Any]](), list[Mapping[str, Any]]()
    for file in files:
        found.append(McapContents())
        for item in read_items(file, found[-1]):
            if isinstance(item, Metadata):
                facts |= item.metadata
            elif isinstance(item, Attachment):
                one = Attached(item.name, bytes(item.data), item.media_type)
                expected = facts.get(f"sha256 {one.name}", one.digest)
                if one.digest != expected and one.digest not in masts:
                    log.warning("%s: %s is not what it was when the recording began", file, one.name)
                _attach(file, one, masts, configs)
            elif isinstance(item, McapEntry) and item.channel.topic in ("/operation", "/handoff"):
                record = _record(item.message.data)
                if item.channel.topic == "/handoff" and record:
                    handoffs.append(record)
                elif isinstance(record.get("id"), str):
                    operations[record["id"]] = record
    frames = {str(frame.facts["frame_id"]): frame for frame in read_frames(path)}
    config = configs[0] if configs else None
    return Recording(path, files, tuple(found), facts, masts, config, operations, tuple(handoffs), frames)


def _attach(
    file: Path, one: Attached, masts: dict[str, tuple[Attached, StoredRig]], configs: list[Attached]
) -> None:
    """Keep an attached file by its schema; one that cannot be read is logged."""
    try:
        schema = parse_mapping(one.data, one.name).get("schema")
        if schema == MAST_SCHEMA:
            masts.setdefault(one.digest, (one, parse_rig(one.data, one.name)))
        elif schema == CONFIG_SCHEMA:
            configs.append(one)
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
