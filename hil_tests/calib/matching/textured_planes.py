"""Exact pictures of textured planes for the tests of matching: own pinhole, own texture, heavy supersampling.

Nothing here uses the code under test: the camera is rotation, position and focal length; its CAHV vectors are
written down from the definition. Frames as everywhere: x forward, y right, z down.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from calib.geometry.cahvor import CameraModel
from calib.matching.warp import PosedImage


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A pinhole camera looking along azimuth (right) and elevation (up), rolled about its axis."""

    position_m: NDArray[np.float64]
    azimuth_rad: float
    elevation_rad: float
    focal_px: float
    size_px: tuple[int, int]
    roll_rad: float = 0.0

    @property
    def axes(self) -> NDArray[np.float64]:
        """Rows: right, down, forward in the common frame."""
        ca, sa = np.cos(self.azimuth_rad), np.sin(self.azimuth_rad)
        ce, se = np.cos(self.elevation_rad), np.sin(self.elevation_rad)
        forward = np.array([ce * ca, ce * sa, -se])
        right = np.array([-sa, ca, 0.0])
        down = np.cross(forward, right)
        cr, sr = np.cos(self.roll_rad), np.sin(self.roll_rad)
        return np.array([cr * right + sr * down, -sr * right + cr * down, forward])

    @property
    def middle_px(self) -> NDArray[np.float64]:
        return (np.array(self.size_px) - 1) / 2

    @property
    def model(self) -> CameraModel:
        right, down, forward = self.axes
        x, y = self.middle_px
        return CameraModel(
            "CAHV",
            self.size_px,
            self.position_m,
            forward,
            self.focal_px * right + x * forward,
            self.focal_px * down + y * forward,
        )

    def posed(self, image: NDArray[np.float32]) -> PosedImage:
        return PosedImage(image, self.model)

    def pixel(self, point_m: ArrayLike) -> NDArray[np.float64]:
        x, y, z = self.axes @ (np.asarray(point_m) - self.position_m)
        return self.focal_px * np.array([x, y]) / z + self.middle_px

    def rays(self, pixels_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Directions (..., 3), not of unit length."""
        offsets = (pixels_px - self.middle_px) / self.focal_px
        return np.concatenate([offsets, np.ones((*offsets.shape[:-1], 1))], axis=-1) @ self.axes


@dataclass(frozen=True, eq=False)
class TexturedPlane:
    """A plane with a band-limited random texture; ``texel_m`` is the grid on which it is stored."""

    point_m: NDArray[np.float64]
    normal: NDArray[np.float64]
    grey: NDArray[np.float64]
    texel_m: float

    @property
    def basis(self) -> NDArray[np.float64]:
        normal = self.normal / np.linalg.norm(self.normal)
        side = np.cross(normal, [0.0, 0.0, 1.0] if abs(normal[2]) < 0.9 else [0.0, 1.0, 0.0])
        side /= np.linalg.norm(side)
        other = np.cross(normal, side)
        c, s = np.cos(0.4), np.sin(0.4)  # so that the texture's period lies along no epipolar line
        return np.array([c * side + s * other, -s * side + c * other])

    def hit(self, origin_m: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
        reach = ((self.point_m - origin_m) @ self.normal) / (directions @ self.normal)
        return origin_m + reach[..., None] * directions

    def look(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        places = (points_m - self.point_m) @ self.basis.T / self.texel_m
        return ndimage.map_coordinates(self.grey, np.moveaxis(places, -1, 0), order=1, mode="grid-wrap")


@dataclass(frozen=True, eq=False)
class Edge:
    """One plane up to a vertical edge at ``edge_y_m``, and to the right of it what lies behind."""

    near: TexturedPlane
    far: TexturedPlane
    edge_y_m: float

    def hit(self, origin_m: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
        near = self.near.hit(origin_m, directions)
        behind = near[..., 1:2] > self.edge_y_m
        return np.where(behind, self.far.hit(origin_m, directions), near)

    def look(self, points_m: NDArray[np.float64]) -> NDArray[np.float64]:
        off_m = (points_m - self.near.point_m) @ self.near.normal
        return np.where(np.abs(off_m) < 1e-6, self.near.look(points_m), self.far.look(points_m))


def random_texture(
    seed: int, shortest_texels: float = 10.0, size: int = 1024, contrast_dn: float = 25.0
) -> NDArray[np.float64]:
    """A periodic texture of mean 120, wavelengths from ``shortest_texels`` to a quarter of its size."""
    rng = np.random.default_rng(seed)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    keep = (frequency > 4 / size) & (frequency < 1 / shortest_texels)
    weight = np.where(keep, 1 / np.maximum(frequency, 1e-9), 0.0)
    field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) * weight).real
    return 120.0 + contrast_dn * field / field.std()


def picture(
    camera: Pinhole, plane: TexturedPlane | Edge, samples: int = 3, noise_dn: float = 0.0, seed: int = 0
) -> NDArray[np.float32]:
    """The plane as the camera sees it: the mean of ``samples``² exact rays a pixel, noise, no rounding."""
    width, height = camera.size_px
    grid = np.stack(np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float)), axis=-1)
    total = np.zeros((height, width))
    parts = (np.arange(samples) + 0.5) / samples - 0.5
    for dx in parts:
        for dy in parts:
            total += plane.look(plane.hit(camera.position_m, camera.rays(grid + np.array([dx, dy]))))
    noise = np.random.default_rng(seed).normal(scale=noise_dn, size=total.shape) if noise_dn else 0.0
    return (total / samples**2 + noise).astype(np.float32)
