"""Cameras as mrcal and Kalibr write them.

mrcal's ``.cameramodel`` is a Python mapping in text, one camera with its pose. ``extrinsics`` are rt_fromref:
a rotation vector and a translation from the reference frame, whose name the file has no place for, to camera
axes. LENSMODEL_CAHVOR and LENSMODEL_CAHVORE_linearity=p hold fx fy cx cy, alpha and beta, R0 R1 R2, and E0 E1
E2. O is (sin α cos β, sin β, cos α cos β) in camera axes. Since 2.5 ``extrinsics`` are called ``rt_cam_ref``
too; before 1.0 the lens was under ``lens_model`` or, as DISTORTION_..., under ``distortion_model``. They
are exact twins of ours if H and V are at right angles. LENSMODEL_PINHOLE and OPENCV4, 5, 8, 12 are read too,
and OPENCV5 and 8 written on request. Source: https://mrcal.secretsauce.net/cameramodels.html and
lensmodels.html.

Kalibr's camchain has cameras ``cam0``, ``cam1``, ... in YAML, each placed against the one before.
``camera_model: pinhole`` with ``distortion_model`` radtan (k1 k2 p1 p2), equidistant (k1 k2 k3 k4) or none.
``T_cn_cnm1`` (4, 4) maps coordinates in the camera before to this one's; Kalibr gives cam0 none, and then
the chain's frame is ``cam0``. This writer gives cam0 one too, from the frame of its cameras' poses, as
mrcal does. Source: https://github.com/ethz-asl/kalibr/wiki/yaml-formats.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from calib.errors import BadFile
from calib.files import UNKNOWN_FRAME, CameraFile, build_model
from calib.files.mast_file import SizePx
from calib.files.opencv_ros import (
    Numbers,
    Source,
    intrinsics_of,
    lens_camera,
    lens_numbers,
    matrix44,
    pose_of,
    read_document,
    read_foreign,
)
from calib.files.records import ABSENT, Number, Record, Text
from calib.files.twin import FISHEYE
from calib.files.yaml_text import dump_mapping, kind_of, parse_mapping
from calib.geometry.cahvor import FREE, CameraModel
from calib.geometry.rigid import FloatArray, Rigid

_INPUTS = re.compile(rb"""['"]optimization_inputs['"]\s*:\s*b(?:'[^']*'|"[^"]*")\s*,?""")
_BEGINS = re.compile(rb"(?:\s|#[^\n]*\n)*\{")
_CAHVORE = re.compile(r"LENSMODEL_CAHVORE_linearity=([-+0-9.eE]+)")
_OPENCV = {"LENSMODEL_PINHOLE": 0} | {f"LENSMODEL_OPENCV{count}": count for count in (4, 5, 8, 12)}
_MRCAL_NAMES = {"lensmodel": ("lens_model", "distortion_model"), "rt_cam_ref": ("extrinsics",)}
_MRCAL_IGNORED = ("icam_intrinsics", "icam_intrinsics_optimization_inputs")
_MRCAL_MARK = re.compile(
    rb"['\"](?:lensmodel|lens_model|distortion_model)['\"]\s*:\s*b?['\"](?:LENSMODEL|DISTORTION)_"
)
_Four = Annotated[list[Number], Field(min_length=4, max_length=4)]
_Pose = Annotated[list[_Four], Field(min_length=4, max_length=4)]


class MrcalRecord(Record):
    """The keys of mrcal's camera model."""

    lensmodel: Text
    rt_cam_ref: Annotated[list[Number], Field(min_length=6, max_length=6)]
    intrinsics: list[Number]
    imagersize: SizePx


class KalibrRecord(Record):
    """The keys of a camera of Kalibr's camchain."""

    camera_model: Literal["pinhole"]
    intrinsics: _Four
    distortion_model: Literal["radtan", "equidistant", "none"]
    resolution: SizePx
    distortion_coeffs: Numbers = Field(default=[])
    T_cn_cnm1: _Pose = Field(default=ABSENT)


def looks_like_mrcal(data: bytes) -> bool:
    """Return whether the bytes begin like a .cameramodel."""
    return _BEGINS.match(data[:4096]) is not None and _MRCAL_MARK.search(data) is not None


def parse_mrcal(data: bytes, path: str | Path) -> CameraFile:
    """Read a .cameramodel; ``path`` is for messages only. Its frame is ``unknown``.

    Raises BadFile if it is no camera: which key, what it holds, what is expected.
    """
    bare = _INPUTS.sub(b"", data)
    # A mapping of numbers, texts and lists in Python's form is one in YAML's too.
    keys = parse_mapping(bare, path)
    record, source = read_foreign(MrcalRecord, keys, path, "", _MRCAL_NAMES, _MRCAL_IGNORED)
    if bare != data:
        source.notes.insert(0, "optimization_inputs: not read")
    pose = np.array(record.rt_cam_ref)
    frame_from_camera = Rigid(Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:]).inverse
    name = record.lensmodel.replace("DISTORTION", "LENSMODEL", 1)
    if name in _OPENCV:
        numbers = _counted(source, record, 4 + _OPENCV[name])
        return lens_camera(
            source,
            ("intrinsics", "pinhole"),
            numbers[4:].tolist(),
            record.imagersize,
            numbers[:4],
            frame_from_camera,
            UNKNOWN_FRAME,
        )
    model, notes = _cahvor(source, record, name, frame_from_camera)
    return CameraFile(model, UNKNOWN_FRAME, {}, {}, (*source.notes, *notes), Path(path))


def _counted(source: Source, record: MrcalRecord, count: int) -> FloatArray:
    """The intrinsics, of which a lens has so many."""
    if len(record.intrinsics) != count:
        reason = f"{kind_of(record.intrinsics)} where a list of {count} numbers is expected"
        raise source.bad("intrinsics", reason)
    return np.array(record.intrinsics)


def _cahvor(
    source: Source, record: MrcalRecord, name: str, frame_from_camera: Rigid
) -> tuple[CameraModel, tuple[str, ...]]:
    """The camera of LENSMODEL_CAHVOR or LENSMODEL_CAHVORE, with notes."""
    match = _CAHVORE.fullmatch(name)
    if name != "LENSMODEL_CAHVOR" and match is None:
        expected = (
            "PINHOLE, OPENCV4, 5, 8 or 12, CAHVOR or CAHVORE (mrcal-convert-lensmodel makes one of others)"
        )
        raise source.bad("lensmodel", f"{kind_of(name)} where LENSMODEL_{expected} is expected")
    numbers = _counted(source, record, 12 if match else 9)
    fx, fy, cx, cy, alpha, beta = numbers[:6].tolist()
    if fx * fy < 0.0:
        reason = f"focal lengths {fx:g}, {fy:g} of two signs: a mirrored image is not read"
        raise source.bad("intrinsics", reason)
    x, y, z = frame_from_camera.rotation.T
    o = np.array([math.sin(alpha) * math.cos(beta), math.sin(beta), math.cos(alpha) * math.cos(beta)])
    vectors = {
        "C": frame_from_camera.translation_m,
        "A": z,
        "H": fx * x + cx * z,
        "V": fy * y + cy * z,
        "O": frame_from_camera.vectors(o),
        "R": numbers[6:9],
    }
    size_px = record.imagersize[0], record.imagersize[1]
    if not match:
        return build_model(source.path, "", "CAHVOR", size_px, vectors)
    linearity = math.nan
    with contextlib.suppress(ValueError):
        linearity = float(match[1])
    if not abs(linearity) <= 100.0:
        reason = f"linearity {match[1][:20]} where a number from -100 to 100 is expected"
        raise source.bad("lensmodel", reason)
    cahvore_type = {1.0: 1, 0.0: 2}.get(linearity, 3)
    vectors["E"] = numbers[9:]
    return build_model(source.path, "", "CAHVORE", size_px, vectors, cahvore_type, linearity)


def format_mrcal(camera: CameraModel, frame: str) -> bytes:
    """Return a camera as a .cameramodel; its H and V are at right angles."""
    pose = camera.pose
    x, y, _ = pose.rotation.T
    name = "LENSMODEL_PINHOLE" if camera.kind == "CAHV" else f"LENSMODEL_{camera.kind}"
    numbers = [
        float(camera.H @ x),
        float(camera.V @ y),
        float(camera.H @ camera.A),
        float(camera.V @ camera.A),
    ]
    if camera.kind in FREE:
        numbers = [*intrinsics_of(camera), *camera.distortion]
    elif camera.kind != "CAHV":
        o = pose.rotation.T @ camera.O
        numbers += [math.atan2(o[0], o[2]), math.asin(min(1.0, max(-1.0, float(o[1])))), *camera.R]
    if camera.kind == "CAHVORE":
        name += f"_linearity={np.format_float_positional(camera.linearity, unique=True, trim='0')}"
        numbers += [*camera.E]
    camera_from_frame = pose.inverse
    turn = Rotation.from_matrix(camera_from_frame.rotation).as_rotvec()
    extrinsics = [*turn, *camera_from_frame.translation_m]
    return f"""\
# reference frame: {frame!r}; the centre of the first pixel is (0, 0)
{{
    'lensmodel':  '{name}',
    'intrinsics': {np.asarray(numbers, dtype=np.float64).tolist()},
    # extrinsics are rt_fromref: rotation vector, translation in metres
    'extrinsics': {np.asarray(extrinsics).tolist()},
    'imagersize': {list(camera.size_px)},
}}
""".encode()


_CAMERA = re.compile(r"cam(0|[1-9][0-9]?)")


def looks_like_kalibr(document: Mapping[str, object]) -> bool:
    """Return whether a YAML file's keys are those of a camchain."""
    first = document.get("cam0")
    return isinstance(first, dict) and "camera_model" in first


def parse_kalibr(data: bytes, path: str | Path) -> dict[str, CameraFile]:
    """Read all cameras of a camchain, by name; ``path`` is for messages only.

    Raises BadFile if it is no camchain: which key, what it holds, what is expected.
    """
    document = read_document(data, path)
    names = [name for name in document if _CAMERA.fullmatch(name)]
    if names != [f"cam{at}" for at in range(len(names))] or not names:
        expected = "where cam0, cam1, ... in order is expected"
        raise BadFile(path, "", f"{', '.join(names) or 'no camera'} {expected}")
    _, beside = read_foreign(Record, document, path, ignored=names)
    first = document["cam0"]
    frame = UNKNOWN_FRAME if isinstance(first, dict) and "T_cn_cnm1" in first else "cam0"
    cameras: dict[str, CameraFile] = {}
    camera_from_frame = Rigid.identity()
    for name in names:
        record, source = read_foreign(
            KalibrRecord, document[name], path, name, ignored=("cam_overlaps", "rostopic")
        )
        source.notes[:0] = beside.notes
        if record.T_cn_cnm1 is not None:
            camera_from_frame = pose_of(source, "T_cn_cnm1", record.T_cn_cnm1) @ camera_from_frame
        elif name != "cam0":
            reason = "the key is missing; it places the camera against the one before"
            raise source.bad("T_cn_cnm1", reason)
        lens = record.distortion_model
        if not record.distortion_coeffs and lens != "none":
            raise source.bad("distortion_coeffs", f"no numbers where 4 are expected for '{lens}'")
        cameras[name] = lens_camera(
            source,
            ("distortion_coeffs", lens),
            record.distortion_coeffs,
            record.resolution,
            record.intrinsics,
            camera_from_frame.inverse,
            frame,
        )
    return cameras


def format_kalibr(cameras: Mapping[str, CameraModel], frame: str) -> bytes:
    """Return the cameras, all placed in one frame, as a camchain in their order; topics have their names."""
    chain: dict[str, dict[str, object]] = {}
    before = Rigid.identity()
    for at, (name, camera) in enumerate(cameras.items()):
        chain[f"cam{at}"] = {
            "camera_model": "pinhole",
            "intrinsics": intrinsics_of(camera),
            "distortion_model": "equidistant" if camera.kind == FISHEYE else "radtan",
            "distortion_coeffs": lens_numbers(camera),
            "resolution": camera.size_px,
            "rostopic": f"/{name}/image_raw",
            "T_cn_cnm1": matrix44(camera.pose.inverse @ before),
        }
        before = camera.pose
    head = f"# T_cn_cnm1 of cam0 maps coordinates in the frame {frame!r}, metres, to cam0's\n"
    return head.encode() + dump_mapping(chain)
