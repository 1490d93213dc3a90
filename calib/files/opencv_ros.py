"""Cameras as OpenCV and ROS write them, and what the files of all other programs share.

ROS's ``camera_info`` is camera_calibration_parsers' YAML, or a message as ``ros2 topic echo`` prints it.
Lenses ``plumb_bob`` (5 coefficients), ``rational_polynomial`` (8) and ``equidistant`` (4; ``fisheye`` too).
The file holds no pose: frame ``camera``, x right, y down, z ahead, as ROS's optical frames. R and P are those
of a camera that is not rectified; of a rectified one they are not read, for they do not change what the lens
sees.

OpenCV's ``FileStorage``, in YAML: ``image_width``, ``image_height``, ``camera_matrix`` and
``distortion_coefficients`` as the calibration samples write them (``K`` and ``D`` too), ``fisheye_model`` (or
``camera_model: fisheye``) for cv2.fisheye's lens. OpenCV has no keys for where a camera is: this writer adds
``frame`` and ``camera_from_frame`` (4, 4), points of the frame to camera axes, and this reader knows them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.errors import BadFile
from calib.files import LARGEST_COMPONENT, LARGEST_IMAGE_PX, CameraFile, blind_notes, digest_of
from calib.files.twin import FISHEYE, ODD, LensFamily, kind_of_lens
from calib.files.yaml_text import Section, dump_mapping, kind_of, parse_mapping
from calib.geometry.cahvor import CameraModel
from calib.geometry.lenses import opencv
from calib.geometry.rigid import FloatArray, Rigid

CAMERA_FRAME = "camera"
"""The frame of a file that holds no pose: the camera's own, x right, y down, z ahead."""

LARGEST_COEFFICIENT = 1e6


class Loose(Section):
    """A mapping whose unknown keys are noted, not refused: other programs write more than they need."""

    def __init__(self, path: str | Path, place: str, value: Any) -> None:
        if not isinstance(value, dict):
            raise BadFile(path, place, f"{kind_of(value)} where a mapping is expected")
        super().__init__(path, place, value, (), tuple(value))

    def need(self, *names: str) -> str:
        """Return the first of the names that is a key here; they are other programs' words for one thing."""
        for name in names:
            if name in self.values:
                return name
        raise self.bad(names[0], "the key is missing")

    def numbers(self, key: str, counts: Sequence[int] = (), limit: float = LARGEST_COMPONENT) -> FloatArray:
        """Return a list of numbers (n,), n one of ``counts`` if given."""
        value = self.values[key]
        if not isinstance(value, list) or (counts and len(value) not in counts):
            expected = " or ".join(map(str, counts)) + " " if counts else ""
            raise self.bad(key, f"{kind_of(value)} where a list of {expected}numbers is expected")
        return self.vector(key, limit, len(value))

    def matrix(self, key: str, shapes: Sequence[tuple[int, int]]) -> FloatArray:
        """Return ``{rows, cols, data}`` as an array of one of the shapes."""
        inner = Loose(self.path, self.at(key), self.values[key])
        rows, columns = (inner.integer(inner.need(name), 0, 10_000) for name in ("rows", "cols"))
        if (rows, columns) not in shapes:
            expected = " or ".join(f"{a} x {b}" for a, b in shapes[:6])
            raise self.bad(key, f"{rows} x {columns} where {expected} is expected")
        return inner.numbers(inner.need("data"), (rows * columns,)).reshape(rows, columns)

    def size(self, width: str, height: str) -> tuple[int, int]:
        """Return the image's size from two keys."""
        return self.integer(width, 1, LARGEST_IMAGE_PX), self.integer(height, 1, LARGEST_IMAGE_PX)

    def unread(self, known: Sequence[str]) -> tuple[str, ...]:
        """Return a note that names the keys that were not read."""
        left = [key for key in self.values if key not in known]
        return (f"{', '.join(f'{self.at(key)!s}' for key in left[:8])} not read",) if left else ()


def camera_matrix(section: Section, key: str, matrix: FloatArray) -> FloatArray:
    """Return a matrix K (3, 3), which has no skew: cv2 and those who build on it leave a skew out."""
    if matrix[0, 1] or matrix[1, 0] or matrix[2].tolist() != [0.0, 0.0, 1.0]:
        raise section.bad(key, f"{matrix.tolist()} where [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] is expected")
    return matrix


def matrix_of(numbers: FloatArray) -> FloatArray:
    """Return fx, fy, cx, cy as a camera matrix (3, 3)."""
    fx, fy, cx, cy = numbers.tolist()
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def pose_of(section: Section, key: str, matrix: FloatArray) -> Rigid:
    """Return a (4, 4) matrix as a rigid transform; a rotation of few digits is made one."""
    turn, _, other = np.linalg.svd(matrix[:3, :3])
    rotation = turn @ other
    off = np.abs(rotation - matrix[:3, :3]).max()
    if not off < 1e-3 or np.linalg.det(rotation) < 0.0 or matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
        raise section.bad(key, "no rotation and translation: (4, 4) with a last row 0, 0, 0, 1 is expected")
    return Rigid(rotation, matrix[:3, 3])


def lens_camera(
    section: Section,
    family: LensFamily,
    size_px: tuple[int, int],
    matrix: FloatArray,
    distortion: FloatArray,
    frame_from_camera: Rigid | None = None,
) -> CameraModel:
    """Return the camera of numbers that were read, or refuse them; one without a lens is a CAHV."""
    if np.abs(distortion).max(initial=0.0) > LARGEST_COEFFICIENT:
        raise section.bad("", f"coefficients {distortion.tolist()} where numbers up to 1e6 are expected")
    focal_px = matrix[[0, 1], [0, 1]]
    if not ((np.abs(focal_px) > 1e-3) & (np.abs(focal_px) < 1e7)).all() or np.abs(matrix[:2, 2]).max() > 1e7:
        raise section.bad("", f"focal length {focal_px.tolist()} where pixels are expected")
    if focal_px.prod() < 0.0:
        raise section.bad("", f"focal lengths {focal_px.tolist()} of two signs: a mirrored image is not read")
    pose = Rigid.identity() if frame_from_camera is None else frame_from_camera
    if focal_px[1] < 0.0:  # the same as a camera turned about z by half a turn
        pose = pose @ Rigid(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
        matrix = matrix * [[-1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [1.0, 1.0, 1.0]]
        if family == "pinhole":
            distortion = distortion * np.where(np.isin(np.arange(len(distortion)), ODD), -1.0, 1.0)
    try:
        return CameraModel.of_matrix(
            kind_of_lens(family, distortion), size_px, matrix, distortion, pose.rotation.T, pose.translation_m
        )
    except ValueError as error:
        raise section.bad("", str(error)) from None


def as_camera_file(
    camera: CameraModel, section: Section, frame: str, digest: str, notes: Sequence[str] = ()
) -> CameraFile:
    """Return the camera, with a note of the part of its image that has no ray.

    Raises
    ------
    BadFile
        If more than half of the image has no ray, or the lens folds at its axis.
    """
    notes = (*notes, *blind_notes(camera, section.path, section.place))
    return CameraFile(camera, frame, {}, {}, notes, Path(section.path), digest)


def row(values: Any) -> str:
    """Return numbers as YAML's and Python's list, in shortest round-trip form."""
    return f"[{', '.join(repr(float(value)) for value in np.asarray(values).ravel())}]"


def lens_pose(camera: CameraModel) -> Rigid:
    """Return the camera's axes (x right, y down, z ahead) and C in its frame."""
    return Rigid(camera.rotation.T, camera.C)


def matrix44(pose: Rigid) -> FloatArray:
    """Return a transform as (4, 4)."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = pose.rotation, pose.translation_m
    return whole


LENSES: dict[str, tuple[LensFamily, tuple[int, ...]]] = {
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
    """Return whether a YAML file's keys are those of a camera_info."""
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
    camera = lens_camera(top, lens, size, camera_matrix(top, key, matrix), distortion)
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


def format_camera_info(camera: CameraModel, lens: str, name: str) -> bytes:
    """Return the camera as camera_calibration_parsers writes it; its pose is left out."""
    distortion = camera.distortion
    if lens == "plumb_bob":
        distortion = np.concatenate([distortion, np.zeros(5 - len(distortion))])

    def matrix(values: FloatArray) -> dict[str, object]:
        return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel()}

    return dump_mapping(
        {
            "image_width": camera.size_px[0],
            "image_height": camera.size_px[1],
            "camera_name": name,
            "camera_matrix": matrix(camera.camera_matrix),
            "distortion_model": lens,
            "distortion_coefficients": matrix(distortion[None]),
            "rectification_matrix": matrix(np.eye(3)),
            "projection_matrix": matrix(np.hstack([camera.camera_matrix, np.zeros((3, 1))])),
        }
    )


_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "M")
_COEFFICIENTS = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "Distortion_Coefficients", "D")
_WIDTH, _HEIGHT = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")
_TAG = re.compile(rb"!!opencv-(?:matrix|nd-matrix)\b")
_HEAD = re.compile(rb"\A\s*%YAML[: ]1\.[0-9]\s*?\n(?:---[^\n]*\n)?")


def looks_like_opencv(data: bytes) -> bool:
    """Return whether the bytes are of OpenCV's FileStorage in YAML."""
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
    matrix = camera_matrix(top, matrix_key, top.matrix(matrix_key, ((3, 3),)))
    width_key, height_key = top.need(*_WIDTH), top.need(*_HEIGHT)
    size = top.size(width_key, height_key)
    fisheye = _is_fisheye(top)
    counts = (4,) if fisheye else (0, *opencv.COUNTS)
    shapes = [shape for count in counts for shape in ((1, count), (count, 1))]
    distortion = top.matrix(distortion_key, shapes).ravel()
    frame, pose = CAMERA_FRAME, None
    known = [
        matrix_key,
        distortion_key,
        width_key,
        height_key,
        "fisheye_model",
        "camera_model",
        "distortion_model",
    ]
    if "camera_from_frame" in top:
        pose = pose_of(top, "camera_from_frame", top.matrix("camera_from_frame", ((4, 4),))).inverse
        frame = top.text(top.need("frame"))
        known += ["frame", "camera_from_frame"]
    camera = lens_camera(top, "equidistant" if fisheye else "pinhole", size, matrix, distortion, pose)
    return as_camera_file(camera, top, frame, digest_of(data), top.unread(known))


_FISHEYE_WORDS = ("equidistant", "fisheye")


def _is_fisheye(top: Loose) -> bool:
    """Whether the file says that its lens is cv2.fisheye's."""
    if "camera_model" in top:
        return top.choice("camera_model", ("pinhole", "fisheye")) == "fisheye"
    if "distortion_model" in top:  # OpenCV writes none, but calibrators with ROS's words do
        words = ("plumb_bob", "rational_polynomial", *_FISHEYE_WORDS)
        return top.choice("distortion_model", words) in _FISHEYE_WORDS
    return bool(top.integer("fisheye_model", 0, 1)) if "fisheye_model" in top else False


def format_opencv(camera: CameraModel, frame: str) -> bytes:
    """Return the camera as OpenCV's YAML, its pose with it."""
    fisheye = camera.kind == FISHEYE
    distortion = camera.distortion if len(camera.distortion) else np.zeros(4)
    lines = [
        "%YAML:1.0",
        "---",
        "# The centre of the first pixel is (0, 0); camera_from_frame: metres of 'frame' to camera axes.",
        f"image_width: {camera.size_px[0]}",
        f"image_height: {camera.size_px[1]}",
        f"camera_model: {'fisheye' if fisheye else 'pinhole'}",
        f"fisheye_model: {int(fisheye)}",
        *_matrix("camera_matrix", camera.camera_matrix),
        *_matrix("distortion_coefficients", distortion[:, None] if fisheye else distortion[None]),
        f'frame: "{_quoted(frame)}"',
        *_matrix("camera_from_frame", matrix44(lens_pose(camera).inverse)),
    ]
    return ("\n".join(lines) + "\n").encode()


def _matrix(name: str, values: FloatArray) -> list[str]:
    rows, columns = values.shape
    head = f"{name}: !!opencv-matrix"
    return [head, f"   rows: {rows}", f"   cols: {columns}", "   dt: d", f"   data: {row(values)}"]


def _quoted(text: str) -> str:
    return text.replace("\\", "\\\\").replace('"', '\\"')
