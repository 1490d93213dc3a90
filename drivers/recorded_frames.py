"""Frames of what mastctl recorded (MCAP): their facts at once, their pictures when they are asked for."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError

from drivers.errors import BadFrame, BadOptions
from drivers.interfaces import Image
from drivers.mcap_file import BadRecording, Entry, read_at, read_items
from drivers.recording import Pointing

SUFFIX = ".mcap"
ONE_PLACE_RAD = 2e-5
"""Frames whose angles differ by less were taken at one pointing: a fortieth of a Navcam pixel."""


@dataclass(frozen=True)
class McapFrame:
    """A frame in a recording.

    Attributes
    ----------
    facts
        What stands beside the picture (topic ``/camera/NAME/frame``).
    path, entry
        Where its picture is.
    """

    facts: Mapping[str, Any]
    path: Path
    entry: Entry

    def image(self) -> Image:
        """Return the picture, uint8 (h, w) or (h, w, 3) BGR, read-only. Raises BadFrame."""
        camera = str(self.facts["camera"])
        try:
            data = read_at(self.path, self.entry)
            schema = self.entry.schema
            image = _decoded("" if schema is None else schema.name, data, bool(self.facts.get("colour")))
        except (BadRecording, DecodeError, ValueError) as error:
            raise BadFrame(str(error), device=camera) from None
        image.setflags(write=False)
        return image


def recording_files(path: Path) -> list[Path]:
    """Return the files of a recording: itself, or those in a folder, in the order in which they were made.

    Raises
    ------
    BadRecording
        If there is nothing.
    """
    files = sorted(one for one in path.iterdir() if one.suffix == SUFFIX) if path.is_dir() else [path]
    if not files or not files[0].is_file():
        raise BadRecording(f"{path}: there is no recording; an MCAP file or a folder of them is expected")
    return files


def read_frames(path: Path) -> Iterator[McapFrame]:
    """Yield the frames of a recording in their order; their pictures are not kept. Raises BadRecording."""
    for file in recording_files(path):
        facts: dict[tuple[str, int], dict[str, Any]] = {}
        for item in read_items(file):
            if not isinstance(item, Entry) or not item.channel.topic.startswith("/camera/"):
                continue
            camera, _, what = item.channel.topic.removeprefix("/camera/").rpartition("/")
            place = camera, item.message.log_time
            if what == "frame":
                told = _facts(item.message.data)
                if told is not None and told["camera"] == camera:
                    facts[place] = told
            elif what == "image" and place in facts:
                there = replace(item, message=replace(item.message, data=b""))
                yield McapFrame(facts.pop(place), file, there)


def read_recording(path: Path) -> list[Pointing]:
    """Return where the head rested in a recording, and the last frame of each camera there.

    Raises
    ------
    BadOptions
        If there is no recording, it cannot be read, or no frame in it was taken by a head at rest.
    """
    places: dict[tuple[int, int], Pointing] = {}
    try:
        for frame in read_frames(path):
            if frame.facts["moving"]:
                continue
            pan_rad, tilt_rad = float(frame.facts["pan_rad"]), float(frame.facts["tilt_rad"])
            cell = round(pan_rad / ONE_PLACE_RAD), round(tilt_rad / ONE_PLACE_RAD)
            around = ((cell[0] + i, cell[1] + j) for i in (0, -1, 1) for j in (0, -1, 1))
            here = next((near for near in around if near in places), cell)
            before = places.get(here) or Pointing(pan_rad, tilt_rad, {})
            places[here] = replace(before, frames={**before.frames, str(frame.facts["camera"]): frame})
    except BadRecording as error:
        raise BadOptions(str(error), device="replay") from None
    if not places:
        raise BadOptions(f"{path}: holds no picture that a head at rest took", device="replay")
    return list(places.values())


def _facts(data: bytes) -> dict[str, Any] | None:
    """A frame's facts, None if they are none: another program may have written the topic."""
    try:
        told = json.loads(data)
        numbers = [float(told[name]) for name in ("pan_rad", "tilt_rad", "mid_exposure_s")]
        whole = isinstance(told["camera"], str) and isinstance(told["frame_id"], str) and "moving" in told
    except (ValueError, KeyError, TypeError):
        return None
    return told if whole and np.isfinite(numbers).all() else None


def _decoded(schema: str, data: bytes, colour: bool) -> Image:
    """A picture's pixels. Raises ValueError, DecodeError."""
    if schema == "foxglove.CompressedImage":
        flags = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
        content = np.frombuffer(CompressedImage.FromString(data).data, np.uint8)
        image = cv2.imdecode(content, flags | cv2.IMREAD_IGNORE_ORIENTATION) if content.size else None
        if image is None:
            raise ValueError("the recorded picture cannot be decoded")
        return np.asarray(image, dtype=np.uint8)
    if schema != "foxglove.RawImage":
        raise ValueError(f"the recorded picture is of the schema {schema or 'none'}")
    raw = RawImage.FromString(data)
    channels = {"mono8": 1, "bgr8": 3}.get(raw.encoding)
    if channels is None or raw.step != raw.width * channels or len(raw.data) != raw.step * raw.height:
        raise ValueError(f"the recorded picture is {raw.encoding} of {len(raw.data)} bytes")
    shape = (raw.height, raw.width) if channels == 1 else (raw.height, raw.width, channels)
    return np.frombuffer(raw.data, np.uint8).reshape(shape).copy()
