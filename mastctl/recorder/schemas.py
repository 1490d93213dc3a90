"""What the topics of a recording hold: Foxglove's protobuf messages, and JSON with a schema for our own."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
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

PROTOBUF: Mapping[str, type[Message]] = {
    "foxglove.CompressedImage": CompressedImage,
    "foxglove.RawImage": RawImage,
    "foxglove.CameraCalibration": CameraCalibration,
    "foxglove.FrameTransforms": FrameTransforms,
    "foxglove.SceneUpdate": SceneUpdate,
}
"""The messages that Foxglove, Lichtblick and Rerun draw."""

_NUMBER = {"type": "number"}
_TEXT = {"type": "string"}
_TEXT_OR_NONE = {"type": ["string", "null"]}
_SECONDS = {"type": "number", "description": "seconds of the daemon's monotonic clock"}
_ANGLE = {"type": "number", "description": "radians"}
_SIDE = {"type": "number", "description": "1 from smaller readings, -1 from larger, 0 not known"}
_TRULY = {
    "true_pan_rad": _ANGLE, "true_tilt_rad": _ANGLE, "pan_approach": _SIDE, "tilt_approach": _SIDE,
}  # fmt: skip
_PIXEL = {"type": ["array", "null"], "items": {"type": ["number", "null"]}, "description": "x, y in pixels"}
_POINT = {"type": ["array", "null"], "items": _NUMBER, "description": "x, y, z in metres, rover frame"}
_ANY = {"type": ["object", "null"]}

_PROPERTIES: Mapping[str, Mapping[str, Any]] = {
    "frame": {
        "frame_id": _TEXT, "camera": _TEXT, "sequence": {"type": "integer"}, "mid_exposure_s": _SECONDS,
        "exposure_s": _NUMBER, "pan_rad": _ANGLE, "tilt_rad": _ANGLE, "moving": {"type": "boolean"},
        "mast_digest": {"type": "string", "description": "SHA-256 of the mast file in use"},
        **_TRULY,
        "settings": {"type": "object", "description": "exposure, gain, ... that it had; null: not known"},
        "colour": {"type": "boolean", "description": "whether the daemon used the picture in colour"},
    },
    "cahvor": {
        "camera": _TEXT, "mast_digest": _TEXT,
        "model": {"type": "object", "description": "the camera in its frame, as a mast file holds it"},
        "plumb_bob": {"type": "object", "description": "how far the nearest plumb_bob is from it, pixels"},
    },
    "joints": {
        "pan_rad": _ANGLE, "tilt_rad": _ANGLE, "moving": {"type": "boolean"}, "time_s": _SECONDS, **_TRULY,
    },
    "target": {"operation": _TEXT, "position_m": _POINT, "range_m": {"type": ["number", "null"]}},
    "residual": {
        "operation": _TEXT, "pointing": {"type": "integer"}, "camera": _TEXT, "frame_id": _TEXT,
        "aim_px": _PIXEL, "target_px": _PIXEL, "residual_px": _PIXEL, "residual_sigma_px": _PIXEL,
        "measured_pan_rad": _ANGLE, "measured_tilt_rad": _ANGLE,
        "true_pan_rad": _ANGLE, "true_tilt_rad": _ANGLE,
    },
    "operation": {
        "id": _TEXT, "state": _TEXT, "request": _ANY, "created_s": _SECONDS,
        "steps": {"type": "array", "items": {"type": "object"}}, "result": _ANY, "error": _ANY,
    },
    "handoff": {
        "schema": _TEXT, "time": _TEXT, "source": {"type": "array"}, "destinations": {"type": "object"},
    },
    "state": {
        "word": _TEXT, "reason": _TEXT, "since_s": _SECONDS, "sequence": {"type": "integer"},
        "operation": _TEXT_OR_NONE, "track": _TEXT_OR_NONE, "target": _ANY, "residual": _ANY, "latch": _ANY,
    },
    "fault": {
        "device": _TEXT,
        "faults": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {
                    "device": _TEXT, "code": _TEXT, "message": _TEXT, "since_s": _SECONDS, "until": _TEXT,
                },
            },
        },
    },
    "command": {
        "number": {"type": "integer"}, "time": _TEXT, "monotonic_s": _SECONDS, "command": _TEXT, "who": _TEXT,
        "role": _TEXT, "via": _TEXT, "request": _ANY, "result": _TEXT, "operation": _TEXT_OR_NONE,
    },
    "track": {
        "sequence": {"type": "integer"}, "state": _TEXT, "reason": _TEXT, "id": _TEXT_OR_NONE,
        "predicted": {"type": "boolean"}, "position_m": _POINT, "looks": {"type": "integer"},
        "misses": {"type": "integer"},
    },
    "lease": {"holder": _TEXT, "kind": _TEXT, "until_s": {"type": ["number", "null"]}},
    "mast": {"file": _TEXT, "name": _TEXT, "digest": _TEXT},
    "recorder": {
        "dropped": {"type": "object", "description": "messages that were not written, by topic, so far"},
        "reason": _TEXT,
    },
}  # fmt: skip


OWN_TOPICS = tuple(topic for topic in _PROPERTIES if topic not in ("frame", "cahvor", "handoff", "recorder"))
"""Topics of JSON that are named as their schemas are, and that the daemon publishes."""


@dataclass(frozen=True)
class Described:
    """How a channel is announced: the encoding of its messages, and that of its schema, ``data``."""

    message: str
    schema: str
    data: bytes


@cache
def described(schema: str) -> Described:
    """Return how a channel is announced; ``schema`` is ``foxglove.MESSAGE`` or ``mastctl.`` and a topic."""
    if schema.startswith("foxglove."):
        return Described(MessageEncoding.Protobuf, SchemaEncoding.Protobuf, descriptor_set(schema))
    data = json.dumps(json_schema(schema.removeprefix("mastctl."))).encode()
    return Described(MessageEncoding.JSON, SchemaEncoding.JSONSchema, data)


def json_schema(topic: str) -> dict[str, Any]:
    """Return the JSON schema of one of our own topics; of one that is not listed, any object."""
    known = dict(_PROPERTIES.get(topic, {}))
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"mastctl.{topic}",
        "type": "object",
        "properties": known,
    }


@cache
def descriptor_set(name: str) -> bytes:
    """Return a protobuf message's file with all that it imports, as MCAP wants its schema."""
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
