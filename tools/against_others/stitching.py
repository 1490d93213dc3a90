"""A mosaic by known angles beside one by OpenCV's stitching pipeline, of the same pictures in the same run.

    .venv/bin/python -m tools.against_others.stitching [--panorama FOLDER] [--surface ground]

Without a folder of `mastctl panorama take` the pictures are Opportunity's Navcam frames with the models of
their own labels. OpenCV gets SIFT features, its best-of-two matcher, homographies and the bundle adjuster on
rays: it estimates what the mast knows. Both are held against the same matched patches at our seams: rms of
where one picture shows them less where the other and the cameras put them, and across the parallax, which no
relief of the scene moves. Times are processor seconds, of OpenCV without its warping and blending.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.mosaic import Canvas, MosaicSurface, canvas_of
from calib.geometry.rigid import FloatArray, Rigid
from calib.matching.mosaic import Picture, composed, frames_of, gains_of, seams_of
from drivers.recordings.pds3 import read_product
from mastctl.panorama.folder import Folder
from tools.command import end, options, rms, show

MER = Path(__file__).resolve().parents[2] / "hil_tests" / "data" / "mer_navcam"
PRODUCTS = "1N4910*.IMG"
CONFIDENCE = 0.3


def flight_pictures() -> tuple[list[CameraModel], list[Picture]]:
    """Opportunity's five frames as 8 bits, and their label models in the rover frame."""
    products: list[Any] = [read_product(path) for path in sorted(MER.glob(PRODUCTS))]
    pictures = [np.clip(one.image / 16.0, 0, 255).astype(np.uint8) for one in products]  # of 12 bits
    return [one.camera_model for one in products], pictures


def ours(canvas: Canvas, cameras: list[CameraModel], pictures: list[Picture]) -> tuple[dict[str, Any], Any]:
    """Compose and measure; the row of the table, and the seams."""
    began_s = time.process_time()
    owners, places = frames_of(canvas, cameras)
    read = pictures.__getitem__
    composed(read, owners, places, gains_of(canvas, cameras, read))
    took_s = time.process_time() - began_s
    seams = seams_of(canvas, cameras, read)
    off = np.array([patch.off_px for patch in seams.patches])
    return row("known angles", len(pictures), took_s, off, seams.patches), seams


def opencv(pictures: list[Picture], seams: Any) -> dict[str, Any]:
    """Have OpenCV estimate rotations and focal lengths, and hold these against the same patches."""
    began_s = time.process_time()
    cv2.setRNGSeed(1)
    colour = [cv2.cvtColor(one, cv2.COLOR_GRAY2BGR) if one.ndim == 2 else one for one in pictures]
    stitching: Any = cv2
    features = [stitching.detail.computeImageFeatures2(stitching.SIFT_create(), one) for one in colour]
    matches = stitching.detail_BestOf2NearestMatcher(False, CONFIDENCE).apply2(features)
    kept = [
        int(one) for one in np.ravel(stitching.detail.leaveBiggestComponent(features, matches, CONFIDENCE))
    ]
    if len(kept) > 1:
        features = [features[one] for one in kept]
        matches = stitching.detail_BestOf2NearestMatcher(False, CONFIDENCE).apply2(features)
        good, found = stitching.detail_HomographyBasedEstimator().apply(features, matches, None)
        for one in found:
            one.R = one.R.astype(np.float32)
        adjuster = stitching.detail_BundleAdjusterRay()
        adjuster.setConfThresh(CONFIDENCE)
        good, found = adjuster.apply(features, matches, found)
    took_s = time.process_time() - began_s
    if len(kept) < 2 or not good:
        return row("OpenCV's stitching", len(kept), took_s, np.empty((0, 2)), ())
    at = dict(zip(kept, found, strict=True))
    both = [patch for patch in seams.patches if set(patch.views) <= set(at)]
    off = np.array([patch.second_px + patch.off_px - carried(at, patch) for patch in both]).reshape(-1, 2)
    return row("OpenCV's stitching", len(kept), took_s, off, both)


def carried(at: dict[int, Any], patch: Any) -> FloatArray:
    """Where OpenCV's cameras have a patch's first pixel in the second picture."""
    one, other = (at[view] for view in patch.views)
    ray = one.R @ np.linalg.inv(one.K()) @ np.array([*patch.first_px, 1.0])
    seen = other.K() @ other.R.T @ ray
    return np.asarray(seen[:2] / seen[2])


def row(name: str, pictures: int, took_s: float, off: FloatArray, patches: Any) -> dict[str, Any]:
    """A row: rms and median length of the patches' offsets, and rms across the parallax."""
    found: dict[str, Any] = {"by": name, "pictures": pictures, "cpu_s": took_s, "patches": len(off)}
    if len(off):
        along = np.array([patch.parallax_px_m for patch in patches])
        side = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.linalg.norm(along, axis=1, keepdims=True)
        found["rms_px"], found["across_px"] = rms(off), rms(np.sum(side * off, axis=1))
        found["median_px"] = float(np.median(np.linalg.norm(off, axis=1)))
    return found


COLUMNS = {
    "by": "{by}", "pictures": "{pictures}", "CPU s": "{cpu_s:.1f}", "patches": "{patches}",
    "rms, px": "{rms_px:.2f}", "median, px": "{median_px:.2f}", "across, px": "{across_px:.2f}",
}  # fmt: skip


def main() -> int:
    """Compose both ways and print the table."""
    parser = options(__doc__, seed=None, as_json=True, tasks=False)
    parser.add_argument("--panorama", type=Path, help="a panorama's folder (default: Opportunity's frames)")
    parser.add_argument(
        "--surface", default="ground", help="as of 'mastctl panorama compose' (default ground)"
    )
    args = parser.parse_args()
    if args.panorama is None:
        cameras, pictures = flight_pictures()
    else:
        cameras, read = (folder := Folder(args.panorama)).cameras(), folder.pictures()
        pictures = [read(at) for at in range(len(cameras))]
    origin = Rigid(np.eye(3), np.mean([camera.C for camera in cameras], axis=0))
    canvas = canvas_of(cameras, origin, MosaicSurface.of(args.surface))
    known, seams = ours(canvas, cameras, pictures)
    show(args, [known, opencv(pictures, seams)], COLUMNS)
    return 0


if __name__ == "__main__":
    end(main)
