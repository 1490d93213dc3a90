"""Carry targets from one picture of Opportunity's Navcam to the next, as the tracker would: what is left.

    .venv/bin/python -m tools.flight.real_handoff hil_tests/data/mer_navcam [--json]

Five left-Navcam frames of one rover pose and five pointings; six ordered pairs overlap. Each frame is taken
as a camera of its own, with the CAHVOR model of its label (computed at the MEASURED joint angles). Targets
are a grid of pixels, every 32, that the other frame should see; nothing is chosen by texture. One eye has no
range, so it is assumed, in two ways:

- level: level ground 1.54 m below the camera (the published height of the Navcams), uncertain by 20 % (one
  sigma); the pointings' cameras stand 7 to 9 cm apart, so 10 % of the range are 0.4 to 1.7 px;
- neighbours: the plane through the eight nearest other targets found in the first way, each at the range that
  its own two pixels tell, uncertain by 3 %. A target's own match never tells its range.

The target then goes through `calib.matching.search.seen_by` with one eye: window by the covariance of the
position, patch warped over the plane, correlation, sub-pixel place, verdict, misfit. Residual: found less
predicted, in x and y, and across the epipolar line, where an unknown range does not reach.

The check that the residual is of the pictures and not of our matcher: OpenCV's ECC with a free affine map
between the raw patches, started up to half a pixel off the prediction. It shares no code with the matcher.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate
from calib.matching.search import TrackSearch, seen_by
from calib.matching.track import KeyPicture, Track, TrackSettings
from calib.matching.warp import Plane, carry
from drivers.clock import ManualClock
from hil_tests.support.rendered_patches import BLUR_PX, GRID_PX, HALF_PX, MARGIN_PX, best_affine
from hil_tests.support.rendered_patches import match as ecc
from tools.command import end, options, show
from tools.flight import mer

PAIRS = ((0, 1), (1, 0), (2, 3), (3, 2), (3, 4), (4, 3))
EVERY_PX = 32
EDGE_PX = HALF_PX + MARGIN_PX + 2
UP = np.array([0.0, 0.0, -1.0])
CAMERA_HEIGHT_M = 1.54
"""Of the Navcams above the plane under the wheels: Maki et al. 2003, doi 10.1029/2003JE002077."""
SETTINGS = TrackSettings(model_px=0.3)
"""What the models of two pointings are wrong by; the tracker's own 0.12 makes most matches misfits."""

RANGE_SIGMA = {"level": 0.2, "neighbours": 0.03}
NEIGHBOURS = 8
APART_PX = 1.0
"""ECC that ends farther from our match than this has found another place, or none."""


@dataclass(frozen=True, eq=False)
class CarriedTarget:
    """One target of one pair, and what became of it.

    Attributes
    ----------
    pixel_px, predicted_px
        (2,) in the first frame, and where the labels' models and the assumed range put it in the second.
    verdict
        Of the match; ``misfit`` for a good match that does not fit the prediction, so that the tracker
        refuses it.
    found_px
        (2,); not-a-number without a good match.
    across_px
        Signed distance of the found pixel from the epipolar line.
    ecc_px
        (2,) where ECC found the target; not-a-number where it did not.
    """

    pixel_px: FloatArray
    predicted_px: FloatArray
    verdict: str
    found_px: FloatArray
    across_px: float
    ecc_px: FloatArray


def views(folder: Path) -> list[mer.FlightView]:
    """Return the five frames as the replay driver gives them, with the labels' own camera models.

    Raises
    ------
    FileNotFoundError
        If the folder does not hold them.
    """
    products = mer.labels(folder)
    if len(products) != 5:
        raise FileNotFoundError(
            f"{folder} holds {len(products)} frames {mer.PRODUCTS}; "
            "the five of Opportunity's Navcam are expected"
        )
    clock = ManualClock(50.0)
    seen = mer.views(mer.replay(folder, clock), clock, mer.rig(mer.fit(products), products))
    by_pan = {
        round(product.azimuth_measured_rad or 0.0, 5): product.camera_model
        for product in products
        if product.camera_model is not None
    }
    return [replace(view, camera=by_pan[round(view.pan_rad, 5)]) for view in seen]


def level_plane(camera: CameraModel) -> Plane:
    """Level ground as far below the camera as the wheels are."""
    return Plane(camera.C - CAMERA_HEIGHT_M * UP, UP)


def targets(first: mer.FlightView, second: mer.FlightView) -> FloatArray:
    """Grid pixels (n, 2) of the first frame that the second sees if the ground is level, or far."""
    width, height = first.camera.size_px
    columns, rows = (
        np.arange(EDGE_PX, width - EDGE_PX, EVERY_PX),
        np.arange(EDGE_PX, height - EDGE_PX, EVERY_PX),
    )
    grid = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
    there, valid = carry(grid, first.camera, level_plane(first.camera), second.camera)
    size = np.array(second.camera.size_px)
    with np.errstate(invalid="ignore"):
        inside = ((there >= EDGE_PX) & (there <= size - 1 - EDGE_PX)).all(axis=1)
    return np.asarray(grid[valid & inside])


def carried(
    first: mer.FlightView,
    second: mer.FlightView,
    pixel_px: FloatArray,
    plane: Plane,
    range_sigma: float,
    seed: int,
) -> CarriedTarget:
    """Hand one target over; the plane tells the range, uncertain by ``range_sigma`` of itself."""
    ray = first.camera.ray(pixel_px)
    range_m = float((plane.point_m - ray.origins_m) @ plane.normal / (ray.directions @ plane.normal))
    point = ray.origins_m + range_m * ray.directions
    along = np.outer(ray.directions, ray.directions)
    covariance = (range_sigma * range_m) ** 2 * along + (1e-5 * range_m) ** 2 * np.eye(3)
    track = Track("tracked", point, covariance, KeyPicture(first, pixel_px, plane.normal))
    look = seen_by(track, {"second": second}, SETTINGS)
    predicted, _ = second.camera.project(point)
    match = look.found["second"]
    good = match.verdict == "good"
    across = mer.across_px(first.camera, pixel_px, second.camera, match.pixel_px) if good else np.nan
    return CarriedTarget(
        pixel_px, np.asarray(predicted), _verdict(look), match.pixel_px, across,
        _by_ecc(first, second, pixel_px, plane, seed) if good else np.full(2, np.nan),
    )  # fmt: skip


def _verdict(look: TrackSearch) -> str:
    verdict = look.found["second"].verdict
    return "misfit" if verdict == "good" and look.track.state == "lost" else verdict


def _by_ecc(
    first: mer.FlightView, second: mer.FlightView, pixel_px: FloatArray, plane: Plane, seed: int
) -> FloatArray:
    """Where ECC finds the raw patch."""
    there, valid = carry(pixel_px + GRID_PX, first.camera, plane, second.camera)
    nowhere = np.full(2, np.nan)
    if not valid.all():
        return nowhere
    images = [cv2.GaussianBlur(view.image, (0, 0), BLUR_PX) for view in (first, second)]
    best = best_affine(GRID_PX, there)
    found = ecc(images[0], images[1], pixel_px.astype(int), best, np.random.default_rng(seed))
    return nowhere if found is None else found


def pair(first: mer.FlightView, second: mer.FlightView) -> dict[str, list[CarriedTarget]]:
    """Hand all targets of a pair over, by both assumptions of the range."""
    pixels = targets(first, second)
    level = [
        carried(first, second, pixel, level_plane(first.camera), RANGE_SIGMA["level"], seed)
        for seed, pixel in enumerate(pixels)
    ]
    points, owners = [], []
    for index, one in enumerate(level):
        if one.verdict == "good":
            try:
                seen = triangulate(first.camera, second.camera, one.pixel_px, one.found_px)
            except CalibError:
                continue
            points.append(seen.position_m)
            owners.append(index)
    refined = []
    for index, pixel in enumerate(pixels):
        plane = _plane_near(first, pixel, [p for p, o in zip(points, owners, strict=True) if o != index],
                            [pixels[o] for o in owners if o != index])  # fmt: skip
        if plane is not None:
            refined.append(carried(first, second, pixel, plane, RANGE_SIGMA["neighbours"], index))
    return {"level": level, "neighbours": refined}


def _plane_near(
    view: mer.FlightView, pixel_px: FloatArray, points: Sequence[FloatArray], pixels: Sequence[FloatArray]
) -> Plane | None:
    """The plane through the points whose pixels are nearest; None if they are too few or it is not ground."""
    if len(points) < NEIGHBOURS:
        return None
    nearest = np.argsort(np.linalg.norm(np.array(pixels) - pixel_px, axis=1))[:NEIGHBOURS]
    around = np.array(points)[nearest]
    middle = np.median(around, axis=0)
    normal = np.linalg.svd(around - around.mean(axis=0))[2][2]
    if abs(normal @ UP) < 0.8:
        normal = UP
    ray = view.camera.ray(pixel_px)
    range_m = float((middle - ray.origins_m) @ normal / (ray.directions @ normal))
    return Plane(middle, normal) if 1.0 < range_m < 100.0 else None


def summary(some: Sequence[CarriedTarget]) -> dict[str, Any]:
    """Sum up: shares of verdicts, residuals of the found, and how far ECC ends from our match."""
    found = [one for one in some if one.verdict in ("good", "misfit")]
    off = np.array([one.found_px - one.predicted_px for one in found]).reshape(-1, 2)
    across = np.array([one.across_px for one in found])
    ecc_off = np.array([one.ecc_px - one.found_px for one in found]).reshape(-1, 2)
    with np.errstate(invalid="ignore"):
        near = np.linalg.norm(ecc_off, axis=1) < APART_PX
    by_ecc = np.array([one.ecc_px - one.predicted_px for one in found]).reshape(-1, 2)[near]
    return {
        "targets": len(some),
        "verdicts": dict(Counter(one.verdict for one in some)),
        "found": len(found),
        "rms_px": np.sqrt((off**2).mean(axis=0)).tolist() if len(off) else None,
        "worst_px": float(np.linalg.norm(off, axis=1).max()) if len(off) else None,
        "across_rms_px": float(np.sqrt((across**2).mean())) if len(off) else None,
        "across_mean_px": float(across.mean()) if len(off) else None,
        "across_worst_px": float(np.abs(across).max()) if len(off) else None,
        "ecc_agrees": int(near.sum()),
        "ecc_apart_median_px": float(np.median(np.linalg.norm(ecc_off[near], axis=1)))
        if near.any()
        else None,
        "ecc_apart_rms_px": np.sqrt((ecc_off[near] ** 2).mean(axis=0)).tolist() if near.any() else None,
        "ecc_residual_rms_px": np.sqrt((by_ecc**2).mean(axis=0)).tolist() if near.any() else None,
    }


COLUMNS = {
    "frames": "{frames}", "range": "{range}", "targets": "{targets}", "found": "{found}",
    "rms x, y px": "{rms_px[0]:.2f}, {rms_px[1]:.2f}", "worst px": "{worst_px:.2f}",
    "across the line: rms, mean, worst px":
        "{across_rms_px:.2f}, {across_mean_px:+.2f}, {across_worst_px:.2f}",
    "ECC agrees": "{ecc_agrees}", "apart: median, rms x, y px":
        "{ecc_apart_median_px:.3f}, {ecc_apart_rms_px[0]:.3f}, {ecc_apart_rms_px[1]:.3f}",
    "its residual x, y px": "{ecc_residual_rms_px[0]:.2f}, {ecc_residual_rms_px[1]:.2f}",
}  # fmt: skip


def main() -> int:
    """Print a row for each pair and assumption."""
    parser = options(__doc__, seed=None, as_json=True, tasks=False)
    parser.add_argument("data", type=Path, help="folder of the frames 1N4910*.IMG")
    arguments = parser.parse_args()
    try:
        frames = views(arguments.data)
    except FileNotFoundError as error:
        parser.error(str(error))
    found = {f"{a + 1} to {b + 1}": pair(frames[a], frames[b]) for a, b in PAIRS}
    found["all"] = {
        assumed: [one for by_range in found.values() for one in by_range[assumed]] for assumed in RANGE_SIGMA
    }
    rows = [
        {"frames": name, "range": assumed, **summary(some)}
        for name, by_range in found.items()
        for assumed, some in by_range.items()
    ]
    for row in rows:
        verdicts = sorted(row["verdicts"].items())
        row["notes"] = [", ".join(f"{verdict} {count}" for verdict, count in verdicts)]
    show(arguments, rows, COLUMNS, "notes")
    return 0


if __name__ == "__main__":
    end(main)
