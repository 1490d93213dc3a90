"""A camera's free parameters, and how its pixels depend on them.

A fit moves a camera by a *step* in this order: C (3, metres), A (2, radians), H (3), V (3, pixels), then for
CAHVOR and CAHVORE O (2, radians) and R1, R2, then for CAHVORE E0, E1, E2; for OpenCV's families D, the
coefficients in OpenCV's order. A and O are unit vectors: they move
in their tangent plane, along the two directions of ``tangents``. R0 is not among them: I + r0 (I - OOᵀ) is a
linear map that H, V and A absorb, so R0 stays what it is (0 in every fit).

With d = P - C, zeta = d.O, lambda = d - zeta O, a point is seen along q = O + m lambda, and (x, y) = (H.q,
V.q) / (A.q). ``calib.geometry.lens_rays`` gives m with dm = n lambda.dlambda + k dzeta. A step o of O (at
right angles to it) changes zeta by lambda.o and lambda by -(lambda.o) O - zeta o, hence

    dq = (1 - m zeta) o + ((k - n zeta) lambda - m O) (lambda.o).

OpenCV's lenses turn with A and V: with q = u x + v y + A, a turn omega of the lens frame moves (x, y) by
omega.(q x d pixel/dq - d x d pixel/d point). A step a of A turns the frame by (-a.y, a.x, cy/fy a.x), a step
of V about A by -dV.x / fy.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calib.geometry.cahvor import CameraModel, letters_of
from calib.geometry.lens import TINY, Lens, ray_angle
from calib.geometry.lens_rays import bend
from calib.geometry.lenses import fisheye, opencv
from calib.geometry.lenses.fisheye import FisheyeLens
from calib.geometry.lenses.opencv import OpencvLens
from calib.geometry.lenses.projection import FreeLens
from calib.geometry.rigid import FloatArray, crossed_rows, tangents

_LETTERS = {
    "C": ("C.x", "C.y", "C.z"),
    "A": ("A.1", "A.2"),
    "H": ("H.x", "H.y", "H.z"),
    "V": ("V.x", "V.y", "V.z"),
    "O": ("O.1", "O.2"),
    "R": ("R.1", "R.2"),
    "E": ("E.0", "E.1", "E.2"),
}
_COEFFICIENTS = {
    **{f"OPENCV{n}": tuple(f"D.{name}" for name in opencv.NAMES[:n]) for n in opencv.COUNTS},
    "OPENCV_FISHEYE": tuple(f"D.{name}" for name in fisheye.NAMES),
}


class Prediction(NamedTuple):
    """Pixels (n, 2), d pixel / d step (n, 2, p), d pixel / d point (n, 2, 3), and which are valid (n,)."""

    pixels_px: FloatArray
    d_step: FloatArray
    d_points: FloatArray
    valid: np.ndarray


def parameter_names(kind: str) -> tuple[str, ...]:
    """Return the names of a camera's parameters, in the order of a step: 11 to 25 of them."""
    return tuple(name for letter in letters_of(kind) for name in _names(kind, letter))


def _names(kind: str, letter: str) -> tuple[str, ...]:
    return _COEFFICIENTS[kind] if letter == "D" else _LETTERS[letter]


def parameter_part(kind: str, letter: str) -> slice:
    """Return where a letter's parameters are in a step of a camera of this kind."""
    start = 0
    for other in letters_of(kind):
        size = len(_names(kind, other))
        if other == letter:
            return slice(start, start + size)
        start += size
    raise KeyError(letter)


def camera_numbers(model: CameraModel) -> FloatArray:
    """Return the values (p,) of a camera's parameters; 0 for those of A and O, which count from its own."""
    values = {"A": np.zeros(2), "O": np.zeros(2), "R": model.R[1:], "D": model.distortion}
    return np.concatenate(
        [values[letter] if letter in values else getattr(model, letter) for letter in model.letters]
    )


def stepped(model: CameraModel, step: FloatArray) -> CameraModel:
    """Return the camera moved by a step (p,), in the order of ``parameter_names``.

    Raises
    ------
    ValueError
        If the step leads to something that is no camera.
    """
    kind = model.kind
    parts = {letter: step[parameter_part(kind, letter)] for letter in model.letters}
    changed = {"C": model.C + parts["C"], "H": model.H + parts["H"], "V": model.V + parts["V"]}
    for letter, axis in (("A", model.A), ("O", model.O)):
        if letter in parts:
            moved = axis + parts[letter] @ tangents(axis)
            changed[letter] = moved / np.linalg.norm(moved)
    if "R" in parts:
        changed["R"] = model.R + np.concatenate([[0.0], parts["R"]])
    if "E" in parts:
        changed["E"] = model.E + parts["E"]
    if "D" in parts:
        changed["distortion"] = model.distortion + parts["D"]
    return replace(model, **changed)  # type: ignore[arg-type]  # letters only


def predict(model: CameraModel, points_m: FloatArray) -> Prediction:
    """Return pixels of points (n, 3), metres in the model's frame, with derivatives.

    Points that have no pixel come out as not-a-number. Each number's values of all points lie side by side in
    memory, so that numpy's loops run along them.
    """
    points = np.array(np.asarray(points_m).T, order="C")
    points -= model.C[:, None]
    with np.errstate(all="ignore"):
        if model.free_lens is not None:
            pixels, d_step, d_points, valid = _predict_free(model, model.free_lens, points)
        else:
            pixels, d_step, d_points, valid = _predict_radial(model, points)
    if not valid.all():
        for array in (pixels, d_step, d_points):
            array[..., ~valid] = np.nan
    return Prediction(pixels.T, d_step.transpose(2, 0, 1), d_points.transpose(2, 0, 1), valid)


_Predicted = tuple[FloatArray, FloatArray, FloatArray, np.ndarray]
"""Pixels (2, n), d pixel / d step (2, p, n), d pixel / d point (2, 3, n), and which are valid (n,)."""


def _predict_radial(model: CameraModel, d: FloatArray) -> _Predicted:
    """CAHV, CAHVOR and CAHVORE of points (3, n) from C."""
    kind, lens, o, axis = model.kind, model.lens, model.O, model.A
    on_a, on_o = tangents(axis), tangents(o)
    both = np.stack([model.H, model.V])
    zeta = o @ d
    lam = d - o[:, None] * zeta
    across_o = on_o @ lam
    bent = bend(lens, np.concatenate([across_o, zeta[None]]), True)
    if bent.derivatives is None:
        raise AssertionError("bend was asked for derivatives")
    m, n, k, _ = bent.derivatives
    # dm = n lambda . d lambda + k d zeta; bend gives its rates to a point scaled to unit length.
    unit = np.maximum(np.sqrt(_dot(lam, lam)), TINY) if lens.curved else zeta
    n, k = n / (unit * unit), k / unit
    q = o[:, None] + m * lam
    depth = axis @ q
    pixels = (both @ q) / depth
    valid = bent.valid & (depth > 0.0) & np.isfinite(pixels).all(axis=0)
    if not lens.curved:
        valid &= axis @ d > 0.0
    # d pixel / d q: (H - x A) / depth and (V - y A) / depth
    d_q = (both[..., None] - pixels[:, None] * axis[:, None]) / depth
    along, across = o @ d_q, _dot(d_q, lam)
    d_points = m * (d_q - along[:, None] * o[:, None])
    d_points += across[:, None] * (n * lam + k * o[:, None])
    d_step = np.zeros((2, len(parameter_names(kind)), len(zeta)))

    def to(letter: str) -> FloatArray:
        return d_step[:, parameter_part(kind, letter)]

    q /= depth
    np.negative(d_points, out=to("C"))
    np.multiply(-pixels[:, None], on_a @ q, out=to("A"))
    to("H")[0] = to("V")[1] = q
    if "O" in kind:  # a CAHV camera keeps O = A, but a step along O moves no pixel of it
        turn = (k - n * zeta) * across - m * along
        np.multiply(1.0 - m * zeta, on_o @ d_q, out=to("O"))
        to("O")[...] += turn[:, None] * across_o
        per_r, per_e = _lens_rates(lens, lam, zeta)
        np.multiply(across[:, None], per_r, out=to("R"))
        if "E" in kind:
            np.multiply(across[:, None], per_e, out=to("E"))
    return pixels, d_step, d_points, valid


def _predict_free(model: CameraModel, lens: FreeLens, d: FloatArray) -> _Predicted:
    """The same of OpenCV's families."""
    kind, axes, matrix = model.kind, model.rotation, model.camera_matrix
    x, _, z = axes
    focal = matrix[:2, :2]
    local = axes @ d
    bent = lens.bend(local, True)
    if bent.rates is None:
        raise AssertionError("bend was asked for derivatives")
    pixels = focal @ bent.slopes + matrix[:2, 2:]
    valid = bent.valid & np.isfinite(pixels).all(axis=0)
    d_points = axes.T @ np.tensordot(focal, bent.rates, 1)
    q = axes[:2].T @ bent.slopes + z[:, None]
    d_q = np.stack([model.H, model.V])[..., None] - pixels[:, None] * z[:, None]
    d_turn = crossed_rows(q, d_q) - crossed_rows(d, d_points)
    d_step = np.zeros((2, len(parameter_names(kind)), d.shape[1]))

    def to(letter: str) -> FloatArray:
        return d_step[:, parameter_part(kind, letter)]

    np.negative(d_points, out=to("C"))
    on_a, (_, fy, cy) = tangents(model.A), matrix[1]
    turns = np.stack([-on_a @ axes[1], on_a @ x, cy / fy * (on_a @ x)], axis=1) @ axes
    np.subtract(turns @ d_turn, pixels[:, None] * (on_a @ q), out=to("A"))
    to("H")[0] = q
    np.multiply((z @ d_turn)[:, None], (-x / fy)[:, None], out=to("V"))
    to("V")[1] += q
    if isinstance(lens, (OpencvLens, FisheyeLens)):  # splines are read, not fitted
        to("D")[...] = np.tensordot(focal, lens.coefficient_rates(local), 1)
    return pixels, d_step, d_points, valid


def _dot(one: FloatArray, other: FloatArray) -> FloatArray:
    """Products (..., n) of vectors (..., 3, n)."""
    return np.asarray((one * other).sum(axis=-2))


def _lens_rates(lens: Lens, lam: FloatArray, zeta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """dm / d(r1, r2) (2, n) and dm / d(e0, e1, e2) (3, n); none of the latter for CAHVOR."""
    length = np.sqrt(_dot(lam, lam))
    if not lens.curved:
        tau = (length / zeta) ** 2
        return np.stack([tau / zeta, tau * tau / zeta]), np.zeros((0, len(zeta)))
    length = np.maximum(length, 1e-150)
    theta, sine, _, slope, _ = ray_angle(lens, length, zeta, True)
    line = lens.linearity
    if line > 0.0:
        chi = np.tan(line * theta) / line
        chi_rate = 1.0 + (line * chi) ** 2
    elif line < 0.0:
        chi = np.sin(line * theta) / line
        chi_rate = np.cos(line * theta)
    else:
        chi, chi_rate = theta, np.ones_like(theta)
    r0, r1, r2 = lens.r
    y = chi * chi
    rate = (1.0 + r0 + y * (3.0 * r1 + y * 5.0 * r2)) * chi_rate / length
    per_e = (theta - sine) / slope * rate
    turn = theta * theta
    return (
        np.stack([chi * y, chi * y * y]) / length,
        np.stack([per_e, per_e * turn, per_e * turn * turn]),
    )
