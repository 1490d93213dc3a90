"""Recorded frames with the joint angles measured when they were taken.

Other people's images are read in two forms. One is PDS3 products of one camera (image, and the label's
measured mast angles). The other is a CSV beside ordinary image files with the columns
``camera,pan_rad,tilt_rad,file``. Pixels of more than 8 bits become 8 by one linear scale for all frames of a
camera, never one for each: grey levels stay comparable. Of what mastctl itself recorded (MCAP) the facts are
there at once, a picture on request.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from calib.errors import BadFile, CalibError
from calib.files import read_bytes, text_of
from calib.files.pictures import decode_picture
from calib.files.tables import check_header, csv_rows
from drivers.errors import BadFrame, BadOptions
from drivers.interfaces import Image
from drivers.recordings.mcap_file import BadRecording, Item, McapContents, McapEntry, read_at, read_items
from drivers.recordings.pds3 import looks_like_pds3, read_product

SAME_RAD = 1e-7
"""Frames whose angles differ by less were taken at one pointing; labels print no finer."""

SCALE_PERCENTILES = (0.5, 99.5)
"""Of all pixels of a camera's frames: what becomes 0 and 255 where no ``grey_range_dn`` is given."""

SAMPLE_EVERY = 5
"""Rows and columns between the pixels that the percentiles are taken from."""

CSV_COLUMNS = ("camera", "pan_rad", "tilt_rad", "file")
MAX_CSV_BYTES = 1 << 24
HOW = cv2.IMREAD_ANYDEPTH | cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
MAX_IMAGE_BYTES = 1 << 30

SUFFIX = ".mcap"
ONE_PLACE_RAD = 2e-5
"""Frames whose angles differ by less were taken at one pointing: a fortieth of a Navcam pixel."""


@dataclass(frozen=True)
class GreyScale:
    """255 (dn - low) / (high - low), rounded and clipped to 0..255."""

    low_dn: float
    high_dn: float

    def grey(self, image: NDArray[np.generic]) -> Image:
        """Return the image as uint8."""
        scaled = (image.astype(np.float32) - self.low_dn) * np.float32(255.0 / (self.high_dn - self.low_dn))
        return np.asarray(np.rint(np.clip(scaled, 0.0, 255.0)), dtype=np.uint8)


@dataclass(frozen=True)
class RecordedFrame:
    """A frame's file, the angles it was taken at, and how its pixels become grey (None: as they are)."""

    camera: str
    pan_rad: float
    tilt_rad: float
    path: Path
    scale: GreyScale | None

    def image(self) -> Image:
        """Return the frame's picture, uint8 (h, w) or (h, w, 3) BGR, read-only.

        Raises BadFrame if the file cannot be read any more.
        """
        try:
            pixels = _pixels(self.path)
        except CalibError as error:
            raise BadFrame(str(error), device=self.camera) from None
        image = np.asarray(pixels, dtype=np.uint8) if self.scale is None else self.scale.grey(pixels)
        image.setflags(write=False)
        return image


class HasPicture(Protocol):
    """A frame as replay needs it."""

    def image(self) -> Image:
        """Return the picture, uint8 (h, w) or (h, w, 3) BGR, read-only. Raises BadFrame."""
        ...


@dataclass(frozen=True)
class RecordedPointing:
    """A place where the head stood, and what its cameras took there."""

    pan_rad: float
    tilt_rad: float
    frames: Mapping[str, HasPicture]


def read_products(
    paths: Sequence[Path], camera: str, grey_range_dn: tuple[float, float] | None = None
) -> list[RecordedPointing]:
    """Return the pointings of PDS3 products taken by one camera, in the order of the paths.

    Raises BadFile if a product cannot be read or has no image or measured mast angles. Also if it is of
    another instrument or size than the first, or two were taken at the same angles.
    """
    found: list[tuple[float, float, Path]] = []
    samples: list[NDArray[np.generic]] = []
    first: tuple[str, tuple[int, int]] | None = None
    for path in paths:
        product = read_product(path)
        pan_rad, tilt_rad = product.azimuth_measured_rad, product.elevation_measured_rad
        if pan_rad is None or tilt_rad is None:
            raise BadFile(path, "", "the label has no measured mast angles")
        if product.image is None:
            raise BadFile(path, "", "; ".join(product.notes) or "there is no image")
        this = (str(product.label.values.get("INSTRUMENT_ID", "")), product.size_px)
        if first is None:
            first = this
        if this != first:
            raise BadFile(path, "", f"{_shown(this)} where {_shown(first)} is expected")
        found.append((pan_rad, tilt_rad, path))
        samples.append(product.image[::SAMPLE_EVERY, ::SAMPLE_EVERY])
    scale = _scale(samples, grey_range_dn)
    return _pointings([RecordedFrame(camera, pan, tilt, path, scale) for pan, tilt, path in found])


def read_folder(path: Path, grey_range_dn: tuple[float, float] | None = None) -> list[RecordedPointing]:
    """Return the pointings of a CSV ``camera,pan_rad,tilt_rad,file`` with image files beside it.

    Raises BadFile for a malformed row, an image that cannot be read, images of several sizes from one
    camera, or two frames of one camera at the same angles.
    """
    rows = _rows(path)
    samples: dict[str, list[NDArray[np.generic]]] = {}
    sizes: dict[str, tuple[int, ...]] = {}
    for place, camera, _, _, file in rows:
        pixels = _pixels(file)
        size = sizes.setdefault(camera, pixels.shape[:2])
        if pixels.shape[:2] != size:
            found = f"{file.name} has {pixels.shape[1]} x {pixels.shape[0]} pixels"
            raise BadFile(path, place, f"{found} where {size[1]} x {size[0]} is expected of {camera}")
        samples.setdefault(camera, []).append(pixels[::SAMPLE_EVERY, ::SAMPLE_EVERY])
    scales = {camera: _scale(parts, grey_range_dn) for camera, parts in samples.items()}
    return _pointings(
        [RecordedFrame(camera, pan, tilt, file, scales[camera]) for _, camera, pan, tilt, file in rows]
    )


def _scale(
    samples: Sequence[NDArray[np.generic]], grey_range_dn: tuple[float, float] | None
) -> GreyScale | None:
    """One scale for all frames of a camera; None where all are 8-bit already and no range is given."""
    if grey_range_dn is not None:
        return GreyScale(*grey_range_dn)
    if all(sample.dtype == np.uint8 for sample in samples):
        return None
    pixels = np.concatenate([sample.ravel().astype(np.float64) for sample in samples])
    low, high = np.percentile(pixels[np.isfinite(pixels)], SCALE_PERCENTILES)
    return GreyScale(float(low), float(max(high, low + 1.0)))


def _pointings(frames: Sequence[RecordedFrame]) -> list[RecordedPointing]:
    """Frames grouped by where the head stood, in their order."""
    groups: list[tuple[RecordedFrame, dict[str, RecordedFrame]]] = []
    for frame in frames:
        together = next((together for first, together in groups if _same_place(first, frame)), None)
        if together is None:
            together = {}
            groups.append((frame, together))
        if frame.camera in together:
            both = f"{together[frame.camera].path.name} and {frame.path.name} of {frame.camera}"
            angles = f"{frame.pan_rad:.6g} and {frame.tilt_rad:.6g} rad"
            reason = f"{both} were taken at the same angles, {angles}; one frame is expected"
            raise BadFile(frame.path.parent, "", reason)
        together[frame.camera] = frame
    return [RecordedPointing(first.pan_rad, first.tilt_rad, together) for first, together in groups]


def _same_place(one: RecordedFrame, other: RecordedFrame) -> bool:
    """Whether two frames were taken at one pointing."""
    return max(abs(one.pan_rad - other.pan_rad), abs(one.tilt_rad - other.tilt_rad)) < SAME_RAD


def _pixels(path: Path) -> NDArray[np.generic]:
    """The pixels of a PDS3 product or an ordinary image file."""
    data = read_bytes(path, MAX_IMAGE_BYTES)
    try:
        image = read_product(path).image if looks_like_pds3(data) else decode_picture(data, HOW)
    except ValueError as error:
        reason = f"holds no image (PNG, JPEG, TIFF or PDS3) that can be read: {error}"
        raise BadFile(path, "", reason) from None
    if image is None:
        raise BadFile(path, "", "holds no image: its label names none")
    return image


def _rows(path: Path) -> list[tuple[str, str, float, float, Path]]:
    """Rows of the CSV: where it is, camera, pan, tilt, image file."""
    lines = csv_rows(text_of(read_bytes(path, MAX_CSV_BYTES), path), path)
    check_header(next(lines, (1, []))[1], path, CSV_COLUMNS)
    rows = []
    for number, (_, cells) in enumerate(lines, start=1):
        place = f"row {number}"
        if len(cells) != len(CSV_COLUMNS):
            raise BadFile(path, place, f"{len(cells)} cells where {len(CSV_COLUMNS)} are expected")
        camera, pan, tilt, file = (cell.strip() for cell in cells)
        pan_rad, tilt_rad = (_angle(cell) for cell in (pan, tilt))
        for name, cell, angle in (("pan_rad", pan, pan_rad), ("tilt_rad", tilt, tilt_rad)):
            if not abs(angle) <= math.tau:
                expected = "an angle of at most a turn, in radians, is expected"
                raise BadFile(path, f"{place}, {name}", f"'{cell[:40]}' where {expected}")
        if not camera or not file:
            raise BadFile(path, place, "a camera and a file are expected")
        rows.append((place, camera, pan_rad, tilt_rad, path.parent / file))
    return rows


def _angle(cell: str) -> float:
    """A cell's number; not-a-number for none."""
    try:
        return float(cell)
    except ValueError:
        return math.nan


def _shown(this: tuple[str, tuple[int, int]]) -> str:
    """An instrument with its image size."""
    return f"{this[0] or 'an unnamed instrument'} with {this[1][0]} x {this[1][1]} pixels"


@dataclass(frozen=True)
class McapFrame:
    """A frame in a recording."""

    facts: Mapping[str, Any]
    path: Path
    entry: McapEntry

    def image(self) -> Image:
        """Return the picture, uint8 (h, w) or (h, w, 3) BGR, read-only. Raises BadFrame."""
        camera = str(self.facts["camera"])
        try:
            data = read_at(self.path, self.entry)
            schema = self.entry.schema
            name = "" if schema is None else schema.name
            image = _recorded_image(name, data, bool(self.facts.get("colour")))
        except (BadRecording, DecodeError, ValueError) as error:
            raise BadFrame(str(error), device=camera) from None
        image.setflags(write=False)
        return image


def recording_files(path: Path) -> list[Path]:
    """Return the files of a recording: itself, or those in a folder, in the order in which they were made.

    Raises BadRecording if there is nothing.
    """
    if path.is_dir():
        files = sorted(one for one in path.iterdir() if one.suffix == SUFFIX and one.is_file())
    else:
        files = [path] if path.is_file() else []
    if not files:
        raise BadRecording(f"{path}: there is no recording; an MCAP file or a folder of them is expected")
    return files


def read_frames(path: Path) -> Iterator[McapFrame]:
    """Yield the frames of a recording in their order; their pictures are not kept. Raises BadRecording."""
    for file in recording_files(path):
        yield from (item for item in items_with_frames(file) if isinstance(item, McapFrame))


def items_with_frames(file: Path, found: McapContents | None = None) -> Iterator[Item | McapFrame]:
    """Yield what a file holds as `read_items` does, with a frame in place of each image that has facts."""
    facts: dict[tuple[str, int], dict[str, Any]] = {}
    for item in read_items(file, found):
        if isinstance(item, McapEntry) and item.channel.topic.startswith("/camera/"):
            camera, _, what = item.channel.topic.removeprefix("/camera/").rpartition("/")
            place = camera, item.message.log_time
            if what == "frame":
                one = _facts(item.message.data)
                if one is not None and one["camera"] == camera:
                    facts[place] = one
            elif what == "image" and place in facts:
                without = replace(item, message=replace(item.message, data=b""))
                yield McapFrame(facts.pop(place), file, without)
                continue
        yield item


def read_recording(path: Path) -> list[RecordedPointing]:
    """Return where the head rested in a recording, and the last frame of each camera there.

    Raises BadOptions if there is no recording, it cannot be read, or no frame in it was taken by a head at
    rest.
    """
    places: dict[tuple[int, int], RecordedPointing] = {}
    try:
        for frame in read_frames(path):
            if frame.facts["moving"]:
                continue
            pan_rad, tilt_rad = float(frame.facts["pan_rad"]), float(frame.facts["tilt_rad"])
            cell = round(pan_rad / ONE_PLACE_RAD), round(tilt_rad / ONE_PLACE_RAD)
            around = ((cell[0] + i, cell[1] + j) for i in (0, -1, 1) for j in (0, -1, 1))
            here = next((near for near in around if near in places), cell)
            before = places.get(here) or RecordedPointing(pan_rad, tilt_rad, {})
            places[here] = replace(before, frames={**before.frames, str(frame.facts["camera"]): frame})
    except BadRecording as error:
        raise BadOptions(str(error), device="replay") from None
    if not places:
        raise BadOptions(f"{path}: holds no picture that a head at rest took", device="replay")
    return list(places.values())


def _facts(data: bytes) -> dict[str, Any] | None:
    """A frame's facts, None if they are none: another program may have written the topic."""
    try:
        found = json.loads(data)
        numbers = [float(found[name]) for name in ("pan_rad", "tilt_rad", "mid_exposure_s")]
        whole = isinstance(found["camera"], str) and isinstance(found["frame_id"], str) and "moving" in found
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return None
    return found if whole and np.isfinite(numbers).all() else None


def _recorded_image(schema: str, data: bytes, colour: bool) -> Image:
    """A picture's pixels. Raises ValueError, DecodeError."""
    if schema == "foxglove.CompressedImage":
        flags = cv2.IMREAD_COLOR if colour else cv2.IMREAD_GRAYSCALE
        content = CompressedImage.FromString(data).data
        return np.asarray(decode_picture(content, flags | cv2.IMREAD_IGNORE_ORIENTATION), dtype=np.uint8)
    if schema != "foxglove.RawImage":
        raise ValueError(f"the recorded picture is of the schema {schema or 'none'}")
    raw = RawImage.FromString(data)
    channels = {"mono8": 1, "bgr8": 3}.get(raw.encoding)
    if channels is None or raw.step != raw.width * channels or len(raw.data) != raw.step * raw.height:
        raise ValueError(f"the recorded picture is {raw.encoding} of {len(raw.data)} bytes")
    shape = (raw.height, raw.width) if channels == 1 else (raw.height, raw.width, channels)
    return np.frombuffer(raw.data, np.uint8).reshape(shape).copy()
