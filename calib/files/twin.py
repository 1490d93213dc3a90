"""The nearest camera of another family, and how far it is: measured, not taken from the fit.

Exact twins are CAHVOR with O = A and a pinhole lens with k1 and k2, and a fisheye CAHVORE (type 2) without
E and an equidistant lens with k1 and k2. A lens axis beside A is a turned image (τ) and nearly p1, p2; H
and V that are not at right angles are nearly a turned image too. The moving entrance point of CAHVORE has no
twin.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from calib.geometry.cahvor import COEFFICIENTS, FREE, CameraModel, Kind
from calib.geometry.parameters import parameter_names, parameter_part, predict, stepped
from calib.geometry.rigid import FloatArray, tangents

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

_COEFFICIENT_PX = 1e-3
"""What a coefficient of 1 costs in a fit: nothing, except where the pixels do not tell it."""

_STEPS = 60
"""How many steps a fit may take."""

_LOST_PX = 1e3
"""The residual of a point that the camera of a fit does not see."""

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


def as_kind(model: CameraModel, kind: Kind) -> CameraModel | None:
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
    numbers = np.concatenate([model.distortion, np.zeros(14)])[:count]
    return CameraModel.of_matrix(kind, model.size_px, _no_skew(model), numbers, model.rotation, model.C)


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


def error_sentence(error: TwinError) -> str:
    """Return how far a twin is, as a part of a sentence."""
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


def even_axes(model: CameraModel, z: FloatArray | None = None) -> FloatArray:
    """Return (3, 3): columns are the camera's x, y, z in the model's frame; z along A, or as given.

    Where H and V are not at right angles, each has half a say of x.
    """
    z = model.A if z is None else z
    right, down = model.H - (model.H @ z) * z, model.V - (model.V @ z) * z
    x = right / np.linalg.norm(right) + np.cross(down / np.linalg.norm(down), z)
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
    if (same := as_kind(model, kind)) is not None:
        return same
    if kind == "OPENCV14":
        return _nearest_tilted(model, pixels, points)
    found = []
    for start in _starts(model, kind, pixels, points):
        found.append(_fit(start, pixels, points, range(COEFFICIENTS[kind]), model.moving))
        if twin_error(model, found[-1], model.moving).worst_px <= GOOD_PX:
            break
    return min(found, key=lambda one: twin_error(model, one, model.moving).worst_px)


def _starts(model: CameraModel, kind: Kind, pixels: FloatArray, points: FloatArray) -> Iterator[CameraModel]:
    """Yield where fits of a kind begin: as plain as can be, and where a shorter list of coefficients ended.

    From the plain start a fraction's poles may come to lie in the image, and no step leads out again.
    """
    plain = _plain_start(model, kind)
    yield plain
    if kind in ("OPENCV8", "OPENCV12"):
        five = _fit(_plain_start(model, "OPENCV5"), pixels, points, range(5), model.moving)
        numbers = np.concatenate([five.distortion, np.zeros(COEFFICIENTS[kind] - 5)])
        yield CameraModel.of_matrix(kind, model.size_px, five.camera_matrix, numbers, five.rotation, five.C)


def _plain_start(model: CameraModel, kind: Kind) -> CameraModel:
    """A camera of the kind to begin with: axes, focal lengths and the first coefficients of the model."""
    free = model.kind in FREE
    axes = even_axes(model, None if free else model.O)
    focal = np.array([model.H @ axes[:, 0], model.V @ axes[:, 1]]) * (1.0 + model.R[0]) / (model.A @ model.O)
    center = np.array([model.H @ model.O, model.V @ model.O]) / (model.A @ model.O)
    distortion = np.zeros(COEFFICIENTS[kind])
    if free and (model.kind == FISHEYE) == (kind == FISHEYE):
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
        numbers = np.concatenate([plain.distortion, np.zeros(7), [turn, sign * turn]])
        start = CameraModel.of_matrix(
            "OPENCV14", model.size_px, plain.camera_matrix, numbers, plain.rotation, plain.C
        )
        found.append(_fit(start, pixels, points, (0, 1, 2, 3, 4, 12, 13), False))
    return min(found, key=lambda camera: twin_error(model, camera).worst_px)


def plainest(tried: Sequence[tuple[CameraModel, TwinError]], limit_px: float) -> int:
    """Return which of several twins to take, the plainest first: one within the limit that is at most twice
    as far off as the nearest, else the nearest."""
    worst = [error.worst_px for _, error in tried]
    near = [at for at, px in enumerate(worst) if px <= min(limit_px, 2.0 * min(worst))]
    return near[0] if near else int(np.argmin(worst))


def nearest_cahvor(camera: CameraModel, limit_px: float = np.inf) -> CameraModel:
    """Return a camera of the CAHV family whose pixels come near to one of OpenCV's, in the same frame.

    CAHVOR of a pinhole lens, or CAHVORE of type 3 without E; CAHVORE of type 2 of an equidistant one, or type
    3; which of the two, `plainest` says. One of the CAHV family is its own.

    Raises
    ------
    ValueError
        If fewer than half of the image's pixels have a ray.
    """
    if camera.kind not in FREE:
        return camera
    pixels, points = _what_it_sees(camera)
    fisheye = camera.kind == FISHEYE
    r = np.array([0.0, *camera.distortion[:2]])
    tries: list[tuple[Kind, int]] = (
        [("CAHVORE", 2), ("CAHVORE", 3)] if fisheye else [("CAHVOR", 0), ("CAHVORE", 3)]
    )
    tried: list[tuple[CameraModel, TwinError]] = []
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
        tried.append((found, twin_error(camera, found)))
        if tried[-1][1].worst_px <= GOOD_PX:
            return found
    return tried[plainest(tried, limit_px)][0]


def nearest_square(model: CameraModel) -> CameraModel:
    """Return the camera of the same kind, H and V at right angles, whose pixels come nearest to a model's.

    E, R0 and linearity stay what they are.
    """
    pixels, points = _what_it_sees(model)
    return _fit(_squared(model), pixels, points, (), False, square=True)


def _fit(
    start: CameraModel,
    pixels: FloatArray,
    points: FloatArray,
    coefficients: Sequence[int],
    placed: bool,
    square: bool = False,
) -> CameraModel:
    """The camera of the kind of ``start`` that comes nearest; ``square`` or of OpenCV's kinds without skew.

    Levenberg and Marquardt's steps, each about the camera that the last one led to. ``coefficients`` are
    those of OpenCV's that may change, ``placed`` whether C may; E stays, which is zero.
    """
    square = square or start.kind in COEFFICIENTS
    names = parameter_names(start.kind)
    free = [at for at, name in enumerate(names) if name[0] not in ("E" if placed else "CE") + "D"]
    if "D" in start.letters:
        free += [parameter_part(start.kind, "D").start + at for at in coefficients]
    general = start.cahvore_type == 3
    camera, damping, whole = start, 1e-6, _sees_corners(start, pixels)
    off, rates, basis = _off_and_rates(camera, pixels, points, free, general, square)
    for _ in range(_STEPS):
        if np.abs(off[: 2 * len(points)]).max() < EXACT_PX * 1e-3:
            break
        scale = np.maximum(np.linalg.norm(rates, axis=0), 1e-30)
        normal = rates.T @ rates / np.outer(scale, scale)
        step = -np.linalg.solve(normal + damping * np.eye(len(scale)), rates.T @ off / scale) / scale
        try:
            moved = stepped(camera, basis @ step[: basis.shape[1]])
            moved = _squared(moved) if square else moved
            if general:
                moved = replace(moved, linearity=moved.linearity + float(step[-1]))
            moved_off, moved_rates, moved_basis = _off_and_rates(moved, pixels, points, free, general, square)
        except ValueError:  # the step led to no camera
            moved_off = np.full(1, np.inf)
        if not moved_off @ moved_off < off @ off or (whole and not _sees_corners(moved, pixels)):
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
        whole = whole or _sees_corners(camera, pixels)
        if settled:
            break
    return camera


def _sees_corners(camera: CameraModel, pixels: FloatArray) -> bool:
    """Whether the corners of a fit's pixels have rays: a lens may fold just there, and no point shows it."""
    corners = np.stack(np.meshgrid(*zip(pixels.min(axis=0), pixels.max(axis=0), strict=True)), axis=-1)
    return bool(camera.ray(corners.reshape(-1, 2)).valid.all())


def _squared(model: CameraModel) -> CameraModel:
    """A camera without its skew."""
    if model.kind in COEFFICIENTS:
        return CameraModel.of_matrix(
            model.kind, model.size_px, _no_skew(model), model.distortion, model.rotation, model.C
        )
    x, y, z = even_axes(model).T
    return replace(model, H=(model.H @ x) * x + (model.H @ z) * z, V=(model.V @ y) * y + (model.V @ z) * z)


def _off_and_rates(
    camera: CameraModel,
    pixels: FloatArray,
    points: FloatArray,
    free: Sequence[int],
    general: bool,
    square: bool,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels off (n,), their rates (n, f) to what is free, the linearity last, and what is free (p, f).

    What pixels cannot tell of coefficients stays small: each costs a little.
    """
    seen = predict(camera, points)
    basis = np.eye(seen.d_step.shape[2])[:, free]
    if square:
        a, h, v = (parameter_part(camera.kind, letter) for letter in "AHV")
        x, y, z = even_axes(camera).T
        kept = np.zeros((seen.d_step.shape[2], 7))  # turns about x, y, z; H along x and z, V along y and z
        for column, axis in enumerate((x, y, z)):
            kept[a, column] = tangents(z) @ np.cross(axis, z)
            kept[h, column], kept[v, column] = np.cross(axis, camera.H), np.cross(axis, camera.V)
        kept[h, 3], kept[h, 4], kept[v, 5], kept[v, 6] = x, z, y, z
        others = [at for at in free if not a.start <= at < v.stop]
        basis = np.hstack([np.eye(len(kept))[:, others], kept])
    off = np.where(seen.valid[:, None], seen.pixels_px - pixels, _LOST_PX).ravel()
    rates = np.nan_to_num(seen.d_step @ basis).reshape(len(off), -1)
    if general:
        bit = 1e-6
        other = replace(camera, linearity=camera.linearity + bit).project(points)[0]
        rates = np.column_stack([rates, np.nan_to_num((other - seen.pixels_px) / bit).ravel()])
    if "D" in camera.letters:
        off = np.concatenate([off, _COEFFICIENT_PX * camera.distortion])
        rates = np.concatenate([rates, _COEFFICIENT_PX * basis[parameter_part(camera.kind, "D")]])
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
