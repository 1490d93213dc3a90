"""The surface around a pixel as two cameras see it: a plane, what stands off it, and where it ends.

A patch near a rock's edge shows the rock and what lies behind it, and no plane carries both to another view.
So a small window around each of the patch's pixels is searched in the other camera, at inverse ranges before
and behind a plane. Where it fits best says how far off the plane that pixel's surface is. A pixel whose
window fits nowhere shows something else: what lies beyond a step in depth, or is hidden from the other
camera. It does not count.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray
from calib.matching.warp import (
    FARTHEST_M,
    GRAZING,
    Grey,
    Plane,
    PosedImage,
    Relief,
    parallax_px_m,
    quadratic,
    sample,
    square_grid,
    summit,
)

WINDOW_PX = 5
"""Side of the window around each pixel. A larger one puts the edge of what is nearer farther out, and
flattens small stones; a smaller one finds less texture."""
REACH_PX = 6.0
"""So far before and behind the plane a window is searched, pixels of the other camera..."""
STEP_PX = 0.5
"""...in such steps, between which a parabola shows the summit."""
ACROSS_PX = 3.0
"""So far beside the epipolar line the other camera may see the patch: its calibration may be off."""
PASSES = 2
"""So often the plane is fitted to what was seen off it."""
SIGMA_PX = 0.05
"""One sigma of a place along the epipolar line as single windows show it on smooth ground..."""
NEAR_PX = 3
"""...to which what the windows within so many pixels differ by is added: rough, curved, or a step. Where they
differ by no more than that the target lies on the plane, which all of the patch shows better."""


@dataclass(frozen=True, eq=False)
class _Seen:
    """How far off the plane a patch's pixels were seen, along the other camera's epipolar line, pixels."""

    off_px: Grey  # (n, n)
    counts: Grey  # (n, n) which of them belong to the patch
    px_m: float  # pixels there for each 1/m of inverse range
    sigma_px: float  # one sigma of off_px in the middle
    middle: bool  # whether it was seen


def surface_seen(
    own: PosedImage,
    pixel_px: FloatArray,
    partner: PosedImage,
    plane: Plane,
    half_px: int,
    noise_dn: float,
) -> tuple[Plane, Relief] | None:
    """Return the plane that fits the surface around a pixel (2,) of the own image, and what stands off it.

    None where the two images, of one moment, show no common surface. ``plane`` is about where it is: good to
    a pixel or two in the partner's picture. ``half_px`` is half the patch's side, ``noise_dn`` one sigma of
    one picture's grey noise.
    """
    for fits in range(PASSES + 1):
        seen = _off_plane(own, pixel_px, partner, plane, half_px, noise_dn)
        # Fewer pixels show no surface.
        if seen is None or seen.counts.sum() < 30:
            return None
        if fits < PASSES:
            plane = _fitted(own.camera, pixel_px, plane, seen)
    if seen is None or not seen.middle:
        return None
    inverse_m = (seen.off_px / seen.px_m).astype(np.float32)
    return plane, Relief(pixel_px, inverse_m, seen.counts, seen.sigma_px / seen.px_m)


def _off_plane(
    image: PosedImage,
    pixel_px: FloatArray,
    partner: PosedImage,
    plane: Plane,
    half_px: int,
    noise_dn: float,
) -> _Seen | None:
    """Search for the windows of a patch's pixels before and behind a plane."""
    along = parallax_px_m(image.camera, pixel_px, plane, partner.camera)
    px_m = float(np.linalg.norm(along))
    half = half_px + WINDOW_PX // 2
    knots = image.camera.ray(pixel_px + square_grid(1).reshape(9, 2) * half)
    ranges = plane.ranges_m(knots)
    with np.errstate(invalid="ignore", divide="ignore"):
        steps = np.arange(-REACH_PX, REACH_PX + STEP_PX / 2, STEP_PX) / px_m
        inverse = np.maximum(1.0 / ranges + steps[:, None], 1.0 / FARTHEST_M)
        places, valid = partner.camera.project(knots.origins_m + knots.directions / inverse[..., None])
    if not (valid.all() and (ranges > 0).all()):
        return None
    weights = quadratic(half)
    x, y = (
        (weights @ places[..., c].reshape(-1, 3, 3) @ weights.T).astype(np.float32) for c in (0, 1)
    )  # biquadratic through nine knots, each carried exactly
    own = sample(image.image, pixel_px + square_grid(half)).astype(np.float32)

    def seen(k: int, across_px: float) -> Grey:
        aside_x, aside_y = across_px * np.array([-along[1], along[0]]) / px_m
        maps = x[k] + np.float32(aside_x), y[k] + np.float32(aside_y)
        return np.asarray(cv2.remap(partner.image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))

    # Cameras that disagree across the line still see the surface; how far they do is measured by the match.
    middle, tried = len(steps) // 2, np.arange(-ACROSS_PX, ACROSS_PX + STEP_PX / 2, STEP_PX)
    alike = np.array([np.corrcoef(own.ravel(), seen(middle, one).ravel())[0, 1] for one in tried])
    top = int(np.clip(alike.argmax(), 1, len(tried) - 2))
    across_px = float(tried[top] + STEP_PX * summit(*alike[top - 1 : top + 2]))
    others = (seen(k, across_px) for k in range(len(steps)))
    inner = slice(WINDOW_PX // 2, -(WINDOW_PX // 2))
    variance = _spread(own, own)
    scores = np.stack(
        [
            _spread(own, other) / np.sqrt(np.maximum(variance * _spread(other, other), 1e-3))
            for other in others
        ]
    )[:, inner, inner]
    variance = variance[inner, inner]
    # The last of equals: from beyond the farthest range on all steps look at one place.
    best = np.clip(len(steps) - 1 - scores[::-1].argmax(axis=0), 1, len(steps) - 2)
    before, best_score, after = (np.take_along_axis(scores, best[None] + d, 0)[0] for d in (-1, 0, 1))
    off_px = (best + summit(before, best_score, after)) * np.float32(STEP_PX) - np.float32(REACH_PX)
    off_px = np.maximum(off_px, np.float32(px_m * (1.0 / FARTHEST_M - 1.0 / ranges[4])))  # nor beyond it
    within = (best_score >= before) & (best_score >= after)
    # A window must correlate by so much of what noise allows.
    fits = within & (best_score >= 0.6 * variance / (variance + noise_dn**2))
    # The median leaves out what few pixels say by chance.
    kept = cv2.medianBlur(fits.astype(np.uint8), 5)
    # Windows are weighted by texture up to 400: an edge's contrast says no more about the surface beside it.
    weights = (fits & (kept > 0)) * np.maximum(best_score, 0.0) * np.minimum(variance, 400.0)
    # One sigma of the Gaussian that averages neighbouring windows.
    total, smooth = (cv2.GaussianBlur(v, (0, 0), 1.5) for v in (weights, weights * off_px))
    smooth = np.where(total > 1e-3, smooth / np.maximum(total, 1e-6), 0.0)
    # Pixels within 3 of one that is left out are left out too: a window reaches over the edge.
    edge = np.ones((7, 7), np.uint8)
    counts = cv2.erode(kept, edge, borderType=cv2.BORDER_CONSTANT, borderValue=1)
    near = slice(half_px - NEAR_PX, half_px + NEAR_PX + 1)
    differ_px = float(cv2.medianBlur(off_px.astype(np.float32), 3)[near, near].std())
    stands_off = max(0.0, 1.0 - (SIGMA_PX / max(differ_px, 1e-6)) ** 2)  # Stein's share
    smooth[half_px, half_px] *= stands_off
    sigma_px = float(np.hypot(stands_off * SIGMA_PX, differ_px))
    return _Seen(
        smooth.astype(np.float32), counts.astype(np.float32), px_m, sigma_px, bool(kept[half_px, half_px])
    )


def _spread(a: Grey, b: Grey) -> Grey:
    """Covariance (h, w) of two pictures in the window around each pixel."""
    size = (WINDOW_PX, WINDOW_PX)
    a, b = a - a.mean(), b - b.mean()
    means = [cv2.boxFilter(v, -1, size, borderType=cv2.BORDER_REFLECT) for v in (a * b, a, b)]
    return np.asarray(means[0] - means[1] * means[2], dtype=np.float32)


def _fitted(camera: CameraModel, pixel_px: FloatArray, plane: Plane, seen: _Seen) -> Plane:
    """Return the plane that fits what was seen off another one, the nearer to the pixel the better."""
    half = len(seen.counts) // 2
    places = square_grid(half).reshape(-1, 2)
    rows = np.column_stack([np.ones(len(places)), places])
    off_px = seen.off_px.reshape(-1).astype(np.float64)
    near = np.exp(-0.5 * (places**2).sum(axis=1) / (half / 2) ** 2) * seen.counts.reshape(-1)
    robust = np.ones(len(places))
    for _ in range(4):
        weighted = (near * robust)[:, None] * rows
        normal = rows.T @ weighted + np.diag([1e-9, 1e-3, 1e-3])
        terms = np.linalg.solve(normal, weighted.T @ off_px)
        # Pixels farther off the fitted plane than 0.3 px are weighted less.
        robust = 1.0 / (1.0 + ((off_px - rows @ terms) / 0.3) ** 2)
    corners = np.array([[0.0, 0.0], [half / 2, 0.0], [0.0, half / 2]])
    rays = camera.ray(pixel_px + corners)
    inverse = np.maximum(
        1.0 / plane.ranges_m(rays) + (terms[0] + corners @ terms[1:]) / seen.px_m, 1.0 / FARTHEST_M
    )
    points = rays.origins_m + rays.directions / inverse[:, None]
    normal_m = np.cross(points[1] - points[0], points[2] - points[0])
    length = float(np.linalg.norm(normal_m))
    # Far away noise alone slopes a plane so that a part of the patch looks along or past it.
    met = camera.ray(pixel_px + square_grid(1).reshape(9, 2) * half).directions @ normal_m
    if not (met * np.sign(met[4])).min() > GRAZING * length:
        return Plane(points[0], -rays.directions[0])
    return Plane(points[0], normal_m / length)
