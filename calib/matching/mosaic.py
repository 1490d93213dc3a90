"""Pictures composed into a mosaic by their cameras alone, and how far they disagree where they meet.

Each pixel of a mosaic comes from the one picture that has it nearest its middle; nothing is matched and no
seam is hidden. Then patches at the seams are matched: what is measured is where one picture shows what the
other one, its camera and the surface predict. A joint that slipped between two views moves all seams
between them alike, and is found by its size and axis.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import groupby
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, with_config

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.mosaic import Canvas
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.patch import MatchSettings, match_patch
from calib.matching.warp import Grey, Plane, PosedImage, facing_plane, grey, parallax_px_m

Picture = NDArray[np.uint8]
Pictures = Callable[[int], Picture]
"""A camera's picture by its number."""
Owners = NDArray[np.int16]

BLOCK_ROWS = 64
NOBODY = -1
REDUCED = 8
"""Gains and seams are looked for at an eighth of the resolution."""
GREYS = (8.0, 247.0)
"""What is darker or brighter says nothing about a gain."""
PATCHES_A_SEAM = 6
GREYS_KEPT = 32
SEARCH_PX = 16.0
MATCH = MatchSettings(roughness=0.0)
RELIEF_PER_M = 0.5
"""One sigma of what the scene's inverse range may differ from the surface by, for the test of slips."""
Axis = Literal["pan", "tilt"]
Angles = tuple[float, float]
AXES: tuple[Axis, Axis] = ("pan", "tilt")
STEP_RAD = 1e-4
WEAKEST_RAD = 0.05
"""A slip that seams measure with a larger sigma is not looked for."""
AS_YAML = ConfigDict(strict=False)
"""A list of an index is the tuple here."""
LEAST_SLIP_RAD = 5e-4
"""Smaller ones are what good mast files leave: up to 0.3 mrad of the packaged one."""
SLIP_SIGMA = 5.5
"""A slip is larger, or none is named: with 100 views one of 30,000 panoramas has it by chance."""
GROSS_SIGMA = 5.0


def frames_of(canvas: Canvas, cameras: Sequence[CameraModel]) -> tuple[Owners, NDArray[np.float32]]:
    """Return which camera each pixel of a mosaic comes from, (h, w), and where it has it, (h, w, 2).

    The camera with the pixel nearest the middle of its image; `NOBODY` where none images it. A reduced canvas
    first shows which cameras a place may belong to.
    """
    whole = np.ones((1, 1), np.bool_)
    small = canvas.at(canvas.px_per_rad / REDUCED)
    owners, _ = _nearest(small, cameras, [whole] * len(cameras), max(small.size_px))
    near = np.ones((5, 5), np.uint8)
    owned = [cv2.dilate((owners == number).astype(np.uint8), near) > 0 for number in range(len(cameras))]
    return _nearest(canvas, cameras, owned, REDUCED)


def _nearest(
    canvas: Canvas, cameras: Sequence[CameraModel], wanted: Sequence[NDArray[np.bool_]], cell_px: int
) -> tuple[Owners, NDArray[np.float32]]:
    """As `frames_of`; ``wanted``: in which cells of so many pixels each camera is tried."""
    width, height = canvas.size_px
    owners = np.full((height, width), NOBODY, np.int16)
    places = np.zeros((height, width, 2), np.float32)

    def block(top: int) -> None:
        rows = np.arange(top, min(top + BLOCK_ROWS, height))
        cells = np.s_[rows[0] // cell_px : rows[-1] // cell_px + 2]
        directions = canvas.directions(np.stack(np.meshgrid(np.arange(width), rows), axis=-1))
        nearest = np.full((len(rows), width), np.inf, np.float32)
        for number, (camera, mine) in enumerate(zip(cameras, wanted, strict=True)):
            columns = np.flatnonzero(mine[cells].any(axis=0))
            if not len(columns):
                continue
            part = np.s_[:, cell_px * columns[0] : cell_px * (columns[-1] + 1)]
            found, seen = canvas.direction_in_camera(camera, directions[part])
            x, y = found[..., 0], found[..., 1]
            w, h = camera.size_px
            with np.errstate(invalid="ignore"):
                inside = seen & (x >= -0.5) & (x <= w - 0.5) & (y >= -0.5) & (y <= h - 0.5)
                middle = camera.image_center_px
                far = ((x - middle[0]) ** 2 + (y - middle[1]) ** 2).astype(np.float32)
            better = inside & (far < nearest[part])
            nearest[part][better] = far[better]
            owners[rows[0] : rows[-1] + 1][part][better] = number
            places[rows[0] : rows[-1] + 1][part][better] = found[better]

    with ThreadPoolExecutor(2, "mosaic") as pool:
        list(pool.map(block, range(0, height, BLOCK_ROWS)))
    return owners, places


def composed(
    pictures: Pictures, owners: Owners, places: NDArray[np.float32], gains: FloatArray | None = None
) -> Picture:
    """Return the mosaic (h, w) or (h, w, 3) of pictures, each times its gain; black where there is none."""
    mosaic = np.zeros(owners.shape + pictures(0).shape[2:], np.uint8)
    for number in range(int(owners.max()) + 1):
        mine = owners == number
        rows, columns = (np.flatnonzero(mine.any(axis=one)) for one in (1, 0))
        if not len(rows):
            continue
        part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        x, y = (np.ascontiguousarray(places[part][..., one]) for one in (0, 1))
        drawn = cv2.remap(pictures(number), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        if gains is not None:
            drawn = cv2.convertScaleAbs(drawn, alpha=float(gains[number]))
        mosaic[part][mine[part]] = drawn[mine[part]]
    return mosaic


def gains_of(canvas: Canvas, cameras: Sequence[CameraModel], pictures: Pictures) -> FloatArray:
    """Return one factor for each picture (n,) by which overlaps agree in brightness; their mean is 1.

    Least squares of the medians' logarithms, each overlap by the number of its pixels.
    """
    small = canvas.at(canvas.px_per_rad / REDUCED)
    drawn = [_drawn(small, camera, pictures(number)) for number, camera in enumerate(cameras)]
    rows, ratios = [], []
    for i, one in enumerate(drawn):
        for j in range(i + 1, len(drawn)):
            ratio = drawn[j] / one
            both = np.isfinite(ratio)
            if (count := int(both.sum())) < REDUCED**2:
                continue
            row = np.zeros(len(drawn))
            row[[i, j]] = math.sqrt(count), -math.sqrt(count)
            rows.append(row)
            ratios.append(math.sqrt(count) * float(np.median(np.log(ratio[both]))))
    if not rows:
        return np.ones(len(drawn))
    logs = np.linalg.lstsq(np.array(rows), np.array(ratios), rcond=None)[0]
    return np.asarray(np.exp(logs - np.mean(logs)))


@dataclass(frozen=True, eq=False)
class SeamPatch:
    """One patch of a seam between two views, by their numbers.

    ``off_px``: where the second shows it less where the first predicts it, px of the second;
    ``covariance_px2`` of the match; ``parallax_px_m``: how that moves with the inverse range.
    """

    views: tuple[int, int]
    first_px: FloatArray
    second_px: FloatArray
    off_px: FloatArray
    covariance_px2: FloatArray
    parallax_px_m: FloatArray


@with_config(AS_YAML)
@dataclass(frozen=True)
class Slip:
    """A joint that stood beside its reading from a view on: how far, one sigma.

    ``from_view`` 0: in all views, an error of tilt's zero; pan's turns the whole mosaic and shows nowhere.
    """

    axis: Axis
    from_view: int
    size_rad: float
    sigma_rad: float

    sentence: str = ""

    def numbered(self, view: int) -> Slip:
        """Return it with another number of its view, and as a person reads it."""
        where = f"from view {view} on" if self.from_view else "in all views"
        size = f"{1e3 * self.size_rad:+.2f} ± {1e3 * self.sigma_rad:.2f} mrad"
        return replace(
            self, from_view=view, sentence=f"{self.axis} truly stood {size} beside its reading {where}"
        )


@with_config(AS_YAML)
@dataclass(frozen=True)
class SeamError:
    """A seam of two views, or all: rms of dx and dy, px, what the matches explain of it, how many.

    ``across_px``: rms across the parallax, which no relief of the scene moves, with the matches' own.
    """

    rms_px: tuple[float, float]
    sigma_px: tuple[float, float]
    across_px: tuple[float, float]
    count: int
    left_out: int
    views: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Seams:
    """The seams of a mosaic: all patches, the error of each pair of views, and of the whole."""

    patches: tuple[SeamPatch, ...] = ()
    by_views: tuple[SeamError, ...] = ()
    whole: SeamError | None = None


def seams_of(canvas: Canvas, cameras: Sequence[CameraModel], pictures: Pictures) -> Seams:
    """Measure how well pictures agree where they meet, by their cameras (in the rover frame)."""
    greys = lru_cache(GREYS_KEPT)(lambda number: grey(pictures(number)))
    owners, _ = frames_of(canvas.at(canvas.px_per_rad / REDUCED), cameras)
    spots = _seam_spots(owners)
    patches = [
        patch
        for views in sorted(spots)
        for spot in spots[views]
        if (patch := _measured(canvas, cameras, greys, views, spot * REDUCED)) is not None
    ]
    if not patches:
        return Seams()
    by_views = [
        replace(_error_of([*those]), views=views) for views, those in groupby(patches, lambda one: one.views)
    ]
    return Seams(tuple(patches), tuple(by_views), _error_of(patches))


def _error_of(patches: Sequence[SeamPatch]) -> SeamError:
    """The error of some patches, but for those beyond 5 robust sigma of their middle."""
    off = np.array([patch.off_px for patch in patches])
    away = np.abs(off - np.median(off, axis=0))
    kept = (away <= GROSS_SIGMA * np.maximum(1.4826 * np.median(away, axis=0), 0.02)).all(axis=1)
    off, covariances = off[kept], np.array([patch.covariance_px2 for patch in patches])[kept]
    side = np.array([patch.parallax_px_m for patch in patches])[kept][:, ::-1] * (-1.0, 1.0)
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    across = np.sqrt(np.mean(np.einsum("ni,ni->n", side, off) ** 2))
    matched = np.sqrt(np.mean(np.einsum("ni,nij,nj->n", side, covariances, side)))
    x, y = np.sqrt(np.mean(off**2, axis=0)).tolist()
    sx, sy = np.sqrt(np.mean(covariances[:, (0, 1), (0, 1)], axis=0)).tolist()
    return SeamError((x, y), (sx, sy), (float(across), float(matched)), len(off), len(patches) - len(off))


def slip_of(
    rig: Rig,
    camera: str,
    angles_rad: Sequence[tuple[float, float]],
    canvas: Canvas,
    patches: Sequence[SeamPatch],
) -> Slip | None:
    """Return the one slip of a joint that explains seams best, None where it explains too little.

    Relief off the surface moves patches along their parallax, which counts with a variance of its own.
    """
    if not patches:
        return None
    views, off = np.array([patch.views for patch in patches]), np.array([patch.off_px for patch in patches])
    relief = RELIEF_PER_M * np.array([patch.parallax_px_m for patch in patches])
    noise = np.array([patch.covariance_px2 for patch in patches]) + 1e-4 * np.eye(2)
    weight = np.linalg.inv(noise + np.einsum("ni,nj->nij", relief, relief))
    slips: list[Slip | None] = []
    for axis in AXES:
        rates = np.array([_rates(rig, camera, angles_rad, canvas, patch, axis) for patch in patches])
        moved = [np.einsum("nv,nvi->ni", views >= start, rates) for start in range(len(angles_rad))]
        slips += [_fitted(rate, off, weight, axis, start) for start, rate in enumerate(moved)]
    best = max(filter(None, slips), key=lambda one: abs(one.size_rad) / one.sigma_rad, default=None)
    named = best is not None and abs(best.size_rad) > max(LEAST_SLIP_RAD, SLIP_SIGMA * best.sigma_rad)
    return best if named else None


def _fitted(rate: FloatArray, off: FloatArray, weight: FloatArray, axis: Axis, start: int) -> Slip | None:
    """The size of a slip by least squares, gross patches left out; None where seams do not show it."""
    kept = np.ones(len(off), np.bool_)
    size = information = 0.0
    for _ in range(3):
        information = float(np.einsum("ni,nij,nj->", rate[kept], weight[kept], rate[kept]))
        if information < 1.0 / WEAKEST_RAD**2:
            return None
        size = float(np.einsum("ni,nij,nj->", rate[kept], weight[kept], off[kept])) / information
        left = off - size * rate
        square = np.einsum("ni,nij,nj->n", left, weight, left)
        kept = square <= max(GROSS_SIGMA**2, 4.0 * float(np.median(square)))
    scale = max(1.0, float(np.mean(square[kept])) / 2.0)
    return Slip(axis, start, size, math.sqrt(scale / information))


def _rates(
    rig: Rig,
    camera: str,
    angles_rad: Sequence[tuple[float, float]],
    canvas: Canvas,
    patch: SeamPatch,
    axis: Axis,
) -> FloatArray:
    """(2, 2) px/rad: how a patch's offset changes if its first, or second, view truly stood further."""

    def predicted(side: int, step_rad: float) -> FloatArray:
        angles = np.array([angles_rad[view] for view in patch.views])
        angles[side, AXES.index(axis)] += step_rad
        first, second = (rig.camera_in_rover(camera, pan, tilt) for pan, tilt in angles.tolist())
        return canvas.in_camera(second, canvas.of_camera(first, patch.first_px))[0]

    # What is predicted is by angles that are believed: what truly happened is the other way round.
    rates = [(predicted(side, STEP_RAD) - predicted(side, -STEP_RAD)) / (2.0 * STEP_RAD) for side in (0, 1)]
    return np.asarray(rates)


def _measured(
    canvas: Canvas, cameras: Sequence[CameraModel], greys: Callable[[int], Grey], views: tuple[int, int],
    place: FloatArray,
) -> SeamPatch | None:  # fmt: skip
    """Match the patch at a mosaic's pixel between two views; None where nothing good is found."""
    i, j = views
    (first, seen_first), (second, seen_second) = (canvas.in_camera(cameras[one], place) for one in views)
    if not (bool(seen_first) and bool(seen_second)):
        return None
    point = canvas.points(place)
    try:
        plane = _plane(canvas, cameras[i], first, point)
        found = match_patch(
            PosedImage(greys(i), cameras[i]), first, plane, PosedImage(greys(j), cameras[j]), SEARCH_PX, MATCH
        )
        if found.verdict != "good":
            return None
        parallax = parallax_px_m(cameras[i], first, plane, cameras[j])
    except CalibError:
        return None
    return SeamPatch(
        views, np.asarray(first), np.asarray(second), found.pixel_px - found.predicted_px,
        found.covariance_px2, parallax,
    )  # fmt: skip


def _plane(canvas: Canvas, camera: CameraModel, pixel: FloatArray, point: FloatArray) -> Plane:
    """The surface around a point: the ground where it is not seen too flat, else what faces the camera."""
    sight = point - camera.C
    if canvas.surface.kind == "ground" and sight[2] > 0.05 * float(np.linalg.norm(sight)):
        return Plane(point, np.array([0.0, 0.0, 1.0]))
    return facing_plane(camera, pixel, float(np.linalg.norm(sight)))


def _seam_spots(owners: Owners) -> dict[tuple[int, int], list[FloatArray]]:
    """Places (2,) along each border between two owners, evenly spread."""
    found: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for (dy, dx), (one, other) in {
        (0, 1): (owners[:, :-1], owners[:, 1:]),
        (1, 0): (owners[:-1], owners[1:]),
    }.items():
        for y, x in np.argwhere((one != other) & (one != NOBODY) & (other != NOBODY)):
            first, last = sorted((int(one[y, x]), int(other[y, x])))
            found.setdefault((first, last), []).append((2 * x + dx, 2 * y + dy))
    spots = {}
    for pair, places in found.items():
        ordered = np.array(sorted(places)) / 2.0
        if np.ptp(ordered[:, 1]) > np.ptp(ordered[:, 0]):
            ordered = ordered[np.argsort(ordered[:, 1], kind="stable")]
        count = min(PATCHES_A_SEAM, len(ordered))
        spots[pair] = list(ordered[((np.arange(count) + 0.5) * len(ordered) / count).astype(int)])
    return spots


def _drawn(canvas: Canvas, camera: CameraModel, picture: Picture) -> FloatArray:
    """A picture alone on a canvas, blurred to its pixels; not-a-number beside it and beyond `GREYS`."""
    blurred = cv2.blur(grey(picture), (REDUCED, REDUCED))
    grid = np.stack(np.meshgrid(*(np.arange(side) for side in canvas.size_px)), axis=-1).astype(np.float64)
    found, seen = canvas.in_camera(camera, grid)
    x, y = (np.where(seen, found[..., one], -1e4).astype(np.float32) for one in (0, 1))
    drawn = cv2.remap(blurred, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=math.nan)
    with np.errstate(invalid="ignore"):
        return np.where((drawn > GREYS[0]) & (drawn < GREYS[1]), drawn, math.nan)
