"""A patch of one camera's image as another camera would see it: through a local plane, exactly.

Nothing here assumes a pinhole: destination pixels become rays, rays meet the plane, the points go through the
source camera's own model. All models and planes are in one common frame (usually the rover's), metres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel, Rays
from calib.geometry.rigid import FloatArray, ReadOnlyArrays, frozen_array

Grey = NDArray[np.float32]
Mask = NDArray[np.bool_]

SIDES = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, -1.0], [0.0, 1.0]])  # left, right, top, bottom
FARTHEST_M = 1e4  # as good as infinity for any stereo base on a rover
GRAZING = 0.03  # sine of the flattest view of a plane that is still believed (1.7 degrees)
KNOTS = np.array([-1.0, -1 / 3, 1 / 3, 1.0])  # across a patch, in units of its half side


@dataclass(frozen=True, eq=False)
class Plane(ReadOnlyArrays):
    """A plane through ``point_m`` (3,) with the unit ``normal`` (3,), of either sign."""

    point_m: FloatArray
    normal: FloatArray

    def __post_init__(self) -> None:
        normal = np.asarray(self.normal, dtype=np.float64)
        length = float(np.linalg.norm(normal))
        if not length > 0.0:
            raise CalibError(f"plane normal {normal.tolist()} has no direction")
        object.__setattr__(self, "point_m", frozen_array(self.point_m, (3,)))
        object.__setattr__(self, "normal", frozen_array(normal / length, (3,)))

    def ranges_m(self, rays: Rays) -> FloatArray:
        """Return how far along rays (...) the plane is, metres; below 0 behind, not finite beside it."""
        with np.errstate(invalid="ignore", divide="ignore"):
            ahead: FloatArray = (self.point_m - rays.origins_m) @ self.normal
            return np.asarray(ahead / (rays.directions @ self.normal))

    @cached_property
    def axes(self) -> FloatArray:
        """Two perpendicular unit vectors in the plane, as columns (3, 2)."""
        x, y, z = self.normal.tolist()
        flat = np.array([-y, x, 0.0]) if abs(z) < 0.9 else np.array([0.0, -z, y])
        first = flat / np.linalg.norm(flat)
        return np.stack([first, np.cross(self.normal, first)], axis=1)


def grey(image: ArrayLike) -> Grey:
    """Return an image (h, w) or (h, w, 3) BGR, uint8 or float, as float32 grey (h, w). Raises CalibError."""
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] == 3:
        array = array.astype(np.float32) @ np.array([0.114, 0.587, 0.299], np.float32)
    if array.ndim != 2 or array.size == 0:
        raise CalibError(f"an image of shape {array.shape} where (h, w) or (h, w, 3) is expected")
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise CalibError("an image with values that are not finite")
    return np.ascontiguousarray(array, dtype=np.float32)


def facing_plane(camera: CameraModel, pixel_px: ArrayLike, range_m: float) -> Plane:
    """Return the plane across the ray of ``pixel_px`` (2,), ``range_m`` metres from the ray's origin.

    Raises CalibError if the pixel has no ray or the range is not a finite number above zero.
    """
    rays = camera.ray(np.asarray(pixel_px, dtype=np.float64))
    if not bool(rays.valid) or not 0.0 < range_m < math.inf:
        raise CalibError(f"no plane at range {range_m} m along pixel {np.asarray(pixel_px).tolist()}")
    return Plane(rays.origins_m + range_m * rays.directions, -rays.directions)


def carry(
    pixels_px: ArrayLike, from_camera: CameraModel, plane: Plane, to_camera: CameraModel
) -> tuple[FloatArray, Mask]:
    """Carry pixels (..., 2) of one camera over the plane into another; return which are valid (...) too.

    Rays that miss the plane, meet it behind the camera or at a grazing angle, and points the other camera
    cannot project come out as not-a-number and False.
    """
    rays = from_camera.ray(np.asarray(pixels_px, dtype=np.float64))
    ranges_m = plane.ranges_m(rays)
    with np.errstate(invalid="ignore"):
        hit = rays.valid & (ranges_m > 0.0) & (np.abs(rays.directions @ plane.normal) > GRAZING)
        points = rays.origins_m + np.where(hit, ranges_m, np.nan)[..., None] * rays.directions
    carried, seen = to_camera.project(points)
    return carried, np.asarray(hit & seen, dtype=np.bool_)


@dataclass(frozen=True, eq=False)
class PosedImage:
    """An image (h, w) float32 grey, and its camera at that moment in a frame that images share."""

    image: Grey
    camera: CameraModel


def summit(before: Any, top: Any, after: Any) -> Any:
    """Return how far the summit of a parabola lies from the middle of three scores, in steps, up to half."""
    bend = np.maximum(2.0 * top - before - after, 1e-9)
    return np.clip((after - before) / (2.0 * bend), -0.5, 0.5)


@cache
def quadratic(half: int) -> FloatArray:
    """Weights (2 half + 1, 3) of values at both ends and in the middle of a line of as many pixels."""
    axis = np.linspace(-1.0, 1.0, 2 * half + 1)
    return np.stack([axis * (axis - 1) / 2, 1 - axis * axis, axis * (axis + 1) / 2], axis=1)


def square_grid(half_px: int) -> FloatArray:
    """Return the offsets (n, n, 2) of a square patch with n = 2 half_px + 1, (x, y), centre (0, 0)."""
    return patch_grid((half_px, half_px))


def patch_grid(half_px: tuple[int, int]) -> FloatArray:
    """Return the offsets (2 y + 1, 2 x + 1, 2) of a patch with half sides (x, y), centre (0, 0)."""
    x, y = (np.arange(-half, half + 1, dtype=np.float64) for half in half_px)
    return np.stack(np.meshgrid(x, y), axis=-1)


@dataclass(frozen=True, eq=False)
class Template:
    """A warped patch on the destination's pixel grid: grey values (h, w), h and w odd.

    ``centre_px`` (2,) is the destination's whole pixel on which the middle of the patch lies, ``target_px``
    (2,), within half a pixel, where the plane's geometry puts the target. ``magnification`` is destination
    pixels per source pixel: above 1 the template is blurred against the destination. ``counts`` (h, w) are
    weights of the pixels, 0 to 1; None if all are alike.
    """

    values: Grey
    centre_px: NDArray[np.intp]
    target_px: FloatArray
    magnification: float
    counts: FloatArray | None = None

    @property
    def half_px(self) -> NDArray[np.intp]:
        """(2,), whole pixels from the middle to the right and to the lower side."""
        return np.array(self.values.shape[::-1]) // 2


@dataclass(frozen=True, eq=False)
class Relief:
    """The relief off its plane of the patch around a camera's pixel (2,).

    ``inverse_m`` (n, n), n odd, is by how much the inverse range of each of the camera's pixels there is
    larger than the plane's, 1/m; ``sigma_inverse_m`` one sigma of it at ``pixel_px``. ``counts`` (n, n) is 1
    for pixels that belong to the surface, 0 for others.
    """

    pixel_px: FloatArray
    inverse_m: Grey
    counts: Grey
    sigma_inverse_m: float

    @property
    def half_px(self) -> int:
        """Pixels from the middle to the border."""
        return len(self.counts) // 2

    def at(self, pixels_px: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return ``inverse_m`` and ``counts`` (h, w) at pixels (h, w, 2); 0 beyond what was seen."""
        x, y = np.moveaxis((pixels_px - self.pixel_px + self.half_px).astype(np.float32), -1, 0)
        inverse, counts = (
            cv2.remap(values, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
            for values in (self.inverse_m, self.counts)
        )
        return inverse.astype(np.float64), counts.astype(np.float64)

    def seen_by(self, camera: CameraModel, pixel_px: FloatArray, plane: Plane, own: CameraModel) -> Relief:
        """Return the same around the target's pixel (2,) of a camera that stands nearly where ``own`` did.

        Both pixels show the target; where the cameras' poses say otherwise, the pixels are believed.
        """
        places, _ = carry(pixel_px + square_grid(self.half_px), camera, plane, own)
        places += self.pixel_px - places[self.half_px, self.half_px]
        inverse, counts = self.at(np.nan_to_num(places, nan=-1e6))
        return Relief(pixel_px, inverse.astype(np.float32), counts.astype(np.float32), self.sigma_inverse_m)


def parallax_px_m(camera: CameraModel, pixel_px: FloatArray, plane: Plane, other: CameraModel) -> FloatArray:
    """Return by how much (2,) px another camera sees a pixel's point elsewhere for each 1/m of inverse range.

    The point is where the ray of ``pixel_px`` (2,) of ``camera`` meets the plane.
    """
    ray = camera.ray(pixel_px)
    range_m = float(plane.ranges_m(ray))
    _, rate, _ = other.project_jacobian(ray.origins_m + range_m * ray.directions)
    return np.asarray(-(range_m**2) * (rate @ ray.directions))


def warp_patch(
    source: PosedImage,
    source_px: ArrayLike,
    plane: Plane,
    destination: CameraModel,
    half_px: int | tuple[int, int],
    relief: Relief | None = None,
) -> Template | None:
    """Warp the source's patch around ``source_px`` (2,) over the plane into the destination's pixel grid.

    A destination pixel that covers several source pixels averages them (area sampling), as its sensor would.
    Sixteen knots of the patch are carried exactly, the pixels between them by the cubic through them.

    ``half_px`` is half of the patch's side, or of its sides in x and y, destination pixels; ``relief`` that
    of the source camera around ``source_px``, beside the plane. None if part of the patch is not in the
    source image or not on the plane's visible side.
    """
    target, seen = carry(source_px, source.camera, plane, destination)
    if not bool(seen):
        return None
    half = (half_px, half_px) if isinstance(half_px, int) else half_px
    centre = np.rint(target).astype(np.intp)
    parallax = (
        np.zeros(2) if relief is None else parallax_px_m(source.camera, relief.pixel_px, plane, destination)
    )
    if relief is not None:
        target = target + parallax * float(relief.inverse_m[relief.half_px, relief.half_px])
    reach = np.array(half) + 0.5  # to the outer pixels' far sides
    knots, ok = carry(
        centre + reach * np.stack(np.meshgrid(KNOTS, KNOTS), axis=-1), destination, plane, source.camera
    )
    if not ok.all() or not _inside(knots, source.image.shape):
        return None
    across, down = (np.linalg.norm(np.diff(knots, axis=a), axis=-1).max() for a in (1, 0))
    steps = np.array([across, down]) / (reach * (KNOTS[1] - KNOTS[0]))  # source pixels a destination pixel
    # 8: per axis and destination pixel; shrinking further than 8 times is not needed.
    many, tall = (int(n) for n in np.clip(np.ceil(steps - 0.25), 1, 8))
    columns, rows = _cubic(half[0], many), _cubic(half[1], tall)
    maps = np.stack([rows @ knots[..., axis] @ columns.T for axis in (0, 1)], axis=-1)
    span = np.stack([(knots[:, -1] - knots[:, 0]).mean(axis=0), (knots[-1] - knots[0]).mean(axis=0)], axis=-1)
    counts = None
    if relief is not None:
        maps, counts = _lifted(maps, relief, span / (2.0 * reach) @ parallax)
        counts = counts.reshape(2 * half[1] + 1, tall, 2 * half[0] + 1, many).mean(axis=(1, 3))
    values = sample(source.image, maps)
    if many > 1 or tall > 1:
        values = values.reshape(2 * half[1] + 1, tall, 2 * half[0] + 1, many).mean(axis=(1, 3))
    shrink = float(np.sqrt(max(abs(np.linalg.det(span / (2.0 * reach))), 1e-6)))
    return Template(values.astype(np.float32), centre, target, 1.0 / shrink, counts)


def _lifted(maps: FloatArray, relief: Relief, shift_px_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the source pixels (h, w, 2) that a relief puts where the plane puts ``maps``, and their counts.

    Source pixels that stand off the plane by 1/m are seen ``shift_px_m`` (2,) source pixels elsewhere.
    """
    places = maps
    # 3: a relief changes slowly against the pixels it shifts.
    for _ in range(3):
        places = maps - relief.at(places)[0][..., None] * shift_px_m
    return places, relief.at(places)[1]


@cache
def _cubic(half: int, samples: int) -> FloatArray:
    """Weights ((2 half + 1) samples, 4) of the knots at the samples of a patch's pixels along one axis."""
    parts = (np.arange(samples) + 0.5) / samples - 0.5
    places = (np.arange(-half, half + 1)[:, None] + parts).reshape(-1) / (half + 0.5)
    others = [np.delete(KNOTS, k) for k in range(len(KNOTS))]
    weights = [
        np.prod((places[:, None] - rest) / (knot - rest), axis=1)
        for knot, rest in zip(KNOTS, others, strict=True)
    ]
    return np.stack(weights, axis=1)


def _inside(maps: FloatArray, shape: tuple[int, ...]) -> bool:
    """Return whether all pixels (..., 2) lie in an image of this shape."""
    x, y = maps[..., 0], maps[..., 1]
    return bool(x.min() >= 0 and y.min() >= 0 and x.max() <= shape[1] - 1 and y.max() <= shape[0] - 1)


@dataclass(frozen=True, eq=False)
class Surface:
    """A cut of an image as a cubic B-spline: smooth grey values at any sub-pixel place in it."""

    coefficients: NDArray[np.float64]
    corner_px: tuple[int, int]

    @classmethod
    def around(cls, image: Grey, low_px: ArrayLike, high_px: ArrayLike, margin_px: int = 0) -> Surface:
        """Return the spline of the image between two corners (x, y), with a margin as far as there is one."""
        from scipy import ndimage  # slow to load, and a daemon that starts does not need it

        # 12: a cubic spline's memory of its border is below 1e-6 after 11 samples.
        reach = 12 + margin_px
        x0, y0 = np.maximum(np.floor(np.asarray(low_px)).astype(int) - reach, 0)
        x1, y1 = np.ceil(np.asarray(high_px)).astype(int) + reach + 1
        cut = image[y0:y1, x0:x1].astype(np.float64)
        return cls(ndimage.spline_filter(cut, order=3, mode="mirror"), (int(x0), int(y0)))

    def at(self, pixels_px: FloatArray) -> NDArray[np.float64]:
        """Return the grey values (...) at pixels (..., 2); mirrored beyond the cut."""
        from scipy import ndimage  # slow to load, and a daemon that starts does not need it

        places = np.stack([pixels_px[..., 1] - self.corner_px[1], pixels_px[..., 0] - self.corner_px[0]])
        values = ndimage.map_coordinates(self.coefficients, places, order=3, mode="mirror", prefilter=False)
        return np.asarray(values, dtype=np.float64)

    def inside(self, pixels_px: FloatArray) -> bool:
        """Return whether all pixels (..., 2) lie in the cut."""
        return _inside(pixels_px - np.asarray(self.corner_px), self.coefficients.shape)


def sample(image: Grey, pixels_px: FloatArray) -> NDArray[np.float64]:
    """Return cubic-spline grey values (...) of the image at pixels (..., 2).

    Not cv2.remap, which rounds places to 1/32 px: a constant shift of up to 0.016 px.
    """
    flat = pixels_px.reshape(-1, 2)
    return Surface.around(image, flat.min(axis=0), flat.max(axis=0)).at(pixels_px)


def blurred_to(image: Grey, magnification: float) -> Grey:
    """Return the image blurred as one that was enlarged ``magnification`` times would be; itself up to 1.2.

    An enlarged source pixel is a box of that width; a Gaussian of the box's standard deviation, less the
    destination's own pixel, comes near enough for correlation and is symmetric, so it moves nothing.
    """
    if magnification <= 1.2:
        return image
    sigma = float(np.sqrt((magnification**2 - 1.0) / 12.0))
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), dtype=np.float32)
