"""What a lens does to the light on its way: falls off to the corners, throws dust's shadow, focuses once.

Thin lens of focal length f at f-number N, focused at s_f: a point at s makes a disc of diameter
f² / N * |s - s_f| / (s (s_f - f)) on the sensor. Dust on the sensor's window, a gap before the pixels,
throws the shadow of a disc in light that comes from all of the lens, a cone of 1 in N.

Smooth functions of the pixel are known at the nodes of a mesh and bilinear between them.
"""

from __future__ import annotations

import functools
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from drivers.options import DriverOptions

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

MESH_PX = 8
"""Between pixels whose range is computed for defocus, and whose angle is for falloff."""

LEVEL_PX = 0.5
"""Blurs by discs of such steps are made, and mixed between."""

MOST_DISC_PX = 12.0
FAR_M = 1e6


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


class LensSettings(DriverOptions):
    """The ``lens`` of every camera of a simulation."""

    falloff: Annotated[float, Field(ge=0.0, le=8.0)] = 0.0
    """Power of the cosine of a ray's angle to the axis by which it is dimmed: 4 by geometry, 0 for none."""
    f_number: Annotated[float, Field(ge=0.0, le=1e3)] = 0.0
    """Focal length over aperture; 0: a pinhole."""
    focus_m: Annotated[float, Field(ge=0.0, le=1e6)] = 0.0
    """Distance of what is sharp, along the axis; 0: infinitely far."""
    pitch_um: Annotated[float, Field(ge=0.5, le=50.0)] = 12.0
    """From pixel to pixel; with a model's focal length in pixels it makes that in metres."""
    dust: Annotated[int, Field(ge=0, le=500)] = 0
    """Specks on the window."""
    dust_um: Annotated[float, Field(ge=1.0, le=1000.0)] = 60.0
    """Their diameter."""
    dust_gap_um: Annotated[float, Field(ge=0.0, le=10_000.0)] = 1000.0
    """From the window to the pixels."""


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
        x_px, y_px = nodes(width, MESH_PX), nodes(height, MESH_PX)
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
        x_px, y_px = nodes(width, MESH_PX), nodes(height, MESH_PX)
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
