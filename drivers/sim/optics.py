"""Between the scene and the sensor: what a lens does to the light, and a moving head before an open shutter.

The lens dims to the corners, throws dust's shadow, and is focused at one distance. A thin lens of focal
length f at f-number N, focused at s_f, makes of a point at s a disc of diameter
f² / N * |s - s_f| / (s (s_f - f)) on the sensor. Dust on the sensor's window, a gap before the pixels, throws
the shadow of a disc in light that comes from all of the lens, a cone of 1 in N.

Row r of a picture is exposed from ``begin_s + r * row_time_s`` on. Its light is the mean over views that the
head's motion puts less than a pixel apart. Drawing each of these would take many times as long as one
picture, so key views are drawn some pixels apart, and the views between are laid out from the nearest key:
the model's own rays through a mesh of pixels, each row's at its own time, meet the scene and are seen again
by the key's camera. What that leaves out is the change of perspective within half the way between two keys.

Smooth functions of the pixel are known at the nodes of a mesh and bilinear between them.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from drivers.sim.settings import LensSettings

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

LENS_MESH_PX = 8
"""Between pixels whose range is computed for defocus, and whose angle is for falloff."""

LEVEL_PX = 0.5
"""Blurs by discs of such steps are made, and mixed between."""

MOST_DISC_PX = 12.0
FAR_M = 1e6

VIEW_STEP_PX = 0.7
"""Views that make up a smear are no farther apart."""

KEY_STEP_PX = 8.0
MARGIN_PX = 8  # around key views: more than half of that, so that nothing at the edge is missing

STILL_PX = 0.02
"""A view that moves less during the whole picture is drawn as one that rests."""

MESH_PX = 32
PATH_STEPS = 48
SKY_M = 1e5

Draw = Callable[[CameraModel, Rigid, int, tuple[int, int]], Float32]


def nodes(count: int, step_px: int) -> Float64:
    """Return places of nodes along a side of ``count`` pixels, from its first to its last, evenly spread."""
    return np.linspace(0.0, count - 1.0, max(2, -(-(count - 1) // step_px) + 1))


def between(places: Float64, first: int, last: int) -> Float32:
    """Return (last - first, nodes): what the nodes weigh at pixels [first, last), linear between nodes."""
    away = np.abs(np.arange(first, last)[:, None] - places) / (places[1] - places[0])
    return np.asarray(np.clip(1.0 - away, 0.0, None), dtype=np.float32)


def pixels_of(x_px: Float64, y_px: Float64) -> Float64:
    """Return (rows, columns, 2) pixels of a mesh."""
    return np.stack(np.meshgrid(x_px, y_px), axis=-1)


@dataclass(frozen=True)
class SimulatedLens:
    """One camera's lens."""

    settings: LensSettings
    camera: CameraModel
    name: str
    seed: int
    ranges: Callable[[Float64, Float64], Float64]

    @property
    def changes_nothing(self) -> bool:
        """Whether it is a pinhole without falloff or dust."""
        return not (self.settings.falloff or self.settings.f_number or self.settings.dust)

    def through(self, light: Float32, pose: Rigid) -> Float32:
        """Return the light (h, w) on the sensor, of a scene seen sharply from ``pose``."""
        if self.changes_nothing:
            return light
        if self.settings.f_number:
            light = defocused(light, self.discs_px(pose))
        return light * self.transmission

    def discs_px(self, pose: Rigid) -> Float32:
        """Return (h, w) the diameter of the disc that a point of each pixel's range makes, pixels."""
        s = self.settings
        width, height = self.camera.size_px
        x_px, y_px = nodes(width, LENS_MESH_PX), nodes(height, LENS_MESH_PX)
        rays = self.camera.ray(pixels_of(x_px, y_px))
        ranges_m = self.ranges(pose.points(rays.origins_m), pose.vectors(rays.directions))
        depth_m = np.where(np.isfinite(ranges_m), ranges_m * (rays.directions @ self.camera.A), FAR_M)
        focal_m = self.camera.focal_px[0] * s.pitch_um * 1e-6
        focus_m = s.focus_m or FAR_M
        aperture_m = focal_m / s.f_number
        disc_m = aperture_m * focal_m * np.abs(depth_m - focus_m) / (np.abs(depth_m) * (focus_m - focal_m))
        disc_px = np.clip(disc_m / (s.pitch_um * 1e-6), 0.0, MOST_DISC_PX).astype(np.float32)
        return np.asarray(between(y_px, 0, height) @ disc_px @ between(x_px, 0, width).T, dtype=np.float32)

    @cached_property
    def transmission(self) -> Float32:
        """(h, w): the share of the light that falloff and dust let through."""
        width, height = self.camera.size_px
        x_px, y_px = nodes(width, LENS_MESH_PX), nodes(height, LENS_MESH_PX)
        cosine = np.clip(self.camera.ray(pixels_of(x_px, y_px)).directions @ self.camera.A, 0.0, 1.0)
        kept = np.nan_to_num(cosine**self.settings.falloff).astype(np.float32)
        share = between(y_px, 0, height) @ kept @ between(x_px, 0, width).T
        return np.asarray(share * self._dust_shadows(), dtype=np.float32)

    def _dust_shadows(self) -> Float32:
        s = self.settings
        width, height = self.camera.size_px
        share = np.ones((height, width), dtype=np.float32)
        chance = np.random.default_rng([self.seed, zlib.crc32(self.name.encode()), 1])
        cone_px = s.dust_gap_um / (s.f_number or 8.0) / s.pitch_um
        y_px, x_px = np.mgrid[0:height, 0:width]
        for _ in range(s.dust):
            at_x, at_y = chance.uniform(0, width), chance.uniform(0, height)
            speck_px = s.dust_um / s.pitch_um * np.exp(0.5 * chance.standard_normal())
            away_px = np.hypot(x_px - at_x, y_px - at_y)
            share *= (1.0 - shadow(away_px, 0.5 * speck_px, 0.5 * cone_px)).astype(np.float32)
        return share


def shadow(away_px: Float64, speck_px: float, cone_px: float) -> Float64:
    """Return the share of a disc of radius ``cone_px`` that one of radius ``speck_px`` covers."""
    a, b = speck_px, max(cone_px, 0.5)
    d = np.clip(away_px, abs(a - b) + 1e-9, a + b)
    to_a = np.arccos(np.clip((d**2 + a**2 - b**2) / (2 * d * a), -1.0, 1.0))
    to_b = np.arccos(np.clip((d**2 + b**2 - a**2) / (2 * d * b), -1.0, 1.0))
    kite = 0.5 * np.sqrt(np.clip((a + b - d) * (d + a - b) * (d - a + b) * (a + b + d), 0.0, None))
    covered = (a**2 * to_a + b**2 * to_b - kite) / (np.pi * b**2)
    inside = min(1.0, (a / b) ** 2)
    return np.where(away_px <= abs(a - b), inside, np.where(away_px >= a + b, 0.0, covered))


@functools.cache
def disc_kernel(diameter_px: float) -> Float32:
    """Return the kernel of a uniform disc, each pixel by the share of its area that lies inside.

    Shares of pixels are sums over them, which narrows a small disc to nothing and widens a large one: the
    disc taken is the one whose kernel has the second moment of the one wanted, diameter² / 16.
    """
    low, high = 1.0, diameter_px + 1.0
    for _ in range(20):
        middle = 0.5 * (low + high)
        kernel = disc_shares(middle)
        places = np.arange(len(kernel)) - len(kernel) // 2
        if kernel.sum(axis=0) @ places**2 < diameter_px**2 / 16:
            low = middle
        else:
            high = middle
    return np.asarray(disc_shares(high), dtype=np.float32)


def disc_shares(diameter_px: float) -> Float64:
    """Share of each pixel that lies in a disc around the middle one's centre, of the whole disc."""
    radius, fine = 0.5 * diameter_px, 32
    half = int(np.ceil(radius))
    places = (np.arange((2 * half + 1) * fine) + 0.5) / fine - 0.5 - half
    inside = (places[:, None] ** 2 + places**2 <= radius**2).astype(np.float64)
    cells = inside.reshape(2 * half + 1, fine, 2 * half + 1, fine).sum(axis=(1, 3))
    return np.asarray(cells / cells.sum())


def defocused(light: Float32, discs_px: Float32) -> Float32:
    """Return a picture (h, w) with each pixel blurred by a disc of its own diameter (h, w)."""
    levels = discs_px / LEVEL_PX
    first, last = int(np.floor(levels.min())), int(np.ceil(levels.max()))
    out: Float32 = np.zeros_like(light)
    for level in range(first, last + 1):
        weight = np.clip(1.0 - np.abs(levels - level), 0.0, None)
        blurred = (
            light
            if level == 0
            else cv2.filter2D(light, -1, disc_kernel(level * LEVEL_PX), borderType=cv2.BORDER_REPLICATE)
        )
        out += weight * blurred
    return out


class KeyView(NamedTuple):
    """A view that was drawn: where the camera stood, rows [first, last) of the widened picture."""

    pose: Rigid
    first: int
    image: Float32


@dataclass(frozen=True)
class Shutter:
    """One camera's shutter; with a ``row_time_s`` of 0 all rows are exposed at once.

    ``pose(time_s)`` is site_from_mounting_frame. ``draw(camera, pose, samples, rows)`` returns the light of a
    view at least in rows [first, last). ``ranges(origins_m, directions)`` is how far rays go in the site
    frame, metres, not-a-number for sky.
    """

    camera: CameraModel
    row_time_s: float
    pose: Callable[[float], Rigid]
    draw: Draw
    ranges: Callable[[Float64, Float64], Float64]

    @property
    def rolling_s(self) -> float:
        """From the begin of the first row's exposure to that of the last row's."""
        return (self.camera.size_px[1] - 1) * self.row_time_s

    def light(self, begin_s: float, exposure_s: float, samples: int) -> Float32 | None:
        """Return the mean light (h, w) of each row's exposure; None if nothing moves that could be seen.

        The first row's exposure begins at ``begin_s``, each row's lasts ``exposure_s``; the key views have
        ``samples`` rays along a pixel's side.
        """
        times_s, way_px = self._way(begin_s, self.rolling_s + exposure_s)
        if way_px[-1] < STILL_PX:
            return None
        width, height = self.camera.size_px
        x_px, y_px = nodes(width, MESH_PX), nodes(height, MESH_PX)
        ranges_m = self._ranges(pixels_of(x_px, y_px), float(np.interp(0.5 * way_px[-1], way_px, times_s)))
        row_begin_s: Float64 = begin_s + np.arange(height, dtype=np.float64) * self.row_time_s
        count = self._views(times_s, way_px, row_begin_s, exposure_s)
        keys = _Keys(self, times_s, way_px, row_begin_s, exposure_s, samples)
        in_x, total = between(x_px, 0, width), np.zeros((height, width), dtype=np.float32)
        for view in range(count):
            after_s = (view + 0.5) / count * exposure_s
            poses = [self.pose(begin_s + y * self.row_time_s + after_s) for y in y_px]
            owners = keys.owners(row_begin_s + after_s)
            for number in np.unique(owners):
                rows = np.flatnonzero(owners == number)
                first, last = int(rows[0]), int(rows[-1]) + 1
                gap = y_px[1] - y_px[0]
                part = slice(int(first // gap), min(len(y_px), int((last - 1) // gap) + 2))
                key = keys[int(number)]
                places = self._seen_by(key, pixels_of(x_px, y_px[part]), ranges_m[part], poses[part])
                in_y = between(y_px[part], first, last)
                map_x, map_y = (in_y @ places[..., k].astype(np.float32) @ in_x.T for k in (0, 1))
                total[first:last] += cv2.remap(
                    key.image, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE
                )
        return np.asarray(np.clip(total / np.float32(count), np.float32(0), None))

    def _way(self, begin_s: float, length_s: float) -> tuple[Float64, Float64]:
        """Moments of the picture, and how far the fastest of a few pixels has moved until each."""
        width, height = self.camera.size_px
        times_s = begin_s + np.linspace(0.0, length_s, PATH_STEPS + 1)
        pixels = pixels_of(nodes(width, width // 2), nodes(height, height // 2))
        poses = [self.pose(time_s) for time_s in times_s]
        middle = poses[PATH_STEPS // 2]
        rays = self.camera.ray(pixels)
        points_m = middle.points(rays.origins_m + 20.0 * rays.directions)
        seen = np.stack([self.camera.project(pose.inverse.points(points_m))[0] for pose in poses])
        steps = np.nan_to_num(np.linalg.norm(np.diff(seen, axis=0), axis=-1)).max(axis=(1, 2))
        return times_s, np.concatenate([[0.0], np.cumsum(steps)])

    def _views(self, times_s: Float64, way_px: Float64, row_begin_s: Float64, exposure_s: float) -> int:
        """How many views the row with the longest way takes."""
        ways = np.interp(row_begin_s + exposure_s, times_s, way_px) - np.interp(row_begin_s, times_s, way_px)
        return max(1, int(np.ceil(ways.max() / VIEW_STEP_PX)))

    def _ranges(self, pixels: Float64, time_s: float) -> Float64:
        """How far the scene is at pixels (..., 2), metres."""
        pose, rays = self.pose(time_s), self.camera.ray(pixels)
        ranges_m = self.ranges(pose.points(rays.origins_m), pose.vectors(rays.directions))
        return np.where(np.isfinite(ranges_m), ranges_m, SKY_M)

    def _seen_by(self, key: KeyView, pixels: Float64, ranges_m: Float64, poses: list[Rigid]) -> Float64:
        """Where the key's picture shows what pixels (rows, columns, 2) see, a pose a row."""
        rays = self.camera.ray(pixels)
        points_m = rays.origins_m + ranges_m[..., None] * rays.directions
        places = np.empty(pixels.shape)
        for row, pose in enumerate(poses):
            in_key_m = key.pose.inverse.points(pose.points(points_m[row]))
            places[row] = self.camera.project(in_key_m)[0]
        margin = np.array([MARGIN_PX, MARGIN_PX - key.first])
        return np.asarray(np.where(np.isfinite(places), places, pixels) + margin)


@dataclass
class _Keys:
    """The key views of one picture, drawn when first requested."""

    shutter: Shutter
    times_s: Float64
    way_px: Float64
    row_begin_s: Float64
    exposure_s: float
    samples: int
    drawn: dict[int, KeyView] = field(default_factory=dict)

    @property
    def steps(self) -> int:
        """From the first key to the last."""
        return max(1, int(np.ceil(self.way_px[-1] / KEY_STEP_PX)))

    def owners(self, times_s: Float64) -> NDArray[np.int64]:
        """Return the number of the nearest key for moments."""
        parts = np.interp(times_s, self.times_s, self.way_px) / self.way_px[-1]
        return np.asarray(np.rint(parts * self.steps).astype(np.int64))

    def __getitem__(self, number: int) -> KeyView:
        if number not in self.drawn:
            along = number / self.steps * self.way_px[-1]
            pose = self.shutter.pose(float(np.interp(along, self.way_px, self.times_s)))
            ends = [self.owners(self.row_begin_s + part * self.exposure_s) for part in (0.0, 1.0)]
            rows = np.flatnonzero((ends[0] <= number) & (number <= ends[1]))
            first, last = int(rows[0]), int(rows[-1]) + 1 + 2 * MARGIN_PX
            image = self.shutter.draw(widened(self.shutter.camera), pose, self.samples, (first, last))
            self.drawn[number] = KeyView(pose, first, np.ascontiguousarray(image[first:last]))
        return self.drawn[number]


def widened(camera: CameraModel) -> CameraModel:
    """Return a camera that sees ``MARGIN_PX`` more on each side."""
    width, height = camera.size_px
    return replace(
        camera,
        size_px=(width + 2 * MARGIN_PX, height + 2 * MARGIN_PX),
        H=camera.H + MARGIN_PX * camera.A,
        V=camera.V + MARGIN_PX * camera.A,
    )
