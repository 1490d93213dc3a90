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
from calib.geometry.rigid import FloatArray, tangents

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

    Points that have no pixel come out as not-a-number.
    """
    if model.free_lens is not None:
        return _predict_free(model, model.free_lens, points_m)
    o, axis = model.O, model.A
    lens = model.lens
    d = points_m - model.C
    zeta = d @ o
    lam = d - zeta[:, None] * o
    with np.errstate(all="ignore"):
        bent = bend(lens, np.stack([*_across(lam, o), zeta]), True)
        if bent.derivatives is None:
            raise AssertionError("bend was asked for derivatives")
        m, n, k, _ = bent.derivatives
        # dm = n lambda . d lambda + k d zeta; bend gives its rates to a point scaled to unit length.
        unit = np.maximum(np.linalg.norm(lam, axis=1), TINY) if lens.curved else zeta
        n, k = n / (unit * unit), k / unit
        q = o + m[:, None] * lam
        depth = q @ axis
        pixels = np.stack([q @ model.H, q @ model.V], axis=-1) / depth[:, None]
        valid = bent.valid & (depth > 0.0) & np.isfinite(pixels).all(axis=-1)
        if not lens.curved:
            valid = valid & (d @ axis > 0.0)
        # d pixel / d q: (H - x A) / depth and (V - y A) / depth
        d_q = np.stack(
            [model.H - pixels[:, :1] * axis, model.V - pixels[:, 1:] * axis], axis=1
        ) / depth[:, None, None]  # fmt: skip
        along = d_q @ o
        across = np.einsum("nij,nj->ni", d_q, lam)
        d_points = (
            m[:, None, None] * (d_q - along[..., None] * o)
            + across[..., None] * (n[:, None] * lam + k[:, None] * o)[:, None, :]
        )
        d_step = _to_step(
            model, lens, Slopes(d_q, q / depth[:, None], pixels, along, across), lam, zeta, m, n, k
        )
    if not valid.all():
        for array in (pixels, d_step, d_points):
            array[~valid] = np.nan
    return Prediction(pixels, d_step, d_points, valid)


def _predict_free(model: CameraModel, lens: FreeLens, points_m: FloatArray) -> Prediction:
    """The same for a camera of OpenCV's families."""
    kind, axes, matrix = model.kind, model.rotation, model.camera_matrix
    x, _, z = axes
    d = points_m - model.C
    local = np.ascontiguousarray((d @ axes.T).T)
    d_step = np.zeros((len(d), 2, len(parameter_names(kind))))
    with np.errstate(all="ignore"):
        bent = lens.bend(local, True)
        if bent.rates is None:
            raise AssertionError("bend was asked for derivatives")
        pixels = (matrix[:2, :2] @ bent.slopes + matrix[:2, 2:]).T
        valid = bent.valid & np.isfinite(pixels).all(axis=-1)
        d_points = np.einsum("ij,jkn->nik", matrix[:2, :2], bent.rates) @ axes
        q = bent.slopes.T @ axes[:2] + z
        d_q = np.stack([model.H - pixels[:, :1] * z, model.V - pixels[:, 1:] * z], axis=1)
        d_turn = np.cross(q[:, None], d_q) - np.cross(d[:, None], d_points)
        d_step[..., parameter_part(kind, "C")] = -d_points
        on_a, (_, fy, cy) = tangents(model.A), matrix[1]
        turns = np.stack([-on_a @ axes[1], on_a @ x, cy / fy * (on_a @ x)], axis=1) @ axes
        d_step[..., parameter_part(kind, "A")] = (
            d_turn @ turns.T - pixels[..., None] * (q @ on_a.T)[:, None, :]
        )
        d_step[:, 0, parameter_part(kind, "H")] = q
        d_step[..., parameter_part(kind, "V")] = (d_turn @ z)[..., None] * (-x / fy)
        d_step[:, 1, parameter_part(kind, "V")] += q
        if isinstance(lens, (OpencvLens, FisheyeLens)):  # splines are read, not fitted
            d_step[..., parameter_part(kind, "D")] = np.einsum(
                "ij,jkn->nik", matrix[:2, :2], lens.coefficient_rates(local)
            )
    if not valid.all():
        for array in (pixels, d_step, d_points):
            array[~valid] = np.nan
    return Prediction(pixels, d_step, d_points, valid)


class Slopes(NamedTuple):
    """d pixel / d q (n, 2, 3), q / (A.q) (n, 3), pixels (n, 2), and d_q along O and times lambda (n, 2)."""

    d_q: FloatArray
    q: FloatArray
    pixels: FloatArray
    along: FloatArray
    across: FloatArray


def _across(lam: FloatArray, o: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lambda's two coordinates across O."""
    one, two = tangents(o)
    return lam @ one, lam @ two


def _to_step(
    model: CameraModel,
    lens: Lens,
    s: Slopes,
    lam: FloatArray,
    zeta: FloatArray,
    m: FloatArray,
    n: FloatArray,
    k: FloatArray,
) -> FloatArray:
    """d pixel / d step (n, 2, p)."""
    kind, o = model.kind, model.O
    count = len(lam)
    out = np.zeros((count, 2, len(parameter_names(kind))))
    out[..., parameter_part(kind, "C")] = -(
        m[:, None, None] * (s.d_q - s.along[..., None] * o)
        + s.across[..., None] * (n[:, None] * lam + k[:, None] * o)[:, None, :]
    )
    on_a = tangents(model.A)
    out[..., parameter_part(kind, "A")] = -s.pixels[..., None] * (s.q @ on_a.T)[:, None, :]
    out[:, 0, parameter_part(kind, "H")] = s.q
    out[:, 1, parameter_part(kind, "V")] = s.q
    if "O" not in kind:
        # A CAHV camera keeps O = A, but a step along O moves no pixel of it.
        return out
    on_o = tangents(o)
    turn = ((k - n * zeta)[:, None] * s.across - m[:, None] * s.along)[..., None] * (lam @ on_o.T)[:, None, :]
    out[..., parameter_part(kind, "O")] = (1.0 - m * zeta)[:, None, None] * (s.d_q @ on_o.T) + turn
    per_r, per_e = _lens_rates(lens, lam, zeta)
    out[..., parameter_part(kind, "R")] = s.across[..., None] * per_r[:, None, :]
    if "E" in kind:
        out[..., parameter_part(kind, "E")] = s.across[..., None] * per_e[:, None, :]
    return out


def _lens_rates(lens: Lens, lam: FloatArray, zeta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """dm / d(r1, r2) (n, 2) and dm / d(e0, e1, e2) (n, 3); none of the latter for CAHVOR."""
    length = np.sqrt(np.einsum("ni,ni->n", lam, lam))
    if not lens.curved:
        tau = (length / zeta) ** 2
        return np.stack([tau / zeta, tau * tau / zeta], axis=-1), np.zeros((len(lam), 0))
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
        np.stack([chi * y, chi * y * y], axis=-1) / length[:, None],
        np.stack([per_e, per_e * turn, per_e * turn * turn], axis=-1),
    )
