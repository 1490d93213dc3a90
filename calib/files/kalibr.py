"""Kalibr's camchain: cameras ``cam0``, ``cam1``, ... in YAML, each placed against the one before.

``camera_model: pinhole`` with ``distortion_model`` radtan (k1 k2 p1 p2), equidistant (k1 k2 k3 k4) or none.
``T_cn_cnm1`` (4, 4) maps coordinates in the camera before to this one's; Kalibr gives cam0 none, and then
the chain's frame is ``cam0``. This writer gives cam0 one too, from the frame of its cameras' poses, as
mrcal does. Source: https://github.com/ethz-asl/kalibr/wiki/yaml-formats.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from calib.camera.opencv_camera import LensKind, OpencvCamera
from calib.errors import BadFile
from calib.files import LARGEST_IMAGE_PX, CameraFile, digest_of
from calib.files.other_lens import Loose, as_camera_file, lens_camera, matrix44, pose_of, row
from calib.files.yaml_text import kind_of, parse_mapping
from calib.rigid import Rigid

UNKNOWN_FRAME = "unknown"
_CAMERA = re.compile(r"cam(0|[1-9][0-9]?)")
_LENSES: dict[str, tuple[LensKind, tuple[int, ...]]] = {
    "radtan": ("pinhole", (4,)),
    "equidistant": ("equidistant", (4,)),
    "none": ("pinhole", (0,)),
}
_READ = ("camera_model", "intrinsics", "distortion_model", "distortion_coeffs", "resolution", "T_cn_cnm1")


def looks_like_kalibr(document: Mapping[str, object]) -> bool:
    """Tell whether a YAML file's keys are those of a camchain."""
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
        camera = _camera(section, camera_from_frame.inverse)
        notes = section.unread((*_READ, "cam_overlaps", "rostopic"))
        cameras[name] = as_camera_file(camera, section, frame, digest_of(data), notes)
    return cameras


def _pose(section: Loose) -> Rigid:
    rows = section.values["T_cn_cnm1"]
    if not isinstance(rows, list) or len(rows) != 4:
        raise section.bad("T_cn_cnm1", f"{kind_of(rows)} where four lists of four numbers are expected")
    inner = Loose(section.path, section.place, {f"T_cn_cnm1[{at}]": one for at, one in enumerate(rows)})
    return pose_of(section, "T_cn_cnm1", np.array([inner.vector(key, count=4) for key in inner.values]))


def _camera(section: Loose, frame_from_camera: Rigid) -> OpencvCamera:
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
    return lens_camera(
        section, lens, (width, height), numbers[:2], numbers[2:], distortion, frame_from_camera
    )


def format_kalibr(cameras: Mapping[str, OpencvCamera], frame: str) -> bytes:
    """Return the cameras, all placed in one frame, as a camchain in their order; names go into comments."""
    lines = [f"# T_cn_cnm1 of cam0 maps coordinates in the frame {frame!r}, metres, to cam0's"]
    before = Rigid.identity()
    for at, (name, camera) in enumerate(cameras.items()):
        pose = matrix44(camera.frame_from_camera.inverse @ before)
        before = camera.frame_from_camera
        lines += [
            f"cam{at}:  # {name}",
            "  camera_model: pinhole",
            f"  intrinsics: {row([*camera.focal_px, *camera.center_px])}",
            f"  distortion_model: {'equidistant' if camera.lens == 'equidistant' else 'radtan'}",
            f"  distortion_coeffs: {row(camera.distortion if len(camera.distortion) else np.zeros(4))}",
            f"  resolution: [{camera.size_px[0]}, {camera.size_px[1]}]",
            f"  rostopic: /{name}/image_raw",
            "  T_cn_cnm1:",
            *(f"  - {row(one)}" for one in pose),
        ]
    return ("\n".join(lines) + "\n").encode()
