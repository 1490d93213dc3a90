"""A moving head before an open shutter: a smear, and rows that are exposed one after the other.

Row r of a picture is exposed from ``begin_s + r * row_time_s`` on. Its light is the mean over views that the
head's motion puts less than a pixel apart. Drawing each of these would take many times as long as one
picture, so key views are drawn some pixels apart, and the views between are laid out from the nearest key:
the model's own rays through a mesh of pixels, each row's at its own time, meet the scene and are seen again
by the key's camera. What that leaves out is the change of perspective within half the way between two keys.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from drivers.sim.optics.lens import Float32, Float64, between, nodes, pixels_of

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
