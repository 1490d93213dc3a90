"""The nearest camera of another family, and how far it is: measured, not taken from the fit.

Exact twins are CAHVOR with O = A and a pinhole lens with k1 and k2, and a fisheye CAHVORE (type 2) without
E and an equidistant lens with k1 and k2. A lens axis beside A is a turned image (τ) and nearly p1, p2; H
and V that are not at right angles are nearly a turned image too. The moving entrance point of CAHVORE has no
twin.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from calib.geometry.cahvor import COEFFICIENTS, FREE, CameraModel, Kind
from calib.geometry.parameters import parameter_part, predict
from calib.geometry.rigid import FloatArray, tangents

RANGES_M = (1.0, 100.0)
"""Where points stand along a ray: at both if the entrance point moves, at the second if it does not."""

GOOD_PX = 0.005
"""A twin this near is looked for no further."""

_COEFFICIENT_PX = 1e-3
"""What a coefficient of 1 costs in a fit: nothing, except where the pixels do not determine it."""

_BIT = 1e-6
"""A step of numeric derivatives."""

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
        or abs(model.camera_matrix[0, 1]) > 1e-12 * model.focal_px[0]
    ):
        return None
    if (model.kind == FISHEYE) != (kind == FISHEYE):
        return None
    count, used = COEFFICIENTS[kind], np.flatnonzero(model.distortion)
    if len(used) and used[-1] >= count:
        return None
    numbers = np.concatenate([model.distortion, np.zeros(14)])[:count]
    matrix = model.camera_matrix * [[1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]]
    return CameraModel.of_matrix(kind, model.size_px, matrix, numbers, model.rotation, model.C)


@dataclass(frozen=True)
class TwinError:
    """How far one camera is from another over their whole image.

    ``worst_px`` and ``rms_px`` are of the distances between pixels, both ways: a ray of the one seen by the
    other; infinite where the other does not see it. Nothing is compared where the first camera has no ray.
    """

    worst_px: float
    rms_px: float
    worst_at_px: tuple[float, float]


def error_sentence(error: TwinError) -> str:
    """Return how far a twin is, as a part of a sentence."""
    if error.worst_px < 1e-6:
        return "exact"
    x, y = error.worst_at_px
    return f"{error.worst_px:.2g} px off at worst (at pixel {x:.0f}, {y:.0f}), {error.rms_px:.2g} px rms"


def grid_px(size_px: tuple[int, int], counts: tuple[int, int]) -> FloatArray:
    """Return pixels (n, 2) in rows and columns over an image to its outer border."""
    axes = [np.linspace(-0.5, size - 0.5, count) for size, count in zip(size_px, counts, strict=True)]
    return np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)


def twin_error(camera: CameraModel, twin: CameraModel) -> TwinError:
    """Return how far ``twin`` is from ``camera`` (of one size, in one frame), over the image to its outer
    border; if an entrance point moves, for points 1 m away too.
    """
    pixels = grid_px(camera.size_px, (38, 31))  # but for the corners none of those of a fit
    far = np.zeros((2, len(pixels)))
    for off, one, other in zip(far, (camera, twin), (twin, camera), strict=True):
        rays = one.ray(pixels)
        for range_m in RANGES_M if camera.moving else RANGES_M[1:]:
            seen, valid = other.project(rays.origins_m[rays.valid] + range_m * rays.directions[rays.valid])
            moved = np.where(valid, np.linalg.norm(seen - pixels[rays.valid], axis=1), np.inf)
            off[rays.valid] = np.maximum(off[rays.valid], moved)
        off[~rays.valid] = np.inf
    compared = camera.ray(pixels).valid
    if not compared.any():
        return TwinError(np.inf, np.inf, (np.nan, np.nan))
    worst = far.max(axis=0)[compared]
    x, y = pixels[compared][int(worst.argmax())].tolist()
    return TwinError(float(worst.max()), float(np.sqrt(np.mean(worst**2))), (x, y))


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

    Raises ValueError if fewer than half of the image's pixels have a ray that such a lens can have.
    """
    seen = _points_of(model)
    if (same := as_kind(model, kind)) is not None:
        return same
    found = _fit(_plain_start(model, kind), *seen, move=model.moving)
    error = twin_error(model, found)
    if COEFFICIENTS[kind] < 8 or error.worst_px <= GOOD_PX:
        return found
    # From the plain start a fraction's poles may come to lie in the image, and no step leads out again.
    five = _fit(_plain_start(model, "OPENCV5"), *seen, move=model.moving)
    numbers = np.pad(five.distortion, (0, COEFFICIENTS[kind] - 5))
    start = CameraModel.of_matrix(kind, model.size_px, five.camera_matrix, numbers, five.rotation, five.C)
    other = _fit(start, *seen, move=model.moving)
    return other if twin_error(model, other).worst_px < error.worst_px else found


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


def plainest(
    model: CameraModel, twins: Iterable[CameraModel], limit_px: float
) -> tuple[CameraModel, TwinError] | None:
    """Return which of several twins of a model to take, the plainest first, with its error.

    It is one within the limit that is at most twice as far off as the nearest, else the nearest; after one
    within ``GOOD_PX`` no further is tried. None if there is none.
    """
    tried: list[tuple[CameraModel, TwinError]] = []
    for twin in twins:
        tried.append((twin, twin_error(model, twin)))
        if tried[-1][1].worst_px <= GOOD_PX:
            return tried[-1]
    nearest_px = min((error.worst_px for _, error in tried), default=np.inf)
    near = [one for one in tried if one[1].worst_px <= min(limit_px, 2.0 * nearest_px)]
    return next(iter(near or sorted(tried, key=lambda one: one[1].worst_px)), None)


def nearest_cahvor(camera: CameraModel, limit_px: float = np.inf) -> CameraModel:
    """Return a camera of the CAHV family whose pixels come near to one of OpenCV's, in the same frame.

    CAHVOR of a pinhole lens, or CAHVORE of type 3 without E; CAHVORE of type 2 of an equidistant one, or type
    3; which of the two, `plainest` says. One of the CAHV family is its own. Raises ValueError if fewer than
    half of the image's pixels have a ray.
    """
    if camera.kind not in FREE:
        return camera
    seen = _points_of(camera)
    fisheye = camera.kind == FISHEYE
    plain: tuple[Kind, int] = ("CAHVORE", 2) if fisheye else ("CAHVOR", 0)
    r, linearity = np.array([0.0, *camera.distortion[:2]]), 0.0 if fisheye else 1.0

    def fitted(kind: Kind, cahvore_type: int) -> CameraModel:
        lens = replace(camera, kind=kind, cahvore_type=cahvore_type, distortion=np.zeros(0))
        return _fit(replace(lens, O=camera.A, R=r, linearity=linearity), *seen, skew=True)

    found = plainest(camera, (fitted(*kind) for kind in (plain, ("CAHVORE", 3))), limit_px)
    assert found is not None
    return found[0]


def nearest_square(model: CameraModel) -> CameraModel:
    """Return the camera of the same kind, H and V at right angles, whose pixels come nearest to a model's.

    E and R0 stay what they are.
    """
    return _fit(model, *_points_of(model))


def _fit(
    start: CameraModel, pixels: FloatArray, points: FloatArray, move: bool = False, skew: bool = False
) -> CameraModel:
    """The camera of the kind of ``start`` whose pixels of the points come nearest; E stays what it is.

    Unknown are a turn, the camera matrix (its skew if wanted), the lens and, if it may move, C. The lens is
    OpenCV's coefficients, or O about A, R1, R2, a linearity.
    """
    from scipy.optimize import least_squares  # slow to load, and a daemon that starts does not need it
    from scipy.spatial.transform import Rotation

    rows = start.rotation if skew or start.kind in FREE else even_axes(start).T
    at = (0, 1, 0, 1, 0)[: 4 + skew], (0, 1, 2, 2, 1)[: 4 + skew]  # of the unknowns in the camera matrix
    ends = np.cumsum([3, 4 + skew, 3 * move])
    lens = start.distortion
    if "O" in start.letters:
        o, general = rows @ start.O, [start.linearity] * (start.cahvore_type == 3)
        lens = np.array([*o[:2] / o[2], *start.R[1:], *general])
    first = np.stack([start.H, start.V]) @ rows.T
    begin = np.concatenate([np.zeros(3), first[at], np.zeros(3 * move), lens])

    def numbers_of(unknowns: FloatArray) -> dict[str, FloatArray]:
        turn, inside, place, lens = np.split(unknowns, ends)
        axes, matrix = Rotation.from_rotvec(turn).as_matrix() @ rows, np.zeros((2, 3))
        matrix[at] = inside
        h, v = matrix @ axes
        found = {"C": start.C + (place if move else 0.0), "A": axes[2], "H": h, "V": v}
        if "O" in start.letters:
            o = axes.T @ [*lens[:2], 1.0]
            found |= {"O": o / np.linalg.norm(o), "R": np.array([start.R[0], *lens[2:4]])}
        elif len(lens):
            found["D"] = lens
        return found

    def camera_of(unknowns: FloatArray) -> CameraModel:
        numbers: dict[str, Any] = numbers_of(unknowns)
        if start.kind in FREE:  # without skew to the last bit
            axes = Rotation.from_rotvec(unknowns[:3]).as_matrix() @ rows
            matrix = np.eye(3)
            matrix[at] = unknowns[3 : ends[1]]
            return CameraModel.of_matrix(start.kind, start.size_px, matrix, numbers["D"], axes, numbers["C"])
        if start.cahvore_type == 3:
            numbers["linearity"] = float(unknowns[-1])
        return replace(start, **numbers)

    corners = np.stack(np.meshgrid(*zip(pixels.min(axis=0), pixels.max(axis=0), strict=True)), axis=-1)
    whole = bool(start.ray(corners).valid.all())

    def off(unknowns: FloatArray) -> FloatArray:
        far = np.full(pixels.shape, 1e3)
        with contextlib.suppress(ValueError):  # no camera
            camera = camera_of(unknowns)
            if not whole or camera.ray(corners).valid.all():  # a lens may fold there, and no point shows it
                seen, valid = camera.project(points)
                far = np.where(valid[:, None], seen - pixels, far)
        return np.append(far, _COEFFICIENT_PX * unknowns[ends[-1] :] * (start.kind in FREE))

    def rates(unknowns: FloatArray) -> FloatArray:
        camera, numbers = camera_of(unknowns), numbers_of(unknowns)
        seen = predict(camera, points)
        steps = np.zeros((seen.d_step.shape[2], len(unknowns)))
        for column, size in enumerate(np.maximum(np.abs(unknowns), 1.0) * _BIT):
            moved = numbers_of(unknowns + size * (np.arange(len(unknowns)) == column))
            for letter, vector in moved.items():
                by = (vector - numbers[letter]) / size
                by = tangents(numbers[letter]) @ by if letter in "AO" else by[1:] if letter == "R" else by
                steps[parameter_part(start.kind, letter), column] = by
        found = np.nan_to_num(seen.d_step @ steps).reshape(-1, len(unknowns))
        if start.cahvore_type == 3:
            other = replace(camera, linearity=camera.linearity + _BIT).project(points)[0]
            found[:, -1] = np.nan_to_num((other - seen.pixels_px) / _BIT).ravel()
        costs = _COEFFICIENT_PX * np.eye(len(unknowns))[ends[-1] :] * (start.kind in FREE)
        return np.vstack([found, costs])

    if np.abs(off(begin)[: pixels.size]).max() < 1e-9:
        return start
    return camera_of(least_squares(off, begin, rates, method="lm", x_scale=1.0, max_nfev=400).x)


def _points_of(camera: CameraModel) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) over the image and points (n, 3) seen there, near ones too where that matters."""
    pixels = grid_px(camera.size_px, (25, 19))
    rays = camera.ray(pixels)
    if np.count_nonzero(rays.valid) < len(pixels) // 2:
        raise ValueError("more than half of the image has no ray that such a camera can have")
    ranges = RANGES_M if camera.moving else RANGES_M[1:]
    seen = [rays.origins_m[rays.valid] + range_m * rays.directions[rays.valid] for range_m in ranges]
    return np.tile(pixels[rays.valid], (len(ranges), 1)), np.concatenate(seen)
