"""A mosaic of pictures from one turning head: directions, the surface that is seen, and the cameras' pixels.

A pixel of a mosaic is a direction d (unit, rover axes) from an origin O. The surface that the mosaic is
composed for gives the inverse range ρ along it, 0 at infinity; what the pixel shows is O + d/ρ. A camera at C
sees it along (O - C) ρ + d, which is right at infinity too. Nothing is fitted: each pixel of a mosaic is
exactly one pixel of each camera that sees it, there and back.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import FloatArray, Rigid

Projection = Literal["equirectangular", "cylindrical"]
FARTHEST_M = 1e6
"""Points at infinity are projected from this far along their exact direction, so without a parallax."""
STEEPEST_RAD = math.radians(80.0)
"""Elevation up to which a cylinder reaches."""
BORDER_STEPS = 24
MOST_PX = 30000
"""Longest side of a mosaic: cv2.remap takes up to 32767."""
MOST_AREA_PX = 60_000_000
"""Composing takes some 12 bytes a pixel."""
LEAST_PX_PER_RAD = 60.0


@dataclass(frozen=True)
class MosaicSurface:
    """What a mosaic is composed for.

    ``value_m``: of a ``sphere`` around the origin its radius, of ``ground`` the z of a level plane of the
    rover frame, which is infinity above the horizon; None of ``infinity``.
    """

    kind: Literal["infinity", "sphere", "ground"]
    value_m: float | None = None

    @staticmethod
    def of(text: str) -> MosaicSurface:
        """Return the surface of ``infinity``, ``sphere:R``, ``ground`` or ``ground:Z``. Raises CalibError."""
        kind, _, number = text.partition(":")
        try:
            value = float(number) if number else 0.0
        except ValueError:
            value = math.nan
        if kind == "infinity" and not number:
            return MosaicSurface("infinity")
        if kind == "sphere" and 0.1 <= value <= FARTHEST_M:
            return MosaicSurface("sphere", value)
        if kind == "ground" and abs(value) <= 100.0:
            return MosaicSurface("ground", value)
        raise CalibError(f"surface '{text}' where infinity, sphere:METRES, ground or ground:Z is expected")

    def __str__(self) -> str:
        return self.kind if self.value_m in (None, 0.0) else f"{self.kind}:{self.value_m:g}"

    def inverse_range(self, directions: FloatArray, origin_m: FloatArray) -> FloatArray:
        """Return the inverse range (...), 1/m, along directions (..., 3), rover axes, from an origin."""
        if self.kind == "ground":
            return np.asarray(np.maximum(directions[..., 2], 0.0) / self._depth(origin_m))
        return np.full(directions.shape[:-1], 0.0 if self.value_m is None else 1.0 / self.value_m)

    def seen_along(self, origins_m: FloatArray, rays: FloatArray, origin_m: FloatArray) -> FloatArray:
        """Return the directions (..., 3) from ``origin_m`` to where rays (..., 3), unit, meet the surface."""
        if self.value_m is None:
            return rays
        off = np.asarray(origins_m - origin_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            if self.kind == "sphere":
                along = np.sum(off * rays, axis=-1)
                ranges = -along + np.sqrt(along**2 - np.sum(off * off, axis=-1) + self.value_m**2)
            else:
                down = (self._depth(origin_m) - off[..., 2]) / rays[..., 2]
                ranges = np.where(rays[..., 2] > 0.0, down, np.inf)
        met = np.isfinite(ranges) & (ranges > 0.0)
        toward = np.where(met[..., None], off + np.where(met, ranges, 0.0)[..., None] * rays, rays)
        return np.asarray(toward / np.linalg.norm(toward, axis=-1, keepdims=True))

    def _depth(self, origin_m: FloatArray) -> float:
        """How far the ground lies below the origin, metres."""
        assert self.value_m is not None
        return max(self.value_m - float(origin_m[2]), 0.05)


@dataclass(frozen=True, eq=False)
class Canvas:
    """A mosaic's pixels as directions.

    Azimuth is positive to the right, elevation up, both in the mosaic's frame, whose axes and origin
    ``rover_from_mosaic`` has. The centre of the top-left pixel lies at ``azimuth_rad``, ``elevation_rad``; a
    cylinder's rows are even in the tangent of the elevation.
    """

    projection: Projection
    px_per_rad: float
    azimuth_rad: float
    elevation_rad: float
    size_px: tuple[int, int]
    rover_from_mosaic: Rigid
    surface: MosaicSurface

    @property
    def origin_m(self) -> FloatArray:
        """The mosaic's origin (3,) in the rover frame."""
        return self.rover_from_mosaic.translation_m

    def directions(self, pixels_px: ArrayLike) -> FloatArray:
        """Return the unit directions (..., 3), rover axes, of pixels (..., 2)."""
        pixels = np.asarray(pixels_px, dtype=np.float64)
        azimuth = self.azimuth_rad + pixels[..., 0] / self.px_per_rad
        if self.projection == "cylindrical":
            rise = math.tan(self.elevation_rad) - pixels[..., 1] / self.px_per_rad
            cosine = 1.0 / np.sqrt(1.0 + rise**2)
            sine = rise * cosine
        else:
            elevation = self.elevation_rad - pixels[..., 1] / self.px_per_rad
            cosine, sine = np.cos(elevation), np.sin(elevation)
        there = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), -sine], axis=-1)
        return self.rover_from_mosaic.vectors(there)

    def pixels(self, directions: ArrayLike) -> FloatArray:
        """Return the pixels (..., 2) of rover-frame directions (..., 3), within half a turn of the middle."""
        local = self.rover_from_mosaic.inverse.vectors(directions)
        level = np.hypot(local[..., 0], local[..., 1])
        turn = 2.0 * math.pi * self.px_per_rad
        x = (np.arctan2(local[..., 1], local[..., 0]) - self.azimuth_rad) * self.px_per_rad
        middle = (self.size_px[0] - 1) / 2.0
        x = x - turn * np.round((x - middle) / turn)
        if self.projection == "cylindrical":
            with np.errstate(divide="ignore", invalid="ignore"):
                y = (math.tan(self.elevation_rad) + local[..., 2] / level) * self.px_per_rad
        else:
            y = (self.elevation_rad - np.arctan2(-local[..., 2], level)) * self.px_per_rad
        return np.stack([x, y], axis=-1)

    def points(self, pixels_px: ArrayLike) -> FloatArray:
        """Return the points (..., 3), rover frame, that pixels (..., 2) show, `FARTHEST_M` at most away."""
        directions = self.directions(pixels_px)
        ranges = 1.0 / np.maximum(self.surface.inverse_range(directions, self.origin_m), 1.0 / FARTHEST_M)
        return np.asarray(self.origin_m + ranges[..., None] * directions)

    def in_camera(self, camera: CameraModel, pixels_px: ArrayLike) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return where a camera (in the rover frame) has the mosaic's pixels (..., 2), and which it sees."""
        return self.direction_in_camera(camera, self.directions(pixels_px))

    def direction_in_camera(
        self, camera: CameraModel, directions: FloatArray
    ) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return where a camera (in the rover frame) has what is seen along directions (..., 3)."""
        inverse = self.surface.inverse_range(directions, self.origin_m)
        along = inverse[..., None] * (self.origin_m - camera.C) + directions
        ranges = 1.0 / np.maximum(inverse, 1.0 / FARTHEST_M)
        places, seen = camera.project(camera.C + ranges[..., None] * along)
        return places, np.asarray(seen, dtype=np.bool_)

    def of_camera(self, camera: CameraModel, pixels_px: ArrayLike) -> FloatArray:
        """Return the mosaic's pixels (..., 2) of a camera's pixels (..., 2): the inverse of `in_camera`."""
        rays = camera.ray(np.asarray(pixels_px, dtype=np.float64))
        return self.pixels(self.surface.seen_along(rays.origins_m, rays.directions, self.origin_m))

    def at(self, px_per_rad: float) -> Canvas:
        """Return the same field at another resolution; the top-left pixels have one centre."""
        part = px_per_rad / self.px_per_rad
        width, height = (math.ceil((side - 1) * part) + 1 for side in self.size_px)
        return replace(self, px_per_rad=px_per_rad, size_px=(width, height))


def canvas_of(
    cameras: Sequence[CameraModel],
    rover_from_mosaic: Rigid,
    surface: MosaicSurface,
    projection: Projection = "equirectangular",
    px_per_rad: float | None = None,
) -> Canvas:
    """Return the canvas that holds all that some cameras (in the rover frame) see, at the lens' resolution.

    It is less where a side would have more than 30,000 pixels, or all 60 million. Raises CalibError if
    ``px_per_rad`` is less than 60, or makes it larger than that.
    """
    scale = max(camera.focal_px[0] for camera in cameras) if px_per_rad is None else px_per_rad
    if not scale >= LEAST_PX_PER_RAD:
        raise CalibError(
            f"{scale:g} px per radian where {LEAST_PX_PER_RAD:g} (about 1 px per degree) or more are expected"
        )
    scale = round(scale * math.pi / 2.0) * 2.0 / math.pi  # a whole sphere has 4 n pixels around, 2 n rows
    ahead = [camera.ray(camera.image_center_px).directions for camera in cameras]
    about_rad = _middle_rad(rover_from_mosaic.inverse.vectors(ahead))
    probe = Canvas(projection, scale, about_rad, 0.0, (1, 1), rover_from_mosaic, surface)
    borders = np.concatenate([probe.of_camera(camera, border(camera)) for camera in cameras])
    borders = np.concatenate([borders, _poles(cameras, probe)])
    borders = borders[np.isfinite(borders).all(axis=1)]
    if projection == "cylindrical":
        borders = borders[np.abs(borders[:, 1]) < math.tan(STEEPEST_RAD) * scale]
    # Straight ahead lies between pixels, as in the middle of a whole sphere with an even number of them.
    zero = np.array([-about_rad * scale, 0.0])
    low = np.floor(borders.min(axis=0) - zero - 0.5) + 0.5
    size = np.ceil(borders.max(axis=0) - zero - low).astype(int) + 1
    width, height = min(int(size[0]), int(2.0 * math.pi * scale)), int(size[1])
    most = min(MOST_PX / max(width, height), math.sqrt(MOST_AREA_PX / (width * height)))
    if most < 1.0:
        if px_per_rad is None:
            return canvas_of(cameras, rover_from_mosaic, surface, projection, 0.99 * most * scale)
        raise CalibError(
            f"the mosaic would have {width}x{height} px; at most {most * scale:.0f} px per radian "
            f"({math.radians(most * scale):.1f} px per degree) are expected"
        )
    top = -low[1] / scale
    top = math.atan(top) if projection == "cylindrical" else top
    return replace(probe, azimuth_rad=low[0] / scale, elevation_rad=top, size_px=(width, height))


def _poles(cameras: Sequence[CameraModel], probe: Canvas) -> FloatArray:
    """Pixels (n, 2) of straight up and down where a camera sees it: its border goes all round them."""
    found: list[tuple[float, float]] = []
    for up in (1.0, -1.0):
        direction = probe.rover_from_mosaic.vectors(np.array([0.0, 0.0, -up]))
        for camera in cameras:
            place, seen = probe.direction_in_camera(camera, direction)
            if bool(seen) and camera.holds(place):
                y = -up * probe.px_per_rad * (math.pi / 2.0 if probe.projection == "equirectangular" else 1e9)
                found += [(part * math.pi * probe.px_per_rad, y) for part in (-1.0, 1.0)]
    return np.array(found).reshape(-1, 2)


def border(camera: CameraModel) -> FloatArray:
    """Return pixels (4 n, 2) around a camera's image: its upper, right, lower and left side, n each."""
    width, height = camera.size_px
    part = np.linspace(0.0, 1.0, BORDER_STEPS, endpoint=False)
    x, y, zero = part * (width - 1), part * (height - 1), np.zeros_like(part)
    right, bottom = zero + width - 1.0, zero + height - 1.0
    sides = (x, zero), (right, y), (right - x, bottom), (zero, bottom - y)
    return np.concatenate([np.column_stack(side) for side in sides])


def _middle_rad(directions: FloatArray) -> float:
    """Azimuth opposite the widest gap between directions (n, 3), of equal ones the one behind the most."""
    azimuth = np.sort(np.arctan2(directions[:, 1], directions[:, 0]))
    gaps = np.diff(azimuth, append=azimuth[0] + 2.0 * math.pi)
    cut = azimuth + gaps / 2.0
    return math.remainder(float(cut[np.argmax(gaps - 0.05 * np.cos(cut))]) + math.pi, 2.0 * math.pi)
