"""Cameras as OpenCV, ROS, Kalibr and COLMAP have them: project, ray, and how far the lens reaches.

A point (X, Y, Z) of the camera's frame (x right, y down, z ahead) has the slopes x = X/Z, y = Y/Z, and
ρ² = x² + y².

``pinhole``, the coefficients k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [τx τy]]]] in OpenCV's order:

    r  = (1 + k1 ρ² + k2 ρ⁴ + k3 ρ⁶) / (1 + k4 ρ² + k5 ρ⁴ + k6 ρ⁶)
    x' = x r + 2 p1 x y + p2 (ρ² + 2 x²) + s1 ρ² + s2 ρ⁴
    y' = y r + p1 (ρ² + 2 y²) + 2 p2 x y + s3 ρ² + s4 ρ⁴

then, with τ, the plane of the image turned by τx and τy. ``equidistant``, k1 k2 k3 k4, with θ the angle to z:

    (x', y') = (x, y) θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) / ρ

Then the pixel is (fx x' + cx, fy y' + cy), the centre of the first one (0, 0).
Source: https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html and .../db/d58/group__calib3d__fisheye.html.

The nearest ``plumb_bob`` of a CAHVOR camera has no exact twin of O beside A, nor of a moving entrance; what
is left is told.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.geometry.cahvor import CameraModel, Rays
from calib.geometry.rigid import FloatArray, ReadOnlyArrays, Rigid, frozen_array

LensKind = Literal["pinhole", "equidistant"]
COUNTS: dict[str, tuple[int, ...]] = {"pinhole": (0, 4, 5, 8, 12, 14), "equidistant": (4,)}

_STEEPEST = 40.0
"""The largest slope (tangent of the angle to z) that a ray of a pinhole lens is looked for at."""

_WIDEST_RAD = np.pi / 2 - 1e-6
"""The largest angle of an equidistant lens: all who use it begin with slopes."""

_SAMPLES = 4096
_SETTLED = 1e-13


@dataclass(frozen=True, eq=False)
class OpencvCamera(ReadOnlyArrays):
    """A camera of OpenCV's two families, at its place in a frame.

    Attributes
    ----------
    lens
        ``pinhole`` or ``equidistant``.
    size_px
        (width, height).
    focal_px, center_px
        (2,) fx, fy and cx, cy; the centre of the first pixel is (0, 0).
    distortion
        (n,) in OpenCV's order: 0, 4, 5, 8, 12 or 14 of a pinhole lens, 4 of an equidistant one.
    frame_from_camera
        Where the camera is: from its own axes to the frame that points and rays are told in.

    Raises
    ------
    ValueError
        If the numbers are no camera.
    """

    lens: LensKind
    size_px: tuple[int, int]
    focal_px: FloatArray
    center_px: FloatArray
    distortion: FloatArray
    frame_from_camera: Rigid = field(default_factory=Rigid.identity)
    reach: float = field(init=False)
    """Slope (pinhole) or angle in radians (equidistant) from which on the lens folds: no ray lies beyond."""

    def __post_init__(self) -> None:
        for name, shape in (("focal_px", (2,)), ("center_px", (2,)), ("distortion", (len(self.distortion),))):
            object.__setattr__(self, name, frozen_array(getattr(self, name), shape))
        if len(self.distortion) not in COUNTS[self.lens]:
            expected = ", ".join(map(str, COUNTS[self.lens]))
            raise ValueError(f"{len(self.distortion)} coefficients of a lens where {expected} are expected")
        if not (np.abs(self.focal_px) > 1e-9).all():
            raise ValueError(f"the focal length is {self.focal_px.tolist()} where pixels are expected")
        if len(self.distortion) == 14 and not (np.abs(self.distortion[12:]) < 1.5).all():
            raise ValueError("the image is turned by more than 1.5 rad")
        object.__setattr__(self, "reach", self._reach())

    @property
    def matrix_px(self) -> FloatArray:
        """(3, 3) K: fx, 0, cx; 0, fy, cy; 0, 0, 1."""
        (fx, fy), (cx, cy) = self.focal_px, self.center_px
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    def project(self, points_m: ArrayLike) -> tuple[FloatArray, np.ndarray]:
        """Return pixels (n, 2) of points (n, 3), metres in the frame, and which are valid (n,)."""
        points = self.frame_from_camera.inverse.points(points_m)
        with np.errstate(all="ignore"):
            slopes = points[:, :2] / points[:, 2:]
            rho = np.hypot(slopes[:, 0], slopes[:, 1])
            bent = self._bend(slopes) if self.lens == "pinhole" else slopes * _ratio(self._angle(rho), rho)
            pixels = self.focal_px * bent + self.center_px
            far = rho if self.lens == "pinhole" else np.arctan(rho)
            valid = (points[:, 2] > 0.0) & (far < self.reach) & np.isfinite(pixels).all(axis=1)
        pixels[~valid] = np.nan
        return pixels, valid

    def ray(self, pixels_px: ArrayLike) -> Rays:
        """Return the rays through pixels (n, 2): origins (n, 3), directions (n, 3) and which are valid (n,).

        Pixels that no ray of the lens lands on come out as not-a-number.
        """
        pixels = np.asarray(pixels_px, dtype=np.float64)
        bent = (pixels - self.center_px) / self.focal_px
        with np.errstate(all="ignore"):
            slopes, valid = self._unbend(bent) if self.lens == "pinhole" else self._unbend_angle(bent)
            ahead = np.concatenate([slopes, np.ones((len(slopes), 1))], axis=1)
            ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
            directions = ahead @ self.frame_from_camera.rotation.T
        directions[~valid] = np.nan
        origins = np.where(valid[:, None], self.frame_from_camera.translation_m, np.nan)
        return Rays(origins, directions, valid)

    def _coefficients(self) -> FloatArray:
        """All 14 coefficients, those that are not there zero."""
        return np.concatenate([self.distortion, np.zeros(14 - len(self.distortion))])

    def _bend(self, slopes: NDArray[Any]) -> NDArray[Any]:
        """Slopes (n, 2) after the lens; holds for complex ones too, which carry derivatives."""
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, *tilt = self._coefficients()
        x, y = slopes[:, 0], slopes[:, 1]
        square = x * x + y * y
        radial = _radial(square, (k1, k2, k3), (k4, k5, k6))
        u = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x) + square * (s1 + s2 * square)
        v = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y + square * (s3 + s4 * square)
        if not any(tilt):
            return np.stack([u, v], axis=1)
        turned = np.stack([u, v, np.ones_like(u)], axis=1) @ _tilted(*tilt).T
        return np.asarray(turned[:, :2] / turned[:, 2:])

    def _angle(self, rho: FloatArray) -> FloatArray:
        """Distorted angle of points at slope ``rho``."""
        return _polynomial(np.arctan(rho), self.distortion)

    def _unbend(self, bent: FloatArray) -> tuple[FloatArray, np.ndarray]:
        """Slopes that the lens bends to these, and which exist: Newton, begun by the round part alone."""
        aim = bent
        if len(self.distortion) == 14 and self.distortion[12:].any():
            flat = (
                np.concatenate([bent, np.ones((len(bent), 1))], axis=1)
                @ np.linalg.inv(_tilted(*self.distortion[12:])).T
            )
            aim = flat[:, :2] / flat[:, 2:]
        samples = np.linspace(0.0, min(self.reach, _STEEPEST), _SAMPLES)
        k = self._coefficients()
        bent_samples = samples * _radial(samples * samples, k[[0, 1, 4]], k[5:8])
        far = np.hypot(aim[:, 0], aim[:, 1])
        slopes = aim * _ratio(np.interp(far, bent_samples, samples), far)
        for _ in range(30):
            off = self._bend(slopes) - bent
            rates = np.stack(
                [self._bend(slopes + 1e-30j * np.eye(2)[axis]).imag * 1e30 for axis in (0, 1)], axis=2
            )
            determinant = rates[:, 0, 0] * rates[:, 1, 1] - rates[:, 0, 1] * rates[:, 1, 0]
            step = np.stack(
                [
                    rates[:, 1, 1] * off[:, 0] - rates[:, 0, 1] * off[:, 1],
                    rates[:, 0, 0] * off[:, 1] - rates[:, 1, 0] * off[:, 0],
                ],
                axis=1,
            )
            step /= determinant[:, None]
            slopes = slopes - step
            if not (np.abs(step) > _SETTLED * (1.0 + np.abs(slopes))).any():
                break
        settled = (np.abs(step) <= 1e-9 * (1.0 + np.abs(slopes))).all(axis=1) & (determinant > 0.0)
        return slopes, settled & (np.hypot(slopes[:, 0], slopes[:, 1]) < self.reach)

    def _unbend_angle(self, bent: FloatArray) -> tuple[FloatArray, np.ndarray]:
        """The same for an equidistant lens: Newton on the angle, which grows with the distorted one."""
        far = np.hypot(bent[:, 0], bent[:, 1])
        samples = np.linspace(0.0, self.reach, _SAMPLES)
        bent_samples = _polynomial(samples, self.distortion)
        theta = np.interp(far, bent_samples, samples)
        for _ in range(8):
            rate = _polynomial(theta + 1e-30j, self.distortion).imag * 1e30
            theta = theta - (_polynomial(theta, self.distortion) - far) / rate
        valid = (np.abs(_polynomial(theta, self.distortion) - far) < 1e-9) & (theta < self.reach)
        return bent * _ratio(np.tan(theta), far), valid

    def _reach(self) -> float:
        """First slope or angle where the round part of the lens stops growing."""
        k = self._coefficients()
        if self.lens == "pinhole":
            most, what = _STEEPEST, "slope"
            samples = np.concatenate([np.linspace(0.0, 4.0, _SAMPLES), np.geomspace(4.0, most, 512)[1:]])
            moved = samples + 1e-30j
            rate = (moved * _radial(moved * moved, k[[0, 1, 4]], k[5:8])).imag * 1e30
        else:
            most, what = _WIDEST_RAD, "angle"
            samples = np.linspace(0.0, most, _SAMPLES)
            rate = _polynomial(samples + 1e-30j, self.distortion).imag * 1e30
        bad = np.flatnonzero(~(rate > 0.0))
        if not len(bad):
            return float(most)
        if bad[0] < 2:
            raise ValueError(f"the lens folds at {what} 0: no image can be formed")
        return float(samples[bad[0] - 1])


def _radial(square: NDArray[Any], above: Any, below: Any) -> NDArray[Any]:
    """(1 + a ρ² + b ρ⁴ + c ρ⁶) over the same of ``below``."""

    def series(a: float, b: float, c: float) -> NDArray[Any]:
        return np.asarray(1.0 + square * (a + square * (b + square * c)))

    return np.asarray(series(*above) / series(*below))


def _polynomial(theta: NDArray[Any], k: FloatArray) -> NDArray[Any]:
    square = theta * theta
    return np.asarray(theta * (1.0 + square * (k[0] + square * (k[1] + square * (k[2] + square * k[3])))))


def _ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    """above / below as a column, 1 where both are as good as zero."""
    near = below < 1e-12
    return np.where(near, 1.0, above / np.where(near, 1.0, below))[:, None]


def _tilted(tau_x: float, tau_y: float) -> FloatArray:
    """(3, 3): slopes on the plane at right angles to z to slopes on the turned one (OpenCV's matTilt)."""
    cx, sx, cy, sy = np.cos(tau_x), np.sin(tau_x), np.cos(tau_y), np.sin(tau_y)
    turned = np.array([[cy, sy * sx, -sy * cx], [0.0, cx, sx], [sy, -cy * sx, cy * cx]])
    onto = np.array([[turned[2, 2], 0.0, -turned[0, 2]], [0.0, turned[2, 2], -turned[1, 2]], [0.0, 0.0, 1.0]])
    return np.asarray(onto @ turned)


GRID = (25, 19)
"""Columns and rows of the pixels that the two are compared at, from edge to edge."""
EXACT_PX = 1e-9


@dataclass(frozen=True, eq=False)
class PlumbBob(ReadOnlyArrays):
    """A camera as OpenCV has it.

    Attributes
    ----------
    size_px
        (width, height).
    matrix_px
        (3, 3) K: fx, 0, cx; 0, fy, cy; 0, 0, 1.
    distortion
        (5,) k1, k2, p1, p2, k3.
    frame_from_camera
        (3, 3) rotation: columns are the camera's x (right), y (down) and z (along A) in the model's frame.
        Its origin is C.
    rms_px, worst_px
        How far its pixels are from the model's, over the whole image, points far away.
    """

    size_px: tuple[int, int]
    matrix_px: FloatArray
    distortion: FloatArray
    frame_from_camera: FloatArray
    rms_px: float
    worst_px: float

    def project(self, points: FloatArray) -> FloatArray:
        """Return pixels (n, 2) of points (n, 3) in the camera's own frame, any unit of length."""
        return _pixels(_numbers(self.matrix_px, self.distortion), points)


def even_axes(model: CameraModel) -> FloatArray:
    """Return (3, 3): columns are the camera's x, y, z in the model's frame; z along A, x as H and V say."""
    z = model.A
    right = model.H - (model.H @ z) * z
    down = model.V - (model.V @ z) * z
    x = right / np.linalg.norm(right) + np.cross(down / np.linalg.norm(down), z)  # each has half a say
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def nearest_plumb_bob(model: CameraModel) -> PlumbBob:
    """Return the ``plumb_bob`` camera whose pixels come nearest to a model's, over its whole image.

    Raises
    ------
    ValueError
        If fewer than half of the image's pixels have a ray in front of the camera.
    """
    width, height = model.size_px
    columns, rows = np.linspace(0.0, width - 1.0, GRID[0]), np.linspace(0.0, height - 1.0, GRID[1])
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    axes = even_axes(model)
    rays = model.ray(pixels)
    directions = rays.directions @ axes
    seen = rays.valid & (directions[:, 2] > 0.05)
    if np.count_nonzero(seen) < len(pixels) // 2:
        raise ValueError("more than half of the image looks sideways or backwards; plumb_bob cannot say that")
    pixels, directions = pixels[seen], directions[seen]
    focal = list(model.focal_px)
    start = np.array([*focal, model.A @ model.H, model.A @ model.V, 0.0, 0.0, 0.0, 0.0, 0.0])
    scale = np.array([focal[0], focal[1], width, height, 1.0, 1.0, 0.1, 0.1, 1.0])

    def off_px(numbers: FloatArray) -> FloatArray:
        return (_pixels(numbers, directions) - pixels).ravel()

    numbers = start
    if np.abs(off_px(start)).max() > EXACT_PX:
        from scipy.optimize import least_squares  # slow to load, and a camera without a lens needs no fit

        numbers = least_squares(off_px, start, x_scale=scale, method="lm").x
    off = np.linalg.norm(_pixels(numbers, directions) - pixels, axis=1)
    fx, fy, cx, cy = numbers[:4]
    return PlumbBob(
        (width, height),
        frozen_array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], (3, 3)),
        frozen_array(numbers[4:], (5,)),
        frozen_array(axes, (3, 3)),
        float(np.sqrt(np.mean(off**2))),
        float(off.max()),
    )


def _numbers(matrix_px: FloatArray, distortion: FloatArray) -> FloatArray:
    places = [matrix_px[0, 0], matrix_px[1, 1], matrix_px[0, 2], matrix_px[1, 2]]
    return np.array([*places, *distortion])


def _pixels(numbers: FloatArray, points: FloatArray) -> FloatArray:
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = numbers
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    square = x * x + y * y
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    u = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
    v = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([fx * u + cx, fy * v + cy], axis=1)
