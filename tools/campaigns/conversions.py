"""Cameras to other programs' formats and back: what a conversion states it costs, and what it does cost.

    .venv/bin/python -m tools.campaigns.conversions configs/masts/rocky8_simulated.yaml
    .venv/bin/python -m tools.campaigns.conversions --vectors ../shared/data/cahvor_vectors

Each camera is written in every format. *Stated* is the worst error that the conversion tells, *OpenCV's* the
worst of pixels that cv2 makes of the written numbers, at 61 x 47 rays of the camera none of which the
conversion looked at (not for mrcal, of which no copy is here), *back* the worst error of what is then read
from the file against the camera that was written. Pixels of an image with no ray are left out.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

from calib.errors import BadFile
from calib.files import CameraFile
from calib.files.any_camera import load_any, save_any
from calib.files.mast_file import load_rig
from calib.files.twin import twin_error
from calib.files.yaml_text import parse_mapping
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray
from tools.command import end, options

FORMATS = {"opencv": "yaml", "ros": "yaml", "kalibr": "yaml", "mrcal": "cameramodel"}
GRID = (61, 47)
FAR_M = 100.0
NO_LIMIT_PX = 1e4


def main() -> int:
    """Print a row for each camera and format."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("masts", nargs="*", type=Path, metavar="MAST.yaml", help="whose cameras")
    parser.add_argument("--vectors", type=Path, metavar="DIR", help="reference models as JSON files")
    args = parser.parse_args()
    if not args.masts and args.vectors is None:
        parser.error("a mast file or --vectors is expected")
    print(f"{'camera':28s} {'format':7s} {'lens':20s} {'stated':>9s} {'OpenCV':>9s} {'back':>9s}  px")
    for name, model in _cameras(args):
        for format in FORMATS:
            print(f"{name:28s} {format:7s} {_row(model, format)}", flush=True)
    return 0


def _cameras(args: argparse.Namespace) -> Iterator[tuple[str, CameraModel]]:
    for path in args.masts:
        for name, camera in load_rig(path).rig.cameras.items():
            yield name, camera.model
    for path in sorted(args.vectors.glob("vectors_*.json")) if args.vectors else ():
        told = json.loads(path.read_text())["model"]
        vectors = {letter: np.array(told[letter], dtype=float) for letter in "CAHVORE" if letter in told}
        for axis in "AO":
            vectors[axis] = vectors[axis] / np.linalg.norm(vectors[axis])
        general = {}
        if "E" in vectors:
            general = {"cahvore_type": int(told["T"]), "linearity": float(told["P"])}
        kind = "CAHVORE" if general else "CAHVOR"
        size = (int(told["width"]), int(told["height"]))
        yield path.stem.removeprefix("vectors_"), CameraModel(kind, size, **vectors, **general)


def _row(model: CameraModel, format: str) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"camera.{format}.{FORMATS[format]}"
        try:
            done = save_any(CameraFile(model, "head"), path, format, limit_px=NO_LIMIT_PX)
            read = load_any(path)
        except BadFile as error:
            return f"refused: {error.reason}"
        assert isinstance(read, CameraFile)
        seen = "" if format == "mrcal" else f"{_by_opencv(model, path, format):9.4f}"
        back = np.nan
        if format in ("opencv", "kalibr", "mrcal"):  # a camera_info holds no pose
            back = twin_error(model, read.model, model.moving).worst_px
        return f"{done.lens[0]:20s} {done.worst_px:9.4f} {seen:>9s} {back:9.4f}"


def _by_opencv(model: CameraModel, path: Path, format: str) -> float:
    """Worst distance of cv2's pixels of points far along the camera's rays; the camera's place is the file's
    where it is OpenCV's, else the one that fits best."""
    size = np.array(model.size_px)
    axes = [np.linspace(-0.3, size[axis] - 0.7, GRID[axis]) for axis in (0, 1)]
    pixels = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    rays = model.ray(pixels)
    points = (rays.origins_m + FAR_M * rays.directions)[rays.valid]
    matrix, distortion, fisheye, pose = _numbers(path, format)
    if pose is None:
        pose = _turned(points, model, pixels[rays.valid], matrix, distortion, fisheye)
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    turn, shift = cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3]
    seen = project(points[:, None], turn, shift, matrix, distortion)[0].reshape(-1, 2)
    return float(np.linalg.norm(seen - pixels[rays.valid], axis=1).max())


def _numbers(path: Path, format: str) -> tuple[FloatArray, FloatArray, bool, FloatArray | None]:
    """K (3, 3), coefficients, whether cv2.fisheye's, and camera_from_frame (4, 4) of a file, read apart."""
    if format == "opencv":
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        fisheye = bool(storage.getNode("fisheye_model").real())
        names = ("camera_matrix", "distortion_coefficients", "camera_from_frame")
        matrix, distortion, pose = (storage.getNode(name).mat() for name in names)
        return matrix, distortion, fisheye, pose
    document = parse_mapping(path.read_bytes(), path)
    if format == "ros":
        told = {
            key: np.array(document[key]["data"], dtype=float)
            for key in ("camera_matrix", "distortion_coefficients")
        }  # type: ignore[index]
        fisheye = document["distortion_model"] == "equidistant"
        return told["camera_matrix"].reshape(3, 3), told["distortion_coefficients"], fisheye, None
    camera: dict[str, list[float]] = document["cam0"]  # type: ignore[assignment]
    fx, fy, cx, cy = camera["intrinsics"]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    fisheye = str(camera["distortion_model"]) == "equidistant"
    return matrix, np.array(camera["distortion_coeffs"]), fisheye, None


def _turned(
    points: FloatArray,
    model: CameraModel,
    pixels: FloatArray,
    matrix: FloatArray,
    distortion: FloatArray,
    fisheye: bool,
) -> FloatArray:
    """The pose (4, 4) of a camera of these numbers that sees the points nearest to their pixels."""
    undistort = cv2.fisheye.undistortPoints if fisheye else cv2.undistortPoints
    ahead = undistort(pixels[:, None], matrix, distortion).reshape(-1, 2)
    rays = np.column_stack([ahead, np.ones(len(ahead))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    there = points - model.C
    there /= np.linalg.norm(there, axis=1, keepdims=True)
    u, _, vt = np.linalg.svd(rays.T @ there)
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    start = np.r_[cv2.Rodrigues(rotation)[0].ravel(), -rotation @ model.C]

    def off_px(pose: FloatArray) -> FloatArray:
        seen = project(points[:, None], pose[:3], pose[3:], matrix, distortion)[0].reshape(-1, 2)
        return np.asarray((seen - pixels).ravel())

    found = least_squares(off_px, start, x_scale=np.r_[np.full(3, 1e-3), np.full(3, 1e-2)]).x
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(found[:3])[0], found[3:]
    return pose


if __name__ == "__main__":
    end(main)
