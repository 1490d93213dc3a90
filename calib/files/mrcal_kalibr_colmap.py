"""Cameras as mrcal, Kalibr and COLMAP write them.

mrcal's ``.cameramodel`` is a Python mapping in text, one camera with its pose. ``extrinsics`` are rt_fromref:
a rotation vector and a translation from the reference frame, whose name the file has no place for, to camera
axes. LENSMODEL_CAHVOR and LENSMODEL_CAHVORE_linearity=p hold fx fy cx cy, alpha and beta, R0 R1 R2, and E0 E1
E2. O is (sin α cos β, sin β, cos α cos β) in camera axes. They are exact twins of ours if H and V are at
right angles. LENSMODEL_PINHOLE and OPENCV4, 5, 8, 12 are read too, and OPENCV5 and 8 written where asked for.
Source: https://mrcal.secretsauce.net/cameramodels.html and lensmodels.html.

Kalibr's camchain has cameras ``cam0``, ``cam1``, ... in YAML, each placed against the one before.
``camera_model: pinhole`` with ``distortion_model`` radtan (k1 k2 p1 p2), equidistant (k1 k2 k3 k4) or none.
``T_cn_cnm1`` (4, 4) maps coordinates in the camera before to this one's; Kalibr gives cam0 none, and then
the chain's frame is ``cam0``. This writer gives cam0 one too, from the frame of its cameras' poses, as
mrcal does. Source: https://github.com/ethz-asl/kalibr/wiki/yaml-formats.

COLMAP's ``cameras.txt`` has a line a camera, ``CAMERA_ID MODEL WIDTH HEIGHT PARAMS...``, without poses. Its
image begins at the *corner* of the first pixel, whose centre is (0.5, 0.5): its cx and cy are half a pixel
more than ours. Models: SIMPLE_PINHOLE, PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV, FULL_OPENCV, and
OPENCV_FISHEYE, SIMPLE_RADIAL_FISHEYE, RADIAL_FISHEYE, whose lens is the equidistant one. Source:
https://colmap.github.io/cameras.html and /format.html.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from calib.errors import BadFile
from calib.files import LARGEST_IMAGE_PX, CameraFile, build_model, digest_of
from calib.files.opencv_ros import (
    CAMERA_FRAME,
    Loose,
    as_camera_file,
    lens_camera,
    lens_pose,
    matrix44,
    matrix_of,
    pose_of,
    row,
)
from calib.files.twin import FISHEYE, LensFamily
from calib.files.yaml_text import kind_of, parse_mapping
from calib.geometry.cahvor import FREE, SPLINED, CameraModel, Kind
from calib.geometry.lenses.spline import SplineGrid
from calib.geometry.rigid import Rigid

UNKNOWN_FRAME = "unknown"
_INPUTS = re.compile(rb"""['"]optimization_inputs['"]\s*:\s*b(?:'[^']*'|"[^"]*")\s*,?""")
_BEGINS = re.compile(rb"(?:\s|#[^\n]*\n)*\{")
_CAHVORE = re.compile(r"LENSMODEL_CAHVORE_linearity=([-+0-9.eE]+)")
_SPLINED = re.compile(
    r"LENSMODEL_SPLINED_STEREOGRAPHIC_order=([0-9]{1,2})_Nx=([0-9]{1,4})_Ny=([0-9]{1,4})_fov_x_deg=([0-9.]{1,12})"
)
_OPENCV = {"LENSMODEL_PINHOLE": 0} | {f"LENSMODEL_OPENCV{count}": count for count in (4, 5, 8, 12)}
_MRCAL_READ = (
    "lensmodel",
    "intrinsics",
    "extrinsics",
    "imagersize",
    "icam_intrinsics",
    "icam_intrinsics_optimization_inputs",
)


def looks_like_mrcal(data: bytes) -> bool:
    """Return whether the bytes begin like a .cameramodel."""
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
    for key in _MRCAL_READ[:4]:
        top.need(key)
    name = top.text("lensmodel")
    width, height = top.integers("imagersize", 2, 1, LARGEST_IMAGE_PX)
    pose = top.vector("extrinsics", count=6)
    frame_from_camera = Rigid(Rotation.from_rotvec(pose[:3]).as_matrix(), pose[3:]).inverse
    notes += top.unread(_MRCAL_READ)
    if name in _OPENCV:
        numbers = top.vector("intrinsics", count=4 + _OPENCV[name])
        camera = lens_camera(
            top, "pinhole", (width, height), matrix_of(numbers[:4]), numbers[4:], frame_from_camera
        )
        return as_camera_file(camera, top, UNKNOWN_FRAME, digest_of(data), notes)
    if (spline := _SPLINED.fullmatch(name)) is not None:
        model = _splined(top, spline, (width, height), frame_from_camera)
        return as_camera_file(model, top, UNKNOWN_FRAME, digest_of(data), notes)
    model, model_notes = _cahvor(top, name, (width, height), frame_from_camera)
    return CameraFile(model, UNKNOWN_FRAME, {}, {}, (*notes, *model_notes), Path(path), digest_of(data))


def _splined(
    top: Loose, match: re.Match[str], size_px: tuple[int, int], frame_from_camera: Rigid
) -> CameraModel:
    """The camera of LENSMODEL_SPLINED_STEREOGRAPHIC."""
    try:
        grid = SplineGrid(int(match[1]), int(match[2]), int(match[3]), float(match[4]))
        numbers = top.vector("intrinsics", count=4 + 2 * grid.columns * grid.rows)
        pose = frame_from_camera
        return CameraModel.of_matrix(
            SPLINED, size_px, matrix_of(numbers[:4]), numbers[4:], pose.rotation.T, pose.translation_m, grid
        )
    except ValueError as error:
        raise top.bad("lensmodel", str(error)) from None


def _cahvor(
    top: Loose, name: str, size_px: tuple[int, int], frame_from_camera: Rigid
) -> tuple[CameraModel, tuple[str, ...]]:
    """The camera of LENSMODEL_CAHVOR or LENSMODEL_CAHVORE, with notes."""
    match = _CAHVORE.fullmatch(name)
    if name != "LENSMODEL_CAHVOR" and match is None:
        expected = (
            "PINHOLE, OPENCV4, 5, 8 or 12, SPLINED_STEREOGRAPHIC, CAHVOR or CAHVORE "
            "(mrcal-convert-lensmodel makes one of others)"
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


def format_mrcal(camera: CameraModel, frame: str) -> bytes:
    """Return a camera as a .cameramodel; its H and V are at right angles."""
    if camera.kind in FREE:
        name, pose = f"LENSMODEL_{camera.kind}", lens_pose(camera)
        if camera.spline is not None:
            grid = camera.spline
            name += f"_order={grid.order}_Nx={grid.columns}_Ny={grid.rows}_fov_x_deg={grid.fov_x_deg:g}"
        numbers = [*camera.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]], *camera.distortion]
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
_LENSES: dict[str, tuple[LensFamily, tuple[int, ...]]] = {
    "radtan": ("pinhole", (4,)),
    "equidistant": ("equidistant", (4,)),
    "none": ("pinhole", (0,)),
}
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


def parse_kalibr(data: bytes, path: str | Path) -> dict[str, CameraFile]:
    """Read all cameras of a camchain, by name; ``path`` is for messages only.

    Raises
    ------
    BadFile
        If it is no camchain: which key, what it holds, what is expected.
    """
    top = Loose(path, "", parse_mapping(data.removeprefix(b"%YAML:1.0"), path))
    names = [name for name in top.values if _CAMERA.fullmatch(name)]
    if names != [f"cam{at}" for at in range(len(names))] or not names:
        raise BadFile(
            path, "", f"{', '.join(names) or 'no camera'} where cam0, cam1, ... in order is expected"
        )
    frame = UNKNOWN_FRAME if "T_cn_cnm1" in Loose(path, "cam0", top.values["cam0"]) else "cam0"
    cameras = {}
    camera_from_frame = Rigid.identity()
    for name in names:
        section = Loose(path, name, top.values[name])
        if "T_cn_cnm1" in section:
            camera_from_frame = _pose(section) @ camera_from_frame
        elif name != "cam0":
            raise section.bad("T_cn_cnm1", "the key is missing; it places the camera against the one before")
        camera = _kalibr_camera(section, camera_from_frame.inverse)
        notes = section.unread((*_KALIBR_READ, "cam_overlaps", "rostopic"))
        cameras[name] = as_camera_file(camera, section, frame, digest_of(data), notes)
    return cameras


def _pose(section: Loose) -> Rigid:
    rows = section.values["T_cn_cnm1"]
    if not isinstance(rows, list) or len(rows) != 4:
        raise section.bad("T_cn_cnm1", f"{kind_of(rows)} where four lists of four numbers are expected")
    inner = Loose(section.path, section.place, {f"T_cn_cnm1[{at}]": one for at, one in enumerate(rows)})
    return pose_of(section, "T_cn_cnm1", np.array([inner.vector(key, count=4) for key in inner.values]))


def _kalibr_camera(section: Loose, frame_from_camera: Rigid) -> CameraModel:
    for key in ("camera_model", "intrinsics", "distortion_model", "resolution"):
        section.need(key)
    if section.values["camera_model"] != "pinhole":
        raise section.bad(
            "camera_model", f"{kind_of(section.values['camera_model'])}; only 'pinhole' is read"
        )
    lens, counts = _LENSES[section.choice("distortion_model", tuple(_LENSES))]
    distortion = section.numbers(section.need("distortion_coeffs"), counts) if counts != (0,) else np.zeros(0)
    numbers = section.vector("intrinsics", count=4)
    width, height = section.integers("resolution", 2, 1, LARGEST_IMAGE_PX)
    return lens_camera(section, lens, (width, height), matrix_of(numbers), distortion, frame_from_camera)


def format_kalibr(cameras: Mapping[str, CameraModel], frame: str) -> bytes:
    """Return the cameras, all placed in one frame, as a camchain in their order; names go into comments."""
    lines = [f"# T_cn_cnm1 of cam0 maps coordinates in the frame {frame!r}, metres, to cam0's"]
    before = Rigid.identity()
    for at, (name, camera) in enumerate(cameras.items()):
        pose = matrix44(lens_pose(camera).inverse @ before)
        before = lens_pose(camera)
        lines += [
            f"cam{at}:  # {name}",
            "  camera_model: pinhole",
            f"  intrinsics: {row(camera.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]])}",
            f"  distortion_model: {'equidistant' if camera.kind == FISHEYE else 'radtan'}",
            f"  distortion_coeffs: {row(camera.distortion if len(camera.distortion) else np.zeros(4))}",
            f"  resolution: [{camera.size_px[0]}, {camera.size_px[1]}]",
            f"  rostopic: /{name}/image_raw",
            "  T_cn_cnm1:",
            *(f"  - {row(one)}" for one in pose),
        ]
    return ("\n".join(lines) + "\n").encode()


#: Model: family, focal lengths, which of OpenCV's coefficients the file has, and how many OpenCV has.
_MODELS: dict[str, tuple[LensFamily, int, tuple[int, ...], int]] = {
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
    """Return whether the bytes hold a line of a camera as cameras.txt has it."""
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
        camera = _colmap_camera(section, words)
        cameras[name] = as_camera_file(camera, section, CAMERA_FRAME, digest_of(data))
    if not cameras:
        raise BadFile(
            path, "", "holds no camera: a line 'CAMERA_ID MODEL WIDTH HEIGHT PARAMS...' is expected"
        )
    return cameras


def _colmap_camera(section: Loose, words: list[str]) -> CameraModel:
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
    center = np.array(numbers[focals : focals + 2]) - HALF_PX
    matrix = matrix_of(np.array([numbers[0], numbers[focals - 1], *center]))
    return lens_camera(section, lens, (int(words[2]), int(words[3])), matrix, distortion)


def format_colmap(cameras: Mapping[str, CameraModel]) -> bytes:
    """Return the cameras as cameras.txt, numbered from 1 in their order; names go into comments."""
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]; the corner of the first pixel is (0, 0)"]
    for at, (name, camera) in enumerate(cameras.items(), 1):
        count = len(camera.distortion)
        model = (
            "OPENCV_FISHEYE"
            if camera.kind == FISHEYE
            else {0: "PINHOLE", 4: "OPENCV"}.get(count, "FULL_OPENCV")
        )
        distortion = (
            [*camera.distortion, *[0.0] * (8 - count)] if model == "FULL_OPENCV" else camera.distortion
        )
        fx, fy, cx, cy = camera.camera_matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
        numbers = [fx, fy, cx + HALF_PX, cy + HALF_PX, *distortion]
        told = " ".join(repr(float(number)) for number in numbers)
        lines += [f"# {name}", f"{at} {model} {camera.size_px[0]} {camera.size_px[1]} {told}"]
    return ("\n".join(lines) + "\n").encode()
