"""What the topics of a recording hold: Foxglove's protobuf messages, and our own records as JSON.

The JSON schema of a record is made from its type: the one that the daemon publishes or answers with, or the
one below that the recorder fills.
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

from mastctl.answers import CommandTold, Count, Json, MastTold, PointingTold
from mastctl.control.lease import WhoSteers
from mastctl.control.records import Operation
from mastctl.control.standing import Standing, StandingFault
from mastctl.frame_facts import FrameFacts

PROTOBUF: Mapping[str, type[Message]] = {
    kind.DESCRIPTOR.full_name: kind
    for kind in (CompressedImage, RawImage, CameraCalibration, FrameTransforms, SceneUpdate)
}
"""The messages that Foxglove, Lichtblick and Rerun draw."""


class RecordedJoints(TypedDict):
    """A reading of the head: radians as read and true, and the side of approach (1 from smaller readings,
    -1 from larger, 0 not known); seconds of the daemon's monotonic clock."""

    pan_rad: float
    tilt_rad: float
    moving: bool
    time_s: float
    true_pan_rad: float
    true_tilt_rad: float
    pan_approach: float
    tilt_approach: float


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


class ResidualRecord(PointingTold):
    """A pointing that measured a residual."""

    operation: str
    pointing: Count


class FaultRecord(TypedDict):
    """All that is wrong with one device."""

    device: str
    faults: list[StandingFault]


class DroppedRecord(TypedDict):
    """How many values were not written so far, by topic."""

    dropped: dict[str, Count]
    reason: str


RECORDS: Mapping[str, Any] = {
    "cahvor": RecordedCamera,
    "command": CommandTold,
    "fault": FaultRecord,
    "frame": FrameFacts,
    "joints": RecordedJoints,
    "lease": WhoSteers,
    "mast": MastTold,
    "operation": Operation,
    "recorder": DroppedRecord,
    "residual": ResidualRecord,
    "state": Standing,
    "target": RecordedTarget,
}
"""The type of each kind of JSON message; any object where there is none."""


@cache
def encodings(kind: str) -> tuple[str, str, bytes]:
    """Return how a kind of message is announced: its encoding, that of its schema, and the schema.

    ``kind`` is ``foxglove.MESSAGE`` or ``mastctl.`` and a key of `RECORDS`.
    """
    if kind in PROTOBUF:
        return MessageEncoding.Protobuf, SchemaEncoding.Protobuf, _file_descriptors(kind)
    schema = json.dumps(_json_schema(kind.removeprefix("mastctl."))).encode()
    return MessageEncoding.JSON, SchemaEncoding.JSONSchema, schema


def _json_schema(kind: str) -> dict[str, Any]:
    record = RECORDS.get(kind)
    schema = {"type": "object"} if record is None else TypeAdapter(record).json_schema(mode="serialization")
    return schema | {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": f"mastctl.{kind}"}


def _file_descriptors(name: str) -> bytes:
    """A protobuf message's file with all that it imports, as MCAP wants its schema."""
    seen: dict[str, FileDescriptor] = {}

    def add(file: FileDescriptor) -> None:
        for other in file.dependencies:
            if other.name not in seen:
                add(other)
        seen[file.name] = file

    add(PROTOBUF[name].DESCRIPTOR.file)
    files = FileDescriptorSet()
    for file in seen.values():
        file.CopyToProto(files.file.add())
    return bytes(files.SerializeToString())
