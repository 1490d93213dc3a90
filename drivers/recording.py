"""A recording: frames with the joint angles measured when they were taken.

Other people's pictures are read in two forms: PDS3 products of one camera (image, and the label's measured
mast angles), and a CSV beside ordinary image files with the columns ``camera,pan_rad,tilt_rad,file``; what
mastctl itself recorded is `drivers.recorded_frames`'s. Pixels of more than 8 bits
become 8 by one linear scale for all frames of a camera, never one for each: grey levels stay comparable.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.files import pds3, read_bytes
from drivers.errors import BadFrame, BadOptions
from drivers.interfaces import Image

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

        Raises
        ------
        BadFrame
            If the file cannot be read any more.
        """
        try:
            pixels = _pixels(self.path)
        except BadOptions as error:
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
class Pointing:
    """A place where the head stood, and what its cameras took there."""

    pan_rad: float
    tilt_rad: float
    frames: Mapping[str, HasPicture]


def read_products(
    paths: Sequence[Path], camera: str, grey_range_dn: tuple[float, float] | None = None
) -> list[Pointing]:
    """Return the pointings of PDS3 products taken by one camera, in the order of the paths.

    Raises
    ------
    BadOptions
        If a product cannot be read, has no image or no measured mast angles, is of another instrument or
        size than the first, or two were taken at the same angles.
    """
    found: list[tuple[float, float, Path]] = []
    samples: list[NDArray[np.generic]] = []
    first: tuple[str, tuple[int, int]] | None = None
    for path in paths:
        try:
            product = pds3.read_product(path)
        except CalibError as error:
            raise BadOptions(str(error), device="replay") from None
        pan_rad, tilt_rad = product.azimuth_measured_rad, product.elevation_measured_rad
        if pan_rad is None or tilt_rad is None:
            raise BadOptions(f"{path}: the label has no measured mast angles", device="replay")
        if product.image is None:
            raise BadOptions(f"{path}: {'; '.join(product.notes) or 'there is no image'}", device="replay")
        this = (str(product.label.root.values.get("INSTRUMENT_ID", "")), product.size_px)
        if first is None:
            first = this
        if this != first:
            raise BadOptions(f"{path}: {_shown(this)} where {_shown(first)} is expected", device="replay")
        found.append((pan_rad, tilt_rad, path))
        samples.append(product.image[::SAMPLE_EVERY, ::SAMPLE_EVERY])
    scale = _scale(samples, grey_range_dn)
    return _pointings([RecordedFrame(camera, pan, tilt, path, scale) for pan, tilt, path in found])


def read_folder(path: Path, grey_range_dn: tuple[float, float] | None = None) -> list[Pointing]:
    """Return the pointings of a CSV ``camera,pan_rad,tilt_rad,file`` with image files beside it.

    Raises
    ------
    BadOptions
        For a malformed row, an image that cannot be read, images of several sizes from one camera, or two
        frames of one camera at the same angles.
    """
    rows = _rows(path)
    samples: dict[str, list[NDArray[np.generic]]] = {}
    sizes: dict[str, tuple[int, ...]] = {}
    for place, camera, _, _, file in rows:
        pixels = _pixels(file)
        size = sizes.setdefault(camera, pixels.shape[:2])
        if pixels.shape[:2] != size:
            raise BadOptions(
                f"{path}: {place}: {file.name} has {pixels.shape[1]} x {pixels.shape[0]} pixels where "
                f"{size[1]} x {size[0]} is expected of {camera}",
                device="replay",
            )
        samples.setdefault(camera, []).append(pixels[::SAMPLE_EVERY, ::SAMPLE_EVERY])
    scales = {camera: _scale(parts, grey_range_dn) for camera, parts in samples.items()}
    return _pointings(
        [RecordedFrame(camera, pan, tilt, file, scales[camera]) for _, camera, pan, tilt, file in rows]
    )


def _scale(
    samples: Sequence[NDArray[np.generic]], grey_range_dn: tuple[float, float] | None
) -> GreyScale | None:
    """One scale for all frames of a camera; None where all are 8-bit already and no range is asked."""
    if grey_range_dn is not None:
        return GreyScale(*grey_range_dn)
    if all(sample.dtype == np.uint8 for sample in samples):
        return None
    pixels = np.concatenate([sample.ravel().astype(np.float64) for sample in samples])
    low, high = np.percentile(pixels[np.isfinite(pixels)], SCALE_PERCENTILES)
    return GreyScale(float(low), float(max(high, low + 1.0)))


def _pointings(frames: Sequence[RecordedFrame]) -> list[Pointing]:
    """Frames grouped by where the head stood, in their order."""
    groups: list[tuple[RecordedFrame, dict[str, RecordedFrame]]] = []
    for frame in frames:
        together = next((together for first, together in groups if _same_place(first, frame)), None)
        if together is None:
            together = {}
            groups.append((frame, together))
        if frame.camera in together:
            raise BadOptions(
                f"{together[frame.camera].path.name} and {frame.path.name} of {frame.camera} were taken at "
                f"the same angles, {frame.pan_rad:.6g} and {frame.tilt_rad:.6g} rad; one frame is expected",
                device="replay",
            )
        together[frame.camera] = frame
    return [Pointing(first.pan_rad, first.tilt_rad, together) for first, together in groups]


def _same_place(one: RecordedFrame, other: RecordedFrame) -> bool:
    """Whether two frames were taken at one pointing."""
    return max(abs(one.pan_rad - other.pan_rad), abs(one.tilt_rad - other.tilt_rad)) < SAME_RAD


def _pixels(path: Path) -> NDArray[np.generic]:
    """The pixels of a PDS3 product or an ordinary image file."""
    try:
        data = read_bytes(path, MAX_IMAGE_BYTES)
        if pds3.looks_like_pds3(data):
            image: NDArray[np.generic] | None = pds3.read_product(path).image
        else:
            image = _decoded(data)
    except CalibError as error:
        raise BadOptions(str(error), device="replay") from None
    if image is None or image.size == 0:
        raise BadOptions(
            f"{path}: holds no image that can be read (PNG, JPEG, TIFF or PDS3)", device="replay"
        )
    return image


def _decoded(data: bytes) -> NDArray[np.generic] | None:
    """Decode an image file; grey stays grey, colour is BGR, 16 bits stay 16. None if it is no image."""
    if not data:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), HOW)
    except cv2.error:
        return None
    return None if image is None else np.asarray(image)


def _rows(path: Path) -> list[tuple[str, str, float, float, Path]]:
    """Rows of the CSV: where it stands, camera, pan, tilt, image file."""
    try:
        text = read_bytes(path, MAX_CSV_BYTES).decode("utf-8-sig")
        lines = list(csv.reader(io.StringIO(text, newline=""), strict=True))
    except CalibError as error:
        raise BadOptions(str(error), device="replay") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadOptions(f"{path}: is not CSV in UTF-8: {error}", device="replay") from None
    expected = ",".join(CSV_COLUMNS)
    if not lines or [cell.strip() for cell in lines[0]] != list(CSV_COLUMNS):
        found = ",".join(lines[0])[:60] if lines else "nothing"
        raise BadOptions(f"{path}: line 1: the header is '{found}'; expected '{expected}'", device="replay")
    rows = []
    for number, cells in enumerate(lines[1:], start=1):
        place = f"row {number}"
        if len(cells) != len(CSV_COLUMNS):
            raise BadOptions(
                f"{path}: {place}: {len(cells)} cells where {len(CSV_COLUMNS)} are expected", device="replay"
            )
        camera, pan, tilt, file = (cell.strip() for cell in cells)
        angles = [
            _angle(word, f"{path}: {place}, {name}") for word, name in ((pan, "pan_rad"), (tilt, "tilt_rad"))
        ]
        if not camera or not file:
            raise BadOptions(f"{path}: {place}: a camera and a file are expected", device="replay")
        rows.append((place, camera, angles[0], angles[1], path.parent / file))
    return rows


def _angle(word: str, place: str) -> float:
    """A joint angle in a cell."""
    try:
        angle = float(word)
    except ValueError:
        angle = math.nan
    if not abs(angle) <= math.tau:
        raise BadOptions(
            f"{place}: '{word[:40]}' where an angle of at most a turn, in radians, is expected",
            device="replay",
        )
    return angle


def _shown(this: tuple[str, tuple[int, int]]) -> str:
    """An instrument with its image size."""
    return f"{this[0] or 'an unnamed instrument'} with {this[1][0]} x {this[1][1]} pixels"
