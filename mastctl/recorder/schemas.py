"""The schemas of a recording: Foxglove's protobuf messages, and JSON records, which are those of the events.

The JSON schema of a record is made from its type: that of the daemon's answers, or one below, of what a
recording has alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import cache
from typing import Any

from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.message import Message
from mcap.well_known import MessageEncoding, SchemaEncoding
from pydantic import TypeAdapter
from typing_extensions import TypedDict

from calib.files.records import DIALECT
from mastctl.answers import (
    CommandAnswer,
    Count,
    FaultAnswer,
    HeadAnswer,
    Json,
    LeaseAnswer,
    MastAnswer,
    OperationAnswer,
    Pointing,
    StateAnswer,
    TrackAnswer,
)
from mastctl.frame_facts import FrameFacts

PROTOBUF: Mapping[str, type[Message]] = {
    kind.DESCRIPTOR.full_name: kind
    for kind in (CompressedImage, RawImage, CameraCalibration, FrameTransforms, SceneUpdate)
}
"""The messages that Foxglove, Lichtblick and Rerun draw."""


class RecordedCamera(TypedDict):
    """A camera in its frame as a mast file has it, and how far the nearest plumb_bob camera is, pixels."""

    camera: str
    on: str
    mast_digest: str
    model: Json
    plumb_bob: Json


class RecordedTarget(TypedDict):
    """A target in the rover frame."""

    operation: str
    position_m: list[float]
    range_m: float | None


class ResidualRecord(Pointing):
    """A pointing that measured a residual."""

    operation: str
    pointing: Count


class FaultRecord(TypedDict):
    """All that is wrong with one device."""

    device: str
    faults: list[FaultAnswer]


class DroppedRecord(TypedDict):
    """How many values were not written so far, by topic."""

    dropped: dict[str, Count]
    reason: str


RECORDS: Mapping[str, Any] = {
    "cahvor": RecordedCamera,
    "command": CommandAnswer,
    "fault": FaultRecord,
    "frame": FrameFacts,
    "joints": HeadAnswer,
    "lease": LeaseAnswer,
    "mast": MastAnswer,
    "operation": OperationAnswer,
    "recorder": DroppedRecord,
    "residual": ResidualRecord,
    "state": StateAnswer,
    "target": RecordedTarget,
    "track": TrackAnswer,
}
"""The type of each kind of JSON message; any object where there is none."""


@cache
def encodings(kind: str) -> tuple[str, str, bytes]:
    """Return how a kind of message is announced: its encoding, that of its schema, and the schema.

    ``kind`` is ``foxglove.MESSAGE`` or ``mastctl.`` and a key of `RECORDS`.
    """
    if kind in PROTOBUF:
        return MessageEncoding.Protobuf, SchemaEncoding.Protobuf, _file_descriptors(kind)
    record = RECORDS.get(kind.removeprefix("mastctl."))
    schema = {"type": "object"} if record is None else TypeAdapter(record).json_schema(mode="serialization")
    data = json.dumps(schema | {"$schema": DIALECT, "title": kind}).encode()
    return MessageEncoding.JSON, SchemaEncoding.JSONSchema, data


def _file_descriptors(name: str) -> bytes:
    """A protobuf message's file with all that it imports, as MCAP wants its schema."""
    files = FileDescriptorSet()
    seen = set[str]()

    def add(file: FileDescriptor) -> None:
        if file.name not in seen:
            seen.add(file.name)
            for other in file.dependencies:
                add(other)
            file.CopyToProto(files.file.add())

    add(PROTOBUF[name].DESCRIPTOR.file)
    return bytes(files.SerializeToString())
