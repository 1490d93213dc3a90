"""A camera as OpenCV's ``FileStorage`` writes it, in YAML.

Read: ``image_width``, ``image_height``, ``camera_matrix`` and ``distortion_coefficients`` as the
calibration samples write them (``K`` and ``D`` too), ``fisheye_model`` (or ``camera_model: fisheye``) for
cv2.fisheye's lens. OpenCV has no keys for where a camera is: this writer adds ``frame`` and
``camera_from_frame`` (4, 4), points of the frame to camera axes, and this reader knows them.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from calib.camera.opencv_camera import COUNTS, OpencvCamera
from calib.files import CameraFile, digest_of
from calib.files.other_lens import (
    CAMERA_FRAME,
    Loose,
    as_camera_file,
    camera_matrix,
    lens_camera,
    matrix44,
    pose_of,
    row,
)
from calib.files.yaml_text import parse_mapping
from calib.rigid import FloatArray

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M")
_COEFFICIENTS = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "Distortion_Coefficients", "D")
_WIDTH, _HEIGHT = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")
_TAG = re.compile(rb"!!opencv-(?:matrix|nd-matrix)\b")
_HEAD = re.compile(rb"\A\s*%YAML[: ]1\.[0-9]\s*?\n(?:---[^\n]*\n)?")


def looks_like_opencv(data: bytes) -> bool:
    """Tell whether the bytes are of OpenCV's FileStorage in YAML."""
    return data.startswith(b"%YAML:") or _TAG.search(data) is not None


def parse_opencv(data: bytes, path: str | Path) -> CameraFile:
    """Read a camera of OpenCV's YAML; ``path`` is for messages only.

    Raises
    ------
    BadFile
        If it is no camera: which key, what it holds, what is expected.
    """
    top = Loose(path, "", parse_mapping(_TAG.sub(b"", _HEAD.sub(b"", data)), path))
    matrix_key, distortion_key = top.need(*_MATRIX), top.need(*_COEFFICIENTS)
    focal, center = camera_matrix(top, matrix_key, top.matrix(matrix_key, ((3, 3),)))
    width_key, height_key = top.need(*_WIDTH), top.need(*_HEIGHT)
    size = top.size(width_key, height_key)
    fisheye = _is_fisheye(top)
    counts = COUNTS["equidistant" if fisheye else "pinhole"]
    shapes = [shape for count in counts for shape in ((1, count), (count, 1))]
    distortion = top.matrix(distortion_key, shapes).ravel()
    frame, pose = CAMERA_FRAME, None
    known = [matrix_key, distortion_key, width_key, height_key, "fisheye_model", "camera_model"]
    if "camera_from_frame" in top:
        pose = pose_of(top, "camera_from_frame", top.matrix("camera_from_frame", ((4, 4),))).inverse
        frame = top.text(top.need("frame"))
        known += ["frame", "camera_from_frame"]
    camera = lens_camera(top, "equidistant" if fisheye else "pinhole", size, focal, center, distortion, pose)
    return as_camera_file(camera, top, frame, digest_of(data), top.unread(known))


def _is_fisheye(top: Loose) -> bool:
    """Whether the file says that its lens is cv2.fisheye's."""
    if "camera_model" in top:
        return top.choice("camera_model", ("pinhole", "fisheye")) == "fisheye"
    return bool(top.integer("fisheye_model", 0, 1)) if "fisheye_model" in top else False


def format_opencv(camera: OpencvCamera, frame: str) -> bytes:
    """Return the camera as OpenCV's YAML, its pose with it."""
    fisheye = camera.lens == "equidistant"
    distortion = camera.distortion if len(camera.distortion) else np.zeros(4)
    lines = [
        "%YAML:1.0",
        "---",
        "# The centre of the first pixel is (0, 0); camera_from_frame: metres of 'frame' to camera axes.",
        f"image_width: {camera.size_px[0]}",
        f"image_height: {camera.size_px[1]}",
        f"camera_model: {'fisheye' if fisheye else 'pinhole'}",
        f"fisheye_model: {int(fisheye)}",
        *_matrix("camera_matrix", camera.matrix_px),
        *_matrix("distortion_coefficients", distortion[:, None] if fisheye else distortion[None]),
        f'frame: "{_quoted(frame)}"',
        *_matrix("camera_from_frame", matrix44(camera.frame_from_camera.inverse)),
    ]
    return ("\n".join(lines) + "\n").encode()


def _matrix(name: str, values: FloatArray) -> list[str]:
    rows, columns = values.shape
    head = f"{name}: !!opencv-matrix"
    return [head, f"   rows: {rows}", f"   cols: {columns}", "   dt: d", f"   data: {row(values)}"]


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')
