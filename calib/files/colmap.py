"""COLMAP's ``cameras.txt``: a line a camera, ``CAMERA_ID MODEL WIDTH HEIGHT PARAMS...``, without poses.

COLMAP's image begins at the *corner* of the first pixel, whose centre is (0.5, 0.5): its cx and cy are half
a pixel more than ours. Models: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, and
OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, whose lens is the equidistant one.
Source: https://colmap.github.io/cameras.html and /format.html.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calib.camera.opencv_camera import LensKind, OpencvCamera
from calib.errors import BadFile
from calib.files import LARGEST_IMAGE_PX, CameraFile, digest_of
from calib.files.other_lens import CAMERA_FRAME, Loose, as_camera_file, lens_camera

#: Model: family, focal lengths, which of OpenCV's coefficients the file has, and how many OpenCV has.
_MODELS: dict[str, tuple[LensKind, int, tuple[int, ...], int]] = {
    "SIMPLE_PINHOLE": ("pinhole", 1, (), 0),
    "PINHOLE": ("pinhole", 2, (), 0),
    "SIMPLE_RADIAL": ("pinhole", 1, (0,), 4),
    "RADIAL": ("pinhole", 1, (0, 1), 4),
    "OPENCV": ("pinhole", 2, (0, 1, 2, 3), 4),
    "FULL_OPENCV": ("pinhole", 2, (0, 1, 2, 3, 4, 5, 6, 7), 8),
    "OPENCV_FISHEYE": ("equidistant", 2, (0, 1, 2, 3), 4),
    "SIMPLE_RADIAL_FISHEYE": ("equidistant", 1, (0,), 4),
    "RADIAL_FISHEYE": ("equidistant", 1, (0, 1), 4),
}
_LINE = re.compile(rb"^[ \t]*\d+[ \t]+[A-Z][A-Z_]+[ \t]+\d+[ \t]+\d+[ \t]", re.MULTILINE)
HALF_PX = 0.5


def looks_like_colmap(data: bytes) -> bool:
    """Tell whether the bytes hold a line of a camera as cameras.txt has it."""
    return _LINE.search(data[:65536]) is not None


def parse_colmap(data: bytes, path: str | Path) -> dict[str, CameraFile]:
    """Read all cameras of a cameras.txt, by their CAMERA_ID; ``path`` is for messages only.

    Raises
    ------
    BadFile
        If it holds no camera, or a line is none: which line, what it holds, what is expected.
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadFile(path, "", f"byte 0x{data[error.start]:02x} is not UTF-8 text") from None
    cameras: dict[str, CameraFile] = {}
    for number, line in enumerate(text.split("\n"), 1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        name = words[0]
        if name in cameras:
            raise BadFile(path, f"line {number}", f"a second camera {name[:20]}; one is expected")
        section = Loose(path, f"line {number}", {})
        camera = _camera(section, words)
        cameras[name] = as_camera_file(camera, section, CAMERA_FRAME, digest_of(data))
    if not cameras:
        raise BadFile(
            path, "", "holds no camera: a line 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS...' is expected"
        )
    return cameras


def _camera(section: Loose, words: list[str]) -> OpencvCamera:
    if len(words) < 4 or not re.fullmatch(r"\d{1,9}", words[0]):
        raise section.bad(
            "", f"'{' '.join(words)[:40]}' where CAMERA_ID MODEL WIDTH HEIGHT PARAMS... is expected"
        )
    if words[1] not in _MODELS:
        raise section.bad("", f"model '{words[1][:30]}' where one of {', '.join(_MODELS)} is expected")
    lens, focals, places, count = _MODELS[words[1]]
    if not all(re.fullmatch(r"\d{1,6}", word) and 0 < int(word) <= LARGEST_IMAGE_PX for word in words[2:4]):
        raise section.bad("", f"'{words[2][:20]} {words[3][:20]}' where width and height are expected")
    try:
        numbers = [float(word) for word in words[4:]]
    except ValueError:
        numbers = [math.nan]
    expected = focals + 2 + len(places)
    if len(numbers) != expected or not all(abs(number) < 1e9 for number in numbers):
        raise section.bad(
            "", f"{len(words) - 4} parameters where {expected} finite numbers are expected for {words[1]}"
        )
    distortion = np.zeros(count)
    distortion[list(places)] = numbers[focals + 2 :]
    focal = np.array([numbers[0], numbers[focals - 1]])
    center = np.array(numbers[focals : focals + 2]) - HALF_PX
    return lens_camera(section, lens, (int(words[2]), int(words[3])), focal, center, distortion)


def format_colmap(cameras: Mapping[str, OpencvCamera]) -> bytes:
    """Return the cameras as cameras.txt, numbered from 1 in their order; names go into comments."""
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]; the corner of the first pixel is (0, 0)"]
    for at, (name, camera) in enumerate(cameras.items(), 1):
        count = len(camera.distortion)
        model = (
            "OPENCV_FISHEYE"
            if camera.lens == "equidistant"
            else {0: "PINHOLE", 4: "OPENCV"}.get(count, "FULL_OPENCV")
        )
        distortion = (
            [*camera.distortion, *[0.0] * (8 - count)] if model == "FULL_OPENCV" else camera.distortion
        )
        numbers = [*camera.focal_px, *(camera.center_px + HALF_PX), *distortion]
        told = " ".join(repr(float(number)) for number in numbers)
        lines += [f"# {name}", f"{at} {model} {camera.size_px[0]} {camera.size_px[1]} {told}"]
    return ("\n".join(lines) + "\n").encode()
