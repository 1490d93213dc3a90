"""mrcal's ``.cameramodel``: a Python mapping in text, one camera with its pose.

``extrinsics`` are rt_fromref: a rotation vector and a translation from the reference frame, whose name the
file has no place for, to camera axes. LENSMODEL_CAHVOR and LENSMODEL_CAHVORE_linearity=p hold fx fy cx cy,
then alpha and beta, with O = (sin α cos β, sin β, cos α cos β) in camera axes, R0 R1 R2, and E0 E1 E2:
exact twins of ours, but for H and V that are not at right angles. LENSMODEL_PINHOLE and OPENCV4, 5, 8, 12
are read too, and OPENCV5 and 8 written where asked for. Source:
https://mrcal.secretsauce.net/cameramodels.html and lensmodels.html.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.camera.cahvor import CameraModel, Kind
from calib.camera.opencv_camera import OpencvCamera
from calib.errors import BadFile
from calib.files import LARGEST_IMAGE_PX, CameraFile, build_model, digest_of
from calib.files.other_lens import Loose, as_camera_file, lens_camera, row
from calib.files.yaml_text import kind_of, parse_mapping
from calib.rigid import Rigid

UNKNOWN_FRAME = "unknown"
_INPUTS = re.compile(rb"""['"]optimization_inputs['"]\s*:\s*b(?:'[^']*'|"[^"]*")\s*,?""")
_BEGINS = re.compile(rb"(?:\s|#[^\n]*\n)*\{")
_CAHVORE = re.compile(r"LENSMODEL_CAHVORE_linearity=([-+0-9.eE]+)")
_OPENCV = {"LENSMODEL_PINHOLE": 0} | {f"LENSMODEL_OPENCV{count}": count for count in (4, 5, 8, 12)}
_READ = (
    "lensmodel",
    "intrinsics",
    "extrinsics",
    "imagersize",
    "icam_intrinsics",
    "icam_intrinsics_optimization_inputs",
)


def looks_like_mrcal(data: bytes) -> bool:
    """Tell whether the bytes begin like a .cameramodel."""
    return _BEGINS.match(data[:4096]) is not None and b"lensmodel" in data


def parse_mrcal(data: bytes, path: str | Path) -> CameraFile:
    """Read a .cameramodel; ``path`` is for messages only. Its frame is ``unknown``.

    Raises
    ------
    BadFile
        If it is no camera: which key, what it holds, what is expected.
    """
    bare = _INPUTS.sub(b"", data)
    notes: tuple[str, ...] = ("optimization_inputs: not read",) if bare != data else ()
    # A mapping of numbers, words and lists in Python's form is one in YAML's too.
    top = Loose(path, "", parse_mapping(bare, path))
    for key in _READ[:4]:
        top.need(key)
    name = top.text("lensmodel")
    width, height = top.integers("imagersize", 2, 1, LARGEST_IMAGE_PX)
    pose = top.vector("extrinsics", count=6)
    frame_from_camera = Rigid(Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:]).inverse
    notes += top.unread(_READ)
    if name in _OPENCV:
        numbers = top.vector("intrinsics", count=4 + _OPENCV[name])
        camera = lens_camera(
            top, "pinhole", (width, height), numbers[:2], numbers[2:4], numbers[4:], frame_from_camera
        )
        return as_camera_file(camera, top, UNKNOWN_FRAME, digest_of(data), notes)
    model, model_notes = _cahvor(top, name, (width, height), frame_from_camera)
    return CameraFile(model, UNKNOWN_FRAME, {}, {}, (*notes, *model_notes), Path(path), digest_of(data))


def _cahvor(
    top: Loose, name: str, size_px: tuple[int, int], frame_from_camera: Rigid
) -> tuple[CameraModel, tuple[str, ...]]:
    """The camera of LENSMODEL_CAHVOR or LENSMODEL_CAHVORE, with notes."""
    match = _CAHVORE.fullmatch(name)
    if name != "LENSMODEL_CAHVOR" and match is None:
        expected = (
            "PINHOLE, OPENCV4, 5, 8 or 12, CAHVOR or CAHVORE (mrcal-convert-lensmodel makes one of others)"
        )
        raise top.bad("lensmodel", f"{kind_of(name)} where LENSMODEL_{expected} is expected")
    numbers = top.vector("intrinsics", count=12 if match else 9)
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


def format_mrcal(camera: CameraModel | OpencvCamera, frame: str) -> bytes:
    """Return a camera as a .cameramodel; H and V of a CameraModel are at right angles."""
    if isinstance(camera, OpencvCamera):
        pose = camera.frame_from_camera
        name = f"LENSMODEL_OPENCV{len(camera.distortion)}" if len(camera.distortion) else "LENSMODEL_PINHOLE"
        numbers = [*camera.focal_px, *camera.center_px, *camera.distortion]
    else:
        name, numbers, pose = _numbers_of(camera)
    camera_from_frame = pose.inverse
    turn = Rotation.from_matrix(camera_from_frame.rotation).as_rotvec()
    lines = [
        f"# reference frame: {frame!r}; the centre of the first pixel is (0, 0)",
        "{",
        f"    'lensmodel':  '{name}',",
        f"    'intrinsics': {row(numbers)},",
        "    # extrinsics are rt_fromref: rotation vector, translation in metres",
        f"    'extrinsics': {row([*turn, *camera_from_frame.translation_m])},",
        f"    'imagersize': [{camera.size_px[0]}, {camera.size_px[1]}],",
        "}",
    ]
    return ("\n".join(lines) + "\n").encode()


def _numbers_of(model: CameraModel) -> tuple[str, list[float], Rigid]:
    """Lens model, intrinsics and pose of a camera of the CAHV family."""
    hc, vc = float(model.H @ model.A), float(model.V @ model.A)
    across = model.H - hc * model.A
    x = across / np.linalg.norm(across)
    y = np.cross(model.A, x)
    pose = Rigid(np.stack([x, y, model.A], axis=1), model.C)
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
