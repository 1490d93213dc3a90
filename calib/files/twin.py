"""The nearest camera of another family, and how far it is: measured, not taken from the fit.

Exact twins are CAHVOR with O = A and a pinhole lens with k1 and k2, and a fisheye CAHVORE (type 2) without
E and an equidistant lens with k1 and k2. A lens axis beside A is a turned image (τ) and nearly p1, p2; H
and V that are not at right angles are nearly a turned image too. The moving entrance point of CAHVORE has no
twin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from calib.geometry.cahvor import COEFFICIENTS, FREE, SPLINED, CameraModel, Kind
from calib.geometry.parameters import parameter_names, parameter_part, predict, stepped
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid, tangents

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

_SQUARE = 1e-12
"""Skew below this part of the focal length is none."""


LensFamily = Literal["pinhole", "equidistant"]
FISHEYE: Kind = "OPENCV_FISHEYE"
ODD = (2, 3, 8, 9, 10, 11, 12, 13)
"""Coefficients of a pinhole lens that turn their sign where x and y do."""


def kind_of_lens(family: LensFamily, distortion: ArrayLike) -> Kind:
    """Return the kind of a camera of one of OpenCV's two families; CAHV if the lens does nothing."""
    numbers = np.asarray(distortion)
    if family == "equidistant":
        return FISHEYE
    return f"OPENCV{len(numbers)}" if numbers.any() else "CAHV"  # type: ignore[return-value]  # checked by the class


def held_as(model: CameraModel, kind: Kind) -> CameraModel | None:
    """Return the same camera as one of another of OpenCV's kinds; None if that cannot hold it.

    A longer list of coefficients holds a shorter one, and a shorter one those of a longer that are not zero.
    None of them holds skew.
    """
    if (
        model.kind not in (*COEFFICIENTS, "CAHV")
        or abs(model.camera_matrix[0, 1]) > _SQUARE * model.focal_px[0]
    ):
        return None
    if (model.kind == FISHEYE) != (kind == FISHEYE):
        return None
    count, used = COEFFICIENTS[kind], np.flatnonzero(model.distortion)
    if len(used) and used[-1] >= count:
        return None
    told = np.concatenate([model.distortion, np.zeros(14)])[:count]
    return CameraModel.of_matrix(kind, model.size_px, _no_skew(model), told, model.rotation, model.C)


def _no_skew(model: CameraModel) -> FloatArray:
    return model.camera_matrix * [[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]


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


def error_words(error: TwinError) -> str:
    """Return how far a twin is, in words."""
    if error.worst_px < EXACT_PX:
        return "exact"
    x, y = error.worst_at_px
    return f"{error.worst_px:.2g} px off at worst (at pixel {x:.0f}, {y:.0f}), {error.rms_px:.2g} px rms"


def grid_px(size_px: tuple[int, int], counts: tuple[int, int], margin_px: float = 0.0) -> FloatArray:
    """Return pixels (n, 2) in rows and columns over an image, the outer ones ``margin_px`` outside it."""
    axes = [
        np.linspace(-margin_px, size - 1.0 + margin_px, count)
        for size, count in zip(size_px, counts, strict=True)
    ]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def twin_error(camera: CameraModel, twin: CameraModel, near: bool = False) -> TwinError:
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


def even_axes(model: CameraModel) -> FloatArray:
    """Return (3, 3): columns are the camera's x, y, z in the model's frame; z along A, x as H and V say."""
    z = model.A
    right = model.H - (model.H @ z) * z
    down = model.V - (model.V @ z) * z
    x = right / np.linalg.norm(right) + np.cross(down / np.linalg.norm(down), z)  # each has half a say
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def nearest_opencv(model: CameraModel, kind: Kind) -> CameraModel:
    """Return the camera of one of OpenCV's kinds, without skew, whose pixels come nearest to a model's.

    Of 14 coefficients k1, k2, k3, p1, p2 and the turns of the plane are used. A plane turned about both axes
    and a camera turned back leave an image that leans by the product of both turns. So OpenCV can hold H and
    V that are not at right angles.

    Raises
    ------
    ValueError
        If fewer than half of the image's pixels have a ray that such a lens can have; of 14 coefficients, if
        the entrance point moves.
    """
    pixels, points = _what_it_sees(model)
    if (same := held_as(model, kind)) is not None:
        return same
    if kind == "OPENCV14":
        return _nearest_tilted(model, pixels, points)
    return _fit(_plain_start(model, kind), pixels, points, range(COEFFICIENTS[kind]), model.moving)


def _plain_start(model: CameraModel, kind: Kind) -> CameraModel:
    """A camera of the kind to begin with: axes, focal lengths and the first coefficients of the model."""
    free = model.kind in FREE
    axes = even_axes(model) if free else lens_axes(model)
    focal = np.array([model.H @ axes[:, 0], model.V @ axes[:, 1]]) * (1.0 + model.R[0]) / (model.A @ model.O)
    center = np.array([model.H @ model.O, model.V @ model.O]) / (model.A @ model.O)
    distortion = np.zeros(COEFFICIENTS[kind])
    if free and model.kind != SPLINED and (model.kind == FISHEYE) == (kind == FISHEYE):
        count = min(len(distortion), len(model.distortion))
        distortion[:count] = model.distortion[:count]
    elif not free and (kind == FISHEYE) == (model.cahvore_type == 2):
        distortion[:2] = model.R[1:] / (1.0 + model.R[0])
    matrix = [[focal[0], 0.0, center[0]], [0.0, focal[1], center[1]], [0.0, 0.0, 1.0]]
    return CameraModel.of_matrix(kind, model.size_px, matrix, distortion, axes.T, model.C)


def _nearest_tilted(model: CameraModel, pixels: FloatArray, points: FloatArray) -> CameraModel:
    if model.moving:
        raise ValueError("the entrance point moves")
    plain = _fit(_plain_start(model, "OPENCV5"), pixels, points, range(5), False)
    across, down = (vector - (vector @ model.A) * model.A for vector in (model.H, model.V))
    lean = float(across @ down / np.linalg.norm(across) / np.linalg.norm(down))
    # From no turn at all no fit begins: what a turn does to the lean grows as its square.
    turn = max(np.sqrt(abs(lean)), 1e-3)
    found = []
    for sign in (1.0, -1.0):
        told = np.concatenate([plain.distortion, np.zeros(7), [turn, sign * turn]])
        start = CameraModel.of_matrix(
            "OPENCV14", model.size_px, plain.camera_matrix, told, plain.rotation, plain.C
        )
        found.append(_fit(start, pixels, points, (0, 1, 2, 3, 4, 12, 13), False))
    return min(found, key=lambda camera: twin_error(model, camera).worst_px)


def nearest_cahvor(camera: CameraModel) -> CameraModel:
    """Return the camera of the CAHV family whose pixels come nearest to one of OpenCV's, in the same frame.

    CAHVOR of a pinhole lens, or CAHVORE of type 3 without E where that comes nearer; CAHVORE of type 2 of an
    equidistant one, or type 3. One of the CAHV family is its own.

    Raises
    ------
    ValueError
        If fewer than half of the image's pixels have a ray.
    """
    if camera.kind not in FREE:
        return camera
    pixels, points = _what_it_sees(camera)
    fisheye = camera.kind == FISHEYE
    r = np.zeros(3) if camera.kind == SPLINED else np.array([0.0, *camera.distortion[:2]])
    tries: list[tuple[Kind, int]] = (
        [("CAHVORE", 2), ("CAHVORE", 3)] if fisheye else [("CAHVOR", 0), ("CAHVORE", 3)]
    )
    best: tuple[float, CameraModel] | None = None
    for kind, cahvore_type in tries:
        start = CameraModel(
            kind,
            camera.size_px,
            camera.C,
            camera.A,
            camera.H,
            camera.V,
            O=camera.A,
            R=r,
            cahvore_type=cahvore_type,
            linearity=0.0 if fisheye else 1.0,
        )
        found = _fit(start, pixels, points, (), False)
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
    build: Callable[[FloatArray], CameraModel],
    start: FloatArray,
    scale: FloatArray,
    pixels: FloatArray,
    points: FloatArray,
) -> CameraModel:
    """The camera whose pixels of the points come nearest, least squares from ``start``."""
    from scipy.optimize import least_squares  # slow to load

    def off_px(numbers: FloatArray) -> FloatArray:
        try:
            seen, valid = build(numbers).project(points)
        except ValueError:
            return np.full(2 * len(pixels), _LOST_PX)
        return np.where(valid[:, None], seen - pixels, _LOST_PX).ravel()

    if np.abs(off_px(start)).max() < EXACT_PX:
        return build(start)
    found = least_squares(
        off_px, start, x_scale=scale, method="lm", xtol=1e-12, ftol=1e-12, max_nfev=_STEPS * len(start)
    )
    return build(found.x)


def _fit(
    start: CameraModel, pixels: FloatArray, points: FloatArray, coefficients: Sequence[int], placed: bool
) -> CameraModel:
    """The camera of the kind of ``start`` that comes nearest; of OpenCV's kinds without skew.

    Levenberg and Marquardt's steps, each about the camera that the last one led to. ``coefficients`` are
    those of OpenCV's that may change, ``placed`` whether C may; E stays, which is zero.
    """
    names = parameter_names(start.kind)
    free = [at for at, name in enumerate(names) if name[0] not in ("E" if placed else "CE") + "D"]
    if "D" in start.letters:
        free += [parameter_part(start.kind, "D").start + at for at in coefficients]
    general = start.cahvore_type == 3
    camera, damping = start, 1e-6
    off, rates, basis = _off_and_rates(camera, pixels, points, free, general)
    for _ in range(_STEPS):
        if np.abs(off[: 2 * len(points)]).max() < EXACT_PX * 1e-3:
            break
        scale = np.maximum(np.linalg.norm(rates, axis=0), 1e-30)
        normal = rates.T @ rates / np.outer(scale, scale)
        step = -np.linalg.solve(normal + damping * np.eye(len(scale)), rates.T @ off / scale) / scale
        try:
            moved = _squared(stepped(camera, basis @ step[: basis.shape[1]]))
            if general:
                moved = replace(moved, linearity=moved.linearity + float(step[-1]))
            moved_off, moved_rates, moved_basis = _off_and_rates(moved, pixels, points, free, general)
        except ValueError:  # the step led to no camera
            moved_off = np.full(1, np.inf)
        if not moved_off @ moved_off < off @ off:
            damping *= 10.0
            if damping > 1e6:
                break
            continue
        settled = moved_off @ moved_off > (1.0 - 1e-6) * (off @ off)
        camera, off, rates, basis, damping = (
            moved,
            moved_off,
            moved_rates,
            moved_basis,
            max(0.1 * damping, 1e-12),
        )
        if settled:
            break
    return camera


def _squared(model: CameraModel) -> CameraModel:
    """A camera of OpenCV's kinds without its skew; another as it is."""
    if model.kind not in COEFFICIENTS:
        return model
    return CameraModel.of_matrix(
        model.kind, model.size_px, _no_skew(model), model.distortion, model.rotation, model.C
    )


def _off_and_rates(
    camera: CameraModel, pixels: FloatArray, points: FloatArray, free: Sequence[int], general: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels off (n,), their rates (n, f) to what is free, the linearity last, and what is free (p, f).

    What pixels cannot tell of coefficients stays small: each costs a little.
    """
    seen = predict(camera, points)
    basis = np.eye(seen.d_step.shape[2])[:, free]
    if "D" in camera.letters:
        a, h, v, d = (parameter_part(camera.kind, letter) for letter in "AHVD")
        x, y, z = camera.rotation
        square = np.zeros((seen.d_step.shape[2], 7))  # turns about x, y, z; H along x and z, V along y and z
        for column, axis in enumerate((x, y, z)):
            square[a, column] = tangents(z) @ np.cross(axis, z)
            square[h, column], square[v, column] = np.cross(axis, camera.H), np.cross(axis, camera.V)
        square[h, 3], square[h, 4], square[v, 5], square[v, 6] = x, z, y, z
        others = [at for at in free if not a.start <= at < v.stop]
        basis = np.hstack([np.eye(len(square))[:, others], square])
    off = np.where(seen.valid[:, None], seen.pixels_px - pixels, _LOST_PX).ravel()
    rates = np.nan_to_num(seen.d_step @ basis).reshape(len(off), -1)
    if general:
        bit = 1e-6
        other = replace(camera, linearity=camera.linearity + bit).project(points)[0]
        rates = np.column_stack([rates, np.nan_to_num((other - seen.pixels_px) / bit).ravel()])
    if "D" in camera.letters:
        off = np.concatenate([off, _HELD_PX * camera.distortion])
        rates = np.concatenate([rates, _HELD_PX * basis[d]])
    return off, rates, basis


def _what_it_sees(camera: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) over the image and points (n, 3) seen there, near ones too where that matters."""
    pixels = grid_px(camera.size_px, FIT_GRID, 0.5)
    rays = camera.ray(pixels)
    if np.count_nonzero(rays.valid) < len(pixels) // 2:
        raise ValueError("more than half of the image has no ray that such a camera can have")
    ranges = RANGES_M if camera.moving else RANGES_M[1:]
    seen = [rays.origins_m[rays.valid] + range_m * rays.directions[rays.valid] for range_m in ranges]
    return np.tile(pixels[rays.valid], (len(ranges), 1)), np.concatenate(seen)
