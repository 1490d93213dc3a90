"""What the files of OpenCV, ROS, Kalibr, mrcal and COLMAP share: numbers in, a camera with its twin out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from calib.camera.opencv_camera import LensKind, OpencvCamera
from calib.camera.twin import EXACT_PX, TwinError, nearest_cahvor, twin_error
from calib.errors import BadFile
from calib.files import LARGEST_COMPONENT, LARGEST_IMAGE_PX, CameraFile
from calib.files.strict import Section
from calib.files.yaml_text import kind_of
from calib.rigid import FloatArray, Rigid

CAMERA_FRAME = "camera"
"""The frame of a file that holds no pose: the camera's own, x right, y down, z ahead."""

LARGEST_COEFFICIENT = 1e6
MOST_BLIND = 0.5
"""A lens with no ray in more than this part of its image is refused; a fisheye's corners often have none."""


class Loose(Section):
    """A mapping whose unknown keys are told, not refused: other programs write more than they need."""

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


def camera_matrix(section: Section, key: str, matrix: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return focal lengths and centre (2,) each of a matrix K (3, 3), which has no skew."""
    if matrix[0, 1] or matrix[1, 0] or matrix[2].tolist() != [0.0, 0.0, 1.0]:
        raise section.bad(key, f"{matrix.tolist()} where [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] is expected")
    return matrix[[0, 1], [0, 1]], matrix[:2, 2]


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
    lens: LensKind,
    size_px: tuple[int, int],
    focal_px: FloatArray,
    center_px: FloatArray,
    distortion: FloatArray,
    frame_from_camera: Rigid | None = None,
) -> OpencvCamera:
    """Return the camera of numbers that were read, or refuse them."""
    if np.abs(distortion).max(initial=0.0) > LARGEST_COEFFICIENT:
        raise section.bad("", f"coefficients {distortion.tolist()} where numbers up to 1e6 are expected")
    if not ((np.abs(focal_px) > 1e-3) & (np.abs(focal_px) < 1e7)).all() or np.abs(center_px).max() > 1e7:
        raise section.bad("", f"focal length {focal_px.tolist()} where pixels are expected")
    if focal_px.prod() < 0.0:
        raise section.bad("", f"focal lengths {focal_px.tolist()} of two signs: a mirrored image is not read")
    pose = Rigid.identity() if frame_from_camera is None else frame_from_camera
    try:
        return OpencvCamera(lens, size_px, focal_px, center_px, distortion, pose)
    except ValueError as error:
        raise section.bad("", str(error)) from None


def as_camera_file(
    camera: OpencvCamera, section: Section, frame: str, digest: str, notes: Sequence[str] = ()
) -> CameraFile:
    """Return the camera with its nearest twin of the CAHV family, and a note of how near that is.

    Raises
    ------
    BadFile
        If more than half of the image has no ray, or no twin is found.
    """
    try:
        with np.errstate(all="ignore"):
            model = nearest_cahvor(camera)
            error = twin_error(camera, model)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as problem:
        raise section.bad("", f"is no usable camera: {problem}") from None
    if error.blind > MOST_BLIND:
        raise section.bad("", f"{100 * error.blind:.0f} % of the image has no ray: the lens folds")
    told = f"read as {model.kind}: {error_words(error)}"
    if error.blind:
        told += f"; {100 * error.blind:.2g} % of the image has no ray, where the lens folds or looks sideways"
    where = f"{section.place}: " if section.place else ""
    return CameraFile(
        model, frame, {}, {}, (*notes, where + told), Path(section.path), digest, as_read=camera
    )


def error_words(error: TwinError) -> str:
    """Return how far a twin is, in words."""
    if error.worst_px < EXACT_PX:
        return "exact"
    x, y = error.worst_at_px
    return f"{error.worst_px:.2g} px off at worst (at pixel {x:.0f}, {y:.0f}), {error.rms_px:.2g} px rms"


def row(values: Any) -> str:
    """Return numbers as YAML's and Python's list, in shortest round-trip form."""
    return f"[{', '.join(repr(float(value)) for value in np.asarray(values).ravel())}]"


def matrix44(pose: Rigid) -> FloatArray:
    """Return a transform as (4, 4)."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = pose.rotation, pose.translation_m
    return whole
