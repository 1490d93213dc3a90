"""ROS's ``camera_info``: camera_calibration_parsers' YAML, or a message as ``ros2 topic echo`` prints it.

Lenses ``plumb_bob`` (5 coefficients), ``rational_polynomial`` (8) and ``equidistant`` (4; ``fisheye`` too).
The file holds no pose: frame ``camera``, x right, y down, z ahead, as ROS's optical frames. R and P are
those of a camera that is not rectified; of a rectified one they are not read, for they do not change what
the lens sees.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from calib.camera.opencv_camera import LensKind, OpencvCamera
from calib.files import CameraFile, digest_of
from calib.files.other_lens import CAMERA_FRAME, Loose, as_camera_file, camera_matrix, lens_camera
from calib.files.yaml_text import dump_mapping, parse_mapping
from calib.rigid import FloatArray

LENSES: dict[str, tuple[LensKind, tuple[int, ...]]] = {
    "plumb_bob": ("pinhole", (0, 4, 5)),
    "rational_polynomial": ("pinhole", (8,)),
    "equidistant": ("equidistant", (4,)),
    "fisheye": ("equidistant", (4,)),
    "none": ("pinhole", (0,)),
    "": ("pinhole", (0,)),
}

_FILE_KEYS = ("camera_matrix", "distortion_coefficients", "rectification_matrix", "projection_matrix")
_KNOWN = (*_FILE_KEYS, *"kdrpKDRP", "image_width", "image_height", "width", "height", "camera_name", "header")
_ALSO = ("distortion_model", "binning_x", "binning_y", "roi")


def looks_like_camera_info(document: dict[str, object]) -> bool:
    """Tell whether a YAML file's keys are those of a camera_info."""
    return "distortion_model" in document and ("camera_matrix" in document or "height" in document)


def without_last_mark(data: bytes) -> bytes:
    """Return the bytes without the ``---`` that ``ros2 topic echo`` ends a message with."""
    return re.sub(rb"\n---\s*\Z", b"\n", data)


def parse_camera_info(data: bytes, path: str | Path) -> CameraFile:
    """Read a camera_info; ``path`` is for messages only.

    Raises
    ------
    BadFile
        If it is no camera: which key, what it holds, what is expected.
    """
    top = Loose(path, "", parse_mapping(without_last_mark(data), path))
    model = top.values[top.need("distortion_model")]
    if model not in LENSES or not isinstance(model, str):
        raise top.bad(
            "distortion_model", f"'{model!s:.40}' where one of {', '.join(LENSES)[:-2]} is expected"
        )
    lens, counts = LENSES[model]
    size = top.size(top.need("image_width", "width"), top.need("image_height", "height"))
    if "camera_matrix" in top:
        key = "camera_matrix"
        matrix = top.matrix(key, ((3, 3),))
        shapes = [shape for count in counts for shape in ((1, count), (count, 1))]
        distortion = top.matrix(top.need("distortion_coefficients"), shapes).ravel()
    else:
        key = top.need("k", "K")
        matrix = top.numbers(key, (9,)).reshape(3, 3)
        distortion = top.numbers(top.need("d", "D"), counts)
    focal, center = camera_matrix(top, key, matrix)
    for name in ("binning_x", "binning_y"):
        if name in top and top.integer(name, 0, 64) > 1:
            raise top.bad(name, "the picture is binned; the camera of the whole picture is expected (0 or 1)")
    notes = list(top.unread((*_KNOWN, *_ALSO)))
    if "roi" in top:
        roi = Loose(path, "roi", top.values["roi"])
        if any(name in roi and roi.integer(name, 0, 65536) for name in ("x_offset", "y_offset")):
            notes.append("roi: not read; the camera is that of the whole picture")
    if _is_rectified(top):
        notes.append("R or P turn or scale the picture for rectification; they are not read")
    camera = lens_camera(top, lens, size, focal, center, distortion)
    return as_camera_file(camera, top, CAMERA_FRAME, digest_of(data), notes)


def _is_rectified(top: Loose) -> bool:
    """Whether R is another rotation than none."""
    for key in ("rectification_matrix", "r", "R"):
        if key in top:
            matrix = (
                top.numbers(key, (9,)) if isinstance(top.values[key], list) else top.matrix(key, ((3, 3),))
            )
            return bool(np.abs(matrix.ravel() - np.eye(3).ravel()).max() > 1e-9 and np.any(matrix))
    return False


def format_camera_info(camera: OpencvCamera, lens: str, name: str) -> bytes:
    """Return the camera as camera_calibration_parsers writes it; its pose is left out."""
    distortion = camera.distortion if len(camera.distortion) else np.zeros(5)

    def matrix(values: FloatArray) -> dict[str, object]:
        return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel()}

    return dump_mapping(
        {
            "image_width": camera.size_px[0],
            "image_height": camera.size_px[1],
            "camera_name": name,
            "camera_matrix": matrix(camera.matrix_px),
            "distortion_model": lens,
            "distortion_coefficients": matrix(distortion[None]),
            "rectification_matrix": matrix(np.eye(3)),
            "projection_matrix": matrix(np.hstack([camera.matrix_px, np.zeros((3, 1))])),
        }
    )
