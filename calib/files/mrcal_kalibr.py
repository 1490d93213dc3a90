"""Cameras as mrcal and Kalibr write them.

mrcal's ``.cameramodel`` is a Python mapping in text, one camera with its pose. ``extrinsics`` are rt_fromref:
a rotation vector and a translation from the reference frame, whose name the file has no place for, to camera
axes. LENSMODEL_CAHVOR and LENSMODEL_CAHVORE_linearity=p hold fx fy cx cy, alpha and beta, R0 R1 R2, and E0 E1
E2. O is (sin α cos β, sin β, cos α cos β) in camera axes. Since 2.5 ``extrinsics`` are called ``rt_cam_ref``
too; before 1.0 the lens stood under ``lens_model`` or, as DISTORTION_..., under ``distortion_model``. They
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

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from calib.errors import BadFile
from calib.files import CameraFile, build_model, digest_of
from calib.files.mast_file import SizePx
from calib.files.opencv_ros import (
    LENSES,
    ForeignMapping,
    Reading,
    as_camera_file,
    coefficients,
    lens_camera,
    lens_pose,
    matrix44,
    matrix_of,
    pose_of,
    read_document,
)
from calib.files.records import Number, Text
from calib.files.twin import FISHEYE
from calib.files.yaml_text import dump_mapping, kind_of, parse_mapping
from calib.geometry.cahvor import FREE, CameraModel, Kind
from calib.geometry.rigid import Rigid

UNKNOWN_FRAME = "unknown"
_INPUTS = re.compile(rb"""['"]optimization_inputs['"]\s*:\s*b(?:'[^']*'|"[^"]*")\s*,?""")
_BEGINS = re.compile(rb"(?:\s|#[^\n]*\n)*\{")
_CAHVORE = re.compile(r"LENSMODEL_CAHVORE_linearity=([-+0-9.eE]+)")
_OPENCV = {"LENSMODEL_PINHOLE": 0} | {f"LENSMODEL_OPENCV{count}": count for count in (4, 5, 8, 12)}
_MRCAL_LENS = ("lensmodel", "lens_model", "distortion_model")
_MRCAL_POSE = ("rt_cam_ref", "extrinsics")
_MRCAL_READ = (
    *(*_MRCAL_LENS, *_MRCAL_POSE, "intrinsics", "imagersize"),
    *("icam_intrinsics", "icam_intrinsics_optimization_inputs"),
)
_MRCAL_MARK = re.compile(
    rb"['\"](?:lensmodel|lens_model|distortion_model)['\"]\s*:\s*b?['\"](?:LENSMODEL|DISTORTION)_"
)


def looks_like_mrcal(data: bytes) -> bool:
    """Return whether the bytes begin like a .cameramodel."""
    return _BEGINS.match(data[:4096]) is not None and _MRCAL_MARK.search(data) is not None


def parse_mrcal(data: bytes, path: str | Path) -> CameraFile:
    """Read a .cameramodel; ``path`` is for messages only. Its frame is ``unknown``.

    Raises
    ------
    BadFile
        If it is no camera: which key, what it holds, what is expected.
    """
    bare = _INPUTS.sub(b"", data)
    notes: tuple[str, ...] = ("optimization_inputs: not read",) if bare != data else ()
    # A mapping of numbers, texts and lists in Python's form is one in YAML's too.
    top = ForeignMapping(path, "", parse_mapping(bare, path))
    lens_key, pose_key = top.need(*_MRCAL_LENS), top.need(*_MRCAL_POSE)
    for key in ("intrinsics", "imagersize"):
        top.need(key)
    name = str(top.read(Text, lens_key)).replace("DISTORTION", "LENSMODEL", 1)
    width, height = top.read(SizePx, "imagersize")
    pose = top.numbers(pose_key, 6)
    frame_from_camera = Rigid(Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:]).inverse
    notes += top.unread(_MRCAL_READ)
    if name in _OPENCV:
        numbers = top.numbers("intrinsics", 4 + _OPENCV[name])
        camera = lens_camera(
            top, "pinhole", (width, height), matrix_of(numbers[:4]), numbers[4:], frame_from_camera
        )
        return as_camera_file(camera, top, UNKNOWN_FRAME, digest_of(data), notes)
    model, model_notes = _cahvor(top, name, (width, height), frame_from_camera)
    return CameraFile(model, UNKNOWN_FRAME, {}, {}, (*notes, *model_notes), Path(path), digest_of(data))


def _cahvor(
    top: ForeignMapping, name: str, size_px: tuple[int, int], frame_from_camera: Rigid
) -> tuple[CameraModel, tuple[str, ...]]:
    """The camera of LENSMODEL_CAHVOR or LENSMODEL_CAHVORE, with notes."""
    match = _CAHVORE.fullmatch(name)
    if name != "LENSMODEL_CAHVOR" and match is None:
        expected = (
            "PINHOLE, OPENCV4, 5, 8 or 12, CAHVOR or CAHVORE (mrcal-convert-lensmodel makes one of others)"
        )
        raise top.bad("lensmodel", f"{kind_of(name)} where LENSMODEL_{expected} is expected")
    numbers = top.numbers("intrinsics", 12 if match else 9)
    fx, fy, cx, cy, alpha, beta = numbers[:6].tolist()
    if fx * fy < 0.0:
        raise top.bad(
            "intrinsics", f"focal lengths {fx:g}, {fy:g} of two signs: a mirrored image is not read"
        )
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
    kind: Kind = "CAHVOR"
    cahvore_type, linearity = 0, None
    if match:
        kind, vectors["E"] = "CAHVORE", numbers[9:]
        try:
            linearity = float(match[1])
        except ValueError:
            raise top.bad("lensmodel", f"linearity '{match[1][:20]}' where a number is expected") from None
        if not abs(linearity) <= 100.0:
            raise top.bad("lensmodel", f"linearity {linearity:g} where a number from -100 to 100 is expected")
        cahvore_type = {1.0: 1, 0.0: 2}.get(linearity, 3)
    return build_model(top.path, "", kind, size_px, vectors, cahvore_type, linearity)


def format_mrcal(camera: CameraModel, frame: str) -> bytes:
    """Return a camera as a .cameramodel; its H and V are at right angles."""
    if camera.kind in FREE:
        name, pose = f"LENSMODEL_{camera.kind}", lens_pose(camera)
        numbers = [*camera.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *camera.distortion]
    else:
        name, numbers, pose = _numbers_of(camera)
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


def _numbers_of(model: CameraModel) -> tuple[str, list[float], Rigid]:
    """Lens model, intrinsics and pose of a camera of the CAHV family."""
    hc, vc = float(model.H @ model.A), float(model.V @ model.A)
    pose = model.pose
    x, y, _ = pose.rotation.T
    core = [float(model.H @ x), float(model.V @ y), hc, vc]
    if model.kind == "CAHV":
        return "LENSMODEL_PINHOLE", core, pose
    o = pose.rotation.T @ model.O
    axis = [math.atan2(o[0], o[2]), math.asin(min(1.0, max(-1.0, float(o[1]))))]
    numbers = [*core, *axis, *model.R.tolist()]
    if model.kind == "CAHVOR":
        return "LENSMODEL_CAHVOR", numbers, pose
    linearity = np.format_float_positional(model.linearity, unique=True, trim="0")
    return f"LENSMODEL_CAHVORE_linearity={linearity}", [*numbers, *model.E.tolist()], pose


def refuse_mirrored(model: CameraModel, path: str | Path) -> None:
    """Refuse a camera whose image is mirrored: mrcal's CAHVOR has no such one."""
    if np.cross(model.H, model.V) @ model.A < 0.0:
        raise BadFile(path, "", "the image is mirrored (H x V is against A); no such format can hold that")


_CAMERA = re.compile(r"cam(0|[1-9][0-9]?)")
_Lens = Literal["radtan", "equidistant", "none"]
_Pose = Annotated[
    list[Annotated[list[Number], Field(min_length=4, max_length=4)]], Field(min_length=4, max_length=4)
]
_KALIBR_READ = (
    "camera_model",
    "intrinsics",
    "distortion_model",
    "distortion_coeffs",
    "resolution",
    "T_cn_cnm1",
)


def looks_like_kalibr(document: Mapping[str, object]) -> bool:
    """Return whether a YAML file's keys are those of a camchain."""
    first = document.get("cam0")
    return isinstance(first, dict) and "camera_model" in first


def parse_kalibr(data: bytes, path: str | Path) -> dict[str, Reading]:
    """Read all cameras of a camchain, by name, each or its refusal; ``path`` is for messages only.

    Raises
    ------
    BadFile
        If it is no camchain: which key, what it holds, what is expected.
    """
    document, notes_before = read_document(data, path)
    top = ForeignMapping(path, "", document)
    names = [name for name in top.values if _CAMERA.fullmatch(name)]
    if names != [f"cam{at}" for at in range(len(names))] or not names:
        raise BadFile(
            path, "", f"{', '.join(names) or 'no camera'} where cam0, cam1, ... in order is expected"
        )
    first = top.values["cam0"]
    frame = UNKNOWN_FRAME if isinstance(first, dict) and "T_cn_cnm1" in first else "cam0"
    notes_before = (*notes_before, *top.unread(names))
    readings: dict[str, Reading] = {}
    camera_from_frame = Rigid.identity()
    lost: BadFile | None = None
    for name in names:
        try:
            section = ForeignMapping(path, name, top.values[name])
            if lost is None:
                try:
                    camera_from_frame = _step(section) @ camera_from_frame
                except BadFile as refusal:
                    lost = refusal
            if lost is not None:
                raise lost
            readings[name] = _kalibr_camera(
                section, camera_from_frame.inverse, frame, digest_of(data), notes_before
            )
        except BadFile as refusal:
            readings[name] = refusal
    return readings


def _step(section: ForeignMapping) -> Rigid:
    """The transform from the camera before."""
    if "T_cn_cnm1" in section:
        return pose_of(section, "T_cn_cnm1", np.array(section.read(_Pose, "T_cn_cnm1")))
    if section.place != "cam0":
        raise section.bad("T_cn_cnm1", "the key is missing; it places the camera against the one before")
    return Rigid.identity()


def _kalibr_camera(
    section: ForeignMapping, frame_from_camera: Rigid, frame: str, digest: str, notes_before: Sequence[str]
) -> CameraFile:
    for key in ("camera_model", "intrinsics", "distortion_model", "resolution"):
        section.need(key)
    if section.values["camera_model"] != "pinhole":
        raise section.bad(
            "camera_model", f"{kind_of(section.values['camera_model'])}; only 'pinhole' is read"
        )
    lens = section.read(_Lens, "distortion_model")
    notes = list(notes_before)
    numbers = section.numbers("distortion_coeffs") if "distortion_coeffs" in section else np.zeros(0)
    if not len(numbers) and lens != "none":
        section.need("distortion_coeffs")
        raise section.bad("distortion_coeffs", f"an empty list where 4 numbers are expected for '{lens}'")
    distortion = coefficients(section, "distortion_coeffs", lens, numbers, notes)
    notes += section.unread((*_KALIBR_READ, "cam_overlaps", "rostopic"))
    width, height = section.read(SizePx, "resolution")
    matrix = matrix_of(section.numbers("intrinsics", 4))
    camera = lens_camera(section, LENSES[lens][0], (width, height), matrix, distortion, frame_from_camera)
    return as_camera_file(camera, section, frame, digest, notes)


def format_kalibr(cameras: Mapping[str, CameraModel], frame: str) -> bytes:
    """Return the cameras, all placed in one frame, as a camchain in their order; topics have their names."""
    chain: dict[str, dict[str, object]] = {}
    before = Rigid.identity()
    for at, (name, camera) in enumerate(cameras.items()):
        pose = lens_pose(camera)
        chain[f"cam{at}"] = {
            "camera_model": "pinhole",
            "intrinsics": camera.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]],
            "distortion_model": "equidistant" if camera.kind == FISHEYE else "radtan",
            "distortion_coeffs": camera.distortion if len(camera.distortion) else np.zeros(4),
            "resolution": camera.size_px,
            "rostopic": f"/{name}/image_raw",
            "T_cn_cnm1": matrix44(pose.inverse @ before),
        }
        before = pose
    head = f"# T_cn_cnm1 of cam0 maps coordinates in the frame {frame!r}, metres, to cam0's\n"
    return head.encode() + dump_mapping(chain)
