"""The nearest camera of another family, and how far it is: measured, not taken from the fit.

Exact twins are CAHVOR with O = A and a pinhole lens with k1 and k2, and a fisheye CAHVORE (type 2) without
E and an equidistant lens with k1 and k2. A lens axis beside A is a turned image (τ) and nearly p1, p2; H
and V that are not at right angles are nearly a turned image too. The moving entrance point of CAHVORE has no
twin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
from scipy.optimize import least_squares

from calib.files.opencv_camera import LensKind, OpencvCamera, even_axes
from calib.geometry.cahvor import CameraModel, Kind, Rays
from calib.geometry.parameters import parameter_names, predict, stepped
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid

FIT_GRID = (25, 19)
"""Columns and rows of the pixels that a twin is fitted at, from corner to corner of the image."""

CHECK_GRID = (38, 31)
"""Columns and rows of those that it is measured at; but for the corners none is among the others."""

RANGES_M = (1.0, 100.0)
"""Where points stand along a ray: at both if the entrance point moves, at the second if it does not."""

EXACT_PX = 1e-6
"""Nearer than this a twin is called exact."""

GOOD_PX = 0.005
"""A twin this near is looked for no further."""

_HELD_PX = 1e-3
"""What a coefficient of 1 costs in a fit: nothing, except where the pixels do not tell it."""

_STEPS = 60
"""How many steps a fit may take."""

_LOST_PX = 1e3
"""What a fit is told of a point that its camera does not see."""


Built = TypeVar("Built", bound="CameraLike")


class CameraLike(Protocol):
    """What two cameras are compared by."""

    @property
    def size_px(self) -> tuple[int, int]: ...

    def project(self, points_m: FloatArray, /) -> tuple[FloatArray, np.ndarray]: ...

    def ray(self, pixels_px: FloatArray, /) -> Rays: ...


@dataclass(frozen=True)
class TwinError:
    """How far one camera is from another over their whole image.

    Attributes
    ----------
    worst_px, rms_px
        Of the distances between pixels, both ways: a ray of the one seen by the other. Infinite where the
        other does not see it.
    worst_at_px
        The pixel where it is worst.
    blind
        Part of the image that has no ray in the first camera; nothing is compared there.
    """

    worst_px: float
    rms_px: float
    worst_at_px: tuple[float, float]
    blind: float


def grid_px(size_px: tuple[int, int], counts: tuple[int, int], margin_px: float = 0.0) -> FloatArray:
    """Return pixels (n, 2) in rows and columns over an image, the outer ones ``margin_px`` outside it."""
    axes = [
        np.linspace(-margin_px, size - 1.0 + margin_px, count)
        for size, count in zip(size_px, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def twin_error(camera: CameraLike, twin: CameraLike, near: bool = False) -> TwinError:
    """Return how far ``twin`` is from ``camera`` (both in one frame), over the image to its outer border.

    Parameters
    ----------
    camera, twin
        Of one size, rays and points in the same frame.
    near
        Whether points 1 m away count too: they do where an entrance point moves.
    """
    pixels = grid_px(camera.size_px, CHECK_GRID, 0.5)
    far, blind = [], 0.0
    for one, other in ((camera, twin), (twin, camera)):
        rays = one.ray(pixels)
        if one is camera:
            blind = float(1.0 - rays.valid.mean())
            compared = rays.valid
        off = np.zeros(len(pixels))
        for range_m in RANGES_M if near else RANGES_M[1:]:
            seen, valid = other.project(rays.origins_m[rays.valid] + range_m * rays.directions[rays.valid])
            moved = np.where(valid, np.linalg.norm(seen - pixels[rays.valid], axis=1), np.inf)
            off[rays.valid] = np.maximum(off[rays.valid], moved)
        off[~rays.valid] = np.inf
        far.append(off[compared])
    if not compared.any():
        return TwinError(np.inf, np.inf, (np.nan, np.nan), 1.0)
    worst = np.maximum(*far)
    at = pixels[compared][int(worst.argmax())]
    return TwinError(
        float(worst.max()), float(np.sqrt(np.mean(worst**2))), (float(at[0]), float(at[1])), blind
    )


def lens_axes(model: CameraModel) -> FloatArray:
    """Return (3, 3): columns are x, y, z in the model's frame; z along O, x and y as H and V say.

    Where H and V are not at right angles, each has half a say.
    """
    z = model.O
    right, down = model.H - (model.H @ z) * z, model.V - (model.V @ z) * z
    x = right / np.linalg.norm(right) + np.cross(down / np.linalg.norm(down), z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def nearest_opencv(model: CameraModel, lens: LensKind, coefficients: Sequence[bool]) -> OpencvCamera:
    """Return the camera of OpenCV's families whose pixels come nearest to a model's, in the model's frame.

    Parameters
    ----------
    model
        The camera, CAHV, CAHVOR or CAHVORE.
    lens
        The family.
    coefficients
        (n,) which coefficients of the lens may be other than zero.

    Raises
    ------
    ValueError
        If fewer than half of the image's pixels have a ray that such a lens can have.
    """
    pixels, points = _what_it_sees(model)
    axes = lens_axes(model)
    free = np.flatnonzero(coefficients)
    moving = model.lens.moving
    focal = np.array([model.H @ axes[:, 0], model.V @ axes[:, 1]]) * (1.0 + model.R[0]) / (model.A @ model.O)
    center = np.array([model.H @ model.O, model.V @ model.O]) / (model.A @ model.O)
    distortion = np.zeros(len(coefficients))
    if len(distortion) >= 2 and lens == ("equidistant" if model.cahvore_type == 2 else "pinhole"):
        distortion[:2] = model.R[1:] / (1.0 + model.R[0])
    start = np.concatenate([np.zeros(6 if moving else 3), focal, center, distortion[free]])
    scale = np.concatenate([np.full(3, 0.01), np.full(3 if moving else 0, 0.001), np.full(4, 10.0)])
    scale = np.concatenate([scale, np.where((free == 2) | (free == 3) | (free > 7), 0.01, 0.1)])
    if lens == "equidistant":
        scale[-len(free) :] = 0.1
    place = Rigid(axes, model.C)

    def build(numbers: FloatArray) -> OpencvCamera:
        pose, inner = (numbers[:6], numbers[6:]) if moving else (np.r_[numbers[:3], 0, 0, 0], numbers[3:])
        told = np.zeros(len(coefficients))
        told[free] = inner[4:]
        return OpencvCamera(lens, model.size_px, inner[:2], inner[2:4], told, moved_rigid(place, pose))

    return _fitted(build, start, scale, pixels, points, np.arange(len(start)) >= len(start) - len(free))


def nearest_tilted(model: CameraModel) -> OpencvCamera:
    """Return the pinhole camera with a turned image plane (OpenCV's 14 coefficients) that comes nearest.

    A plane turned about both axes and a camera turned back leave a picture that leans by the product of both
    turns: so OpenCV holds H and V that are not at right angles. Free are k1, k2, k3, p1, p2 and both turns.

    Raises
    ------
    ValueError
        As ``nearest_opencv``; and if the entrance point moves.
    """
    if model.lens.moving:
        raise ValueError("the entrance point moves")
    plain = nearest_opencv(model, "pinhole", [True] * 5)
    pixels, points = _what_it_sees(model)
    across, down = (vector - (vector @ model.A) * model.A for vector in (model.H, model.V))
    lean = float(across @ down / np.linalg.norm(across) / np.linalg.norm(down))
    # From no turn at all no fit begins: what a turn does to the lean grows as its square.
    turn = max(np.sqrt(abs(lean)), 1e-3)
    scale = np.concatenate([np.full(3, 0.01), np.full(4, 10.0), [0.1, 0.1, 0.01, 0.01, 0.1, 0.01, 0.01]])

    def build(numbers: FloatArray) -> OpencvCamera:
        told = np.concatenate([numbers[7:12], np.zeros(7), numbers[12:]])
        place = moved_rigid(plain.frame_from_camera, np.r_[numbers[:3], 0.0, 0.0, 0.0])
        return OpencvCamera("pinhole", model.size_px, numbers[3:5], numbers[5:7], told, place)

    found = []
    for sign in (1.0, -1.0):
        inner = [plain.focal_px, plain.center_px, plain.distortion, [turn, sign * turn]]
        start = np.concatenate([np.zeros(3), *inner])
        found.append(_fitted(build, start, scale, pixels, points, np.arange(len(start)) > 6))
    return min(found, key=lambda camera: twin_error(model, camera).worst_px)


def nearest_cahvor(camera: OpencvCamera) -> CameraModel:
    """Return the camera of the CAHV family whose pixels come nearest to another's, in the same frame.

    CAHV without distortion; CAHVOR of a pinhole lens, or CAHVORE of type 3 without E where that comes nearer;
    CAHVORE of type 2 of an equidistant one, or type 3.

    Raises
    ------
    ValueError
        If fewer than half of the image's pixels have a ray.
    """
    pixels, points = _what_it_sees(camera)
    axes = camera.frame_from_camera.rotation
    focal, center = camera.focal_px, camera.center_px
    vectors = {
        "C": camera.frame_from_camera.translation_m,
        "A": axes[:, 2],
        "H": focal[0] * axes[:, 0] + center[0] * axes[:, 2],
        "V": focal[1] * axes[:, 1] + center[1] * axes[:, 2],
    }
    if not camera.distortion.any() and camera.lens == "pinhole":
        return CameraModel("CAHV", camera.size_px, **vectors)
    r = np.array([0.0, *camera.distortion[:2]])
    tries: list[tuple[Kind, int]] = [("CAHVOR", 0), ("CAHVORE", 3)]
    if camera.lens == "equidistant":
        tries = [("CAHVORE", 2), ("CAHVORE", 3)]
    best: tuple[float, CameraModel] | None = None
    for kind, cahvore_type in tries:
        linearity = 1.0 if camera.lens == "pinhole" else 0.0
        start = CameraModel(
            kind, camera.size_px, **vectors, O=axes[:, 2], R=r, cahvore_type=cahvore_type, linearity=linearity
        )
        found = _fitted_cahvor(start, pixels, points)
        worst_px = twin_error(camera, found).worst_px
        if best is None or worst_px < 0.5 * best[0]:
            best = worst_px, found
        if worst_px < GOOD_PX:
            break
    assert best is not None
    return best[1]


def nearest_square(model: CameraModel) -> CameraModel:
    """Return the camera of the same kind, H and V at right angles, whose pixels come nearest to a model's.

    E, R0 and linearity stay what they are.
    """
    pixels, points = _what_it_sees(model)
    place = Rigid(even_axes(model), model.C)
    start = np.zeros(7 if model.kind == "CAHV" else 11)
    start[3:7] = (
        model.H @ place.rotation[:, 0],
        model.V @ place.rotation[:, 1],
        model.H @ model.A,
        model.V @ model.A,
    )
    scale = np.concatenate([np.full(3, 0.001), np.full(4, 10.0), np.full(len(start) - 7, 0.01)])

    def build(numbers: FloatArray) -> CameraModel:
        x, y, z = moved_rigid(place, np.r_[numbers[:3], 0.0, 0.0, 0.0]).rotation.T
        fx, fy, cx, cy, *lens = numbers[3:].tolist()
        told = {"A": z, "H": fx * x + cx * z, "V": fy * y + cy * z, "O": None}
        if lens:
            axis = model.O + lens[0] * x + lens[1] * y
            told |= {"O": axis / np.linalg.norm(axis), "R": model.R + np.array([0.0, *lens[2:]])}
        return replace(model, **told)

    return _fitted(build, start, scale, pixels, points)


def _fitted(
    build: Callable[[FloatArray], Built],
    start: FloatArray,
    scale: FloatArray,
    pixels: FloatArray,
    points: FloatArray,
    lens: np.ndarray | None = None,
) -> Built:
    """The camera whose pixels of the points come nearest, least squares from ``start``.

    ``lens`` says which numbers are coefficients of a lens: what pixels cannot tell of them stays small.
    """
    held = np.zeros(len(start), dtype=bool) if lens is None else lens

    def off_px(numbers: FloatArray) -> FloatArray:
        small = _HELD_PX * numbers[held]
        try:
            seen, valid = build(numbers).project(points)
        except ValueError:
            return np.concatenate([np.full(2 * len(pixels), _LOST_PX), small])
        return np.concatenate([np.where(valid[:, None], seen - pixels, _LOST_PX).ravel(), small])

    if np.abs(off_px(start)[: 2 * len(pixels)]).max() < EXACT_PX:
        return build(start)
    found = least_squares(
        off_px, start, x_scale=scale, method="lm", xtol=1e-12, ftol=1e-12, max_nfev=_STEPS * len(start)
    )
    return build(found.x)


def _fitted_cahvor(start: CameraModel, pixels: FloatArray, points: FloatArray) -> CameraModel:
    """The camera of the kind of ``start`` that comes nearest; C stays, and E, which is zero.

    Levenberg and Marquardt's steps, each about the camera that the last one led to.
    """
    names = parameter_names(start.kind)
    free = [at for at, name in enumerate(names) if name[0] not in "CE"]
    general = start.cahvore_type == 3
    camera, damping = start, 1e-6
    off, rates = _off_and_rates(camera, pixels, points, free, general)
    for _ in range(_STEPS):
        scale = np.maximum(np.linalg.norm(rates, axis=0), 1e-30)
        normal = rates.T @ rates / np.outer(scale, scale)
        step = -np.linalg.solve(normal + damping * np.eye(len(scale)), rates.T @ off / scale) / scale
        told = np.zeros(len(names))
        told[free] = step[: len(free)]
        try:
            moved = stepped(camera, told)
            if general:
                moved = replace(moved, linearity=moved.linearity + float(step[-1]))
            moved_off, moved_rates = _off_and_rates(moved, pixels, points, free, general)
        except ValueError:  # the step led to no camera
            moved_off = np.full(1, np.inf)
        if not moved_off @ moved_off < off @ off:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        settled = moved_off @ moved_off > (1.0 - 1e-6) * (off @ off)
        camera, off, rates, damping = moved, moved_off, moved_rates, max(0.1 * damping, 1e-12)
        if settled or np.abs(off).max() < EXACT_PX * 1e-3:
            break
    return camera


def _off_and_rates(
    camera: CameraModel, pixels: FloatArray, points: FloatArray, free: Sequence[int], general: bool
) -> tuple[FloatArray, FloatArray]:
    """Pixels off (2n,) and their rates (2n, p) by the free parameters, and by the linearity if it is one."""
    seen = predict(camera, points)
    off = np.where(seen.valid[:, None], seen.pixels_px - pixels, _LOST_PX).ravel()
    rates = np.nan_to_num(seen.d_step[..., free]).reshape(len(off), -1)
    if general:
        bit = 1e-6
        other = replace(camera, linearity=camera.linearity + bit).project(points)[0]
        rates = np.column_stack([rates, np.nan_to_num((other - seen.pixels_px) / bit).ravel()])
    return off, rates


def _what_it_sees(camera: CameraLike) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) over the image and points (n, 3) seen there, near ones too where that matters."""
    pixels = grid_px(camera.size_px, FIT_GRID, 0.5)
    rays = camera.ray(pixels)
    if np.count_nonzero(rays.valid) < len(pixels) // 2:
        raise ValueError("more than half of the image has no ray that such a camera can have")
    ranges = RANGES_M if isinstance(camera, CameraModel) and camera.lens.moving else RANGES_M[1:]
    seen = [rays.origins_m[rays.valid] + range_m * rays.directions[rays.valid] for range_m in ranges]
    return np.tile(pixels[rays.valid], (len(ranges), 1)), np.concatenate(seen)
