"""A recording read again: attached files, operations, hand-offs, frames; and the files that serve it anew."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.records import Attachment, Metadata

from calib.errors import BadFile
from calib.files.mast_file import StoredRig, parse_rig
from calib.files.yaml_text import dump_mapping, parse_mapping
from drivers.recordings.frames import McapFrame, read_frames, recording_files
from drivers.recordings.mcap_file import BadRecording, McapContents, McapEntry, read_items
from mastctl.packaged import driver_of_hardware
from mastctl.recorder.writer import Attached

log = logging.getLogger(__name__)

MAST_SCHEMA = "mastctl/mast/1"
CONFIG_SCHEMA = "mastctl/config/1"

SPEED_RAD_PER_S, WHOLE_TURN_RAD = 1.0, 6.2832  # of a replay without the limits of a configuration


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording, read.

    Attributes
    ----------
    path, files
        As it was named, and the files that it is.
    found
        What each of them holds, and how it ended.
    facts
        The metadata at its start.
    masts
        Attached mast files by digest, the first one first.
    config
        The attached configuration, None if there is none.
    operations
        The last record of each operation, by id, oldest first.
    handoffs
        Lines of the record of hand-offs.
    frames
        Frames by id.
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
        first = [one.first_ns for one in self.found if one.first_ns is not None]
        last = [one.last_ns for one in self.found if one.last_ns is not None]
        return {
            "file": str(self.path),
            "files": len(self.files),
            "size_mb": sum(path.stat().st_size for path in self.files) / 1e6,
            "seconds": (max(last) - min(first)) / 1e9 if first else 0.0,
            "messages": sum(one.messages for one in self.found),
            "complete": all(one.complete for one in self.found),
            "damaged": sum(one.damaged for one in self.found),
            "left_over_bytes": sum(one.left_over_bytes for one in self.found),
            "masts": [{"name": one.name, "digest": digest} for digest, (one, _) in self.masts.items()],
            "config": None if self.config is None else self.config.name,
            "operations": len(self.operations),
            "handoffs": len(self.handoffs),
            "frames": len(self.frames),
            "facts": dict(self.facts),
        }


def read_whole(path: Path) -> Recording:
    """Read a recording: a file, or a folder of the ring's segments.

    Raises
    ------
    BadRecording
        If there is none, or it cannot be read.
    """
    files = recording_files(path)
    reader = _Reader()
    for file in files:
        reader.read(file)
    frames = {str(frame.facts["frame_id"]): frame for frame in read_frames(path)}
    return Recording(
        path,
        tuple(files),
        tuple(reader.found),
        reader.facts,
        reader.masts,
        reader.config,
        reader.operations,
        tuple(reader.handoffs),
        frames,
    )


class _Reader:
    """Gathers what the files hold."""

    def __init__(self) -> None:
        self.found: list[McapContents] = []
        self.facts: dict[str, str] = {}
        self.masts: dict[str, tuple[Attached, StoredRig]] = {}
        self.config: Attached | None = None
        self.operations: dict[str, Mapping[str, Any]] = {}
        self.handoffs: list[Mapping[str, Any]] = []

    def read(self, file: Path) -> None:
        found = McapContents()
        self.found.append(found)
        for item in read_items(file, found):
            if isinstance(item, Metadata):
                self.facts |= item.metadata
            elif isinstance(item, Attachment):
                self._attached(file, Attached(item.name, bytes(item.data), item.media_type))
            elif isinstance(item, McapEntry) and item.channel.topic in ("/operation", "/handoff"):
                self._record(item)

    def _attached(self, file: Path, one: Attached) -> None:
        digest = self.facts.get(f"sha256 {one.name}")
        if digest is not None and digest != one.digest and one.digest not in self.masts:
            log.warning("%s: %s is not what it was when the recording began", file, one.name)
        try:
            schema = parse_mapping(one.data, one.name).get("schema")
            if schema == MAST_SCHEMA:
                self.masts.setdefault(one.digest, (one, parse_rig(one.data, one.name)))
            elif schema == CONFIG_SCHEMA:
                self.config = self.config or one
        except BadFile as error:
            log.warning("%s: an attached file cannot be used: %s", file, error)

    def _record(self, item: McapEntry) -> None:
        try:
            record = json.loads(item.message.data)
        except (ValueError, RecursionError):
            return
        if not isinstance(record, dict):
            return
        if item.channel.topic == "/handoff":
            self.handoffs.append(record)
        elif isinstance(record.get("id"), str):
            self.operations[record["id"]] = record


def replay_files(recording: Recording, folder: Path, listen: dict[str, Any]) -> Path:
    """Write the mast file and a configuration that serves a recording; return the configuration's path.

    Parameters
    ----------
    recording
        With at least one picture of a head at rest.
    folder
        Where both are written.
    listen
        The configuration's section of that name.

    Raises
    ------
    BadRecording
        If no mast file is attached, or there is no picture that a camera of it took.
    OSError
        If the folder cannot be written.
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
        "schema": "mastctl/config/1",
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
