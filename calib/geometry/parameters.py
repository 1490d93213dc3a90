"""A camera's free parameters, and how its pixels depend on them.

A fit moves a camera by a *step* in this order: C (3, metres), A (2, radians), H (3), V (3, pixels), then for
CAHVOR and CAHVORE O (2, radians) and R1, R2, then for CAHVORE E0, E1, E2; for OpenCV's families D, the
coefficients in OpenCV's order. A and O are unit vectors: they move
in their tangent plane, along the two directions of ``tangents``. R0 is not among them: I + r0 (I - OOᵀ) is a
linear map that H, V and A absorb, so R0 stays what it is (0 in every fit).

A point is seen along q = u x + v y + z, with its slopes (u, v) and the axes x, y, z of the lens frame, and
(X, Y) = (H.q, V.q) / (A.q). A turn omega of the lens frame moves (X, Y) by omega.(q x d pixel/dq - d x d
pixel/d point), d = P - C. A step o of O turns the frame of CAHVOR and CAHVORE by O x o; OpenCV's lenses turn
with A and V: a step a of A turns their frame by (-a.y, a.x, cy/fy a.x), a step of V about A by -dV.x / fy.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from calib.geometry.cahvor import COEFFICIENTS, FREE, CameraModel, letters_of
from calib.geometry.lenses import opencv
from calib.geometry.rigid import FloatArray, crossed, crossed_rows, rigid_twists, tangents

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
    **{kind: tuple(f"D.{name}" for name in opencv.NAMES[:count]) for kind, count in COEFFICIENTS.items()},
    "OPENCV_FISHEYE": ("D.k1", "D.k2", "D.k3", "D.k4"),
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


def twist_rates(model: CameraModel) -> FloatArray:
    """Return how a camera's step (p,) follows a small motion of it, a turn about 0 and a shift: (p, 6)."""
    rates = np.zeros((len(parameter_names(model.kind)), 6))
    for letter in "CAHVO":
        if letter in model.letters:
            vector: FloatArray = getattr(model, letter)
            turn = crossed(np.eye(3), vector).T
            rates[parameter_part(model.kind, letter), :3] = (
                tangents(vector) @ turn if letter in "AO" else turn
            )
    rates[parameter_part(model.kind, "C"), 3:] = np.eye(3)
    return rates


def focus_and_turn_rates(model: CameraModel) -> FloatArray:
    """Return how a camera's step (p,) follows a focal length longer by a part of itself, and a small turn
    about its C: (p, 4)."""
    zoom = np.zeros((len(parameter_names(model.kind)), 1))
    for letter in "HV":
        vector: FloatArray = getattr(model, letter)
        zoom[parameter_part(model.kind, letter), 0] = vector - (vector @ model.A) * model.A
    return np.hstack([zoom, twist_rates(model) @ rigid_twists(model.C)[:3].T])


def carried_errors(model: CameraModel, moved: CameraModel, rotation: FloatArray) -> FloatArray:
    """Return what a camera's errors (p,) become in a motion that turns by ``rotation`` (3, 3): (p, p)."""
    errors = np.eye(len(parameter_names(model.kind)))
    for letter in "CAHVO":
        if letter in model.letters:
            part, turn = parameter_part(model.kind, letter), rotation
            if letter in "AO":
                turn = tangents(getattr(moved, letter)) @ rotation @ tangents(getattr(model, letter)).T
            errors[part, part] = turn
    return errors


def predict(model: CameraModel, points_m: FloatArray) -> Prediction:
    """Return pixels of points (n, 3), metres in the model's frame, with derivatives.

    Points that have no pixel come out as not-a-number. Each number's values of all points lie side by side in
    memory, so that numpy's loops run along them.
    """
    points = np.asarray(points_m, dtype=np.float64)
    d = np.subtract(points.T, model.C[:, None], order="C")
    with np.errstate(all="ignore"):
        pixels, d_points, valid = model.projection.forward(points, model.C, model.lens_axes, True)
        d_step = _step_rates(model, d, pixels, d_points)
    d_step[..., ~valid] = np.nan
    return Prediction(pixels.T, d_step.transpose(2, 0, 1), d_points.transpose(2, 0, 1), valid)


def _step_rates(model: CameraModel, d: FloatArray, pixels: FloatArray, d_points: FloatArray) -> FloatArray:
    """d pixel / d step (2, p, n) of points d (3, n) from C, pixels (2, n), with their rates (2, 3, n)."""
    kind, lens, axes = model.kind, model.lens, model.lens_axes
    slopes = model.projection.slope_from_pixel @ np.concatenate([pixels, np.ones((1, d.shape[1]))])
    q = axes[:2].T @ (slopes[:2] / slopes[2]) + axes[2][:, None]
    depth = model.A @ q
    q /= depth
    both = np.stack([model.H, model.V])
    d_q = (both[..., None] - pixels[:, None] * model.A[:, None]) / depth
    by_slope = axes[:2] @ d_q
    d_step = np.zeros((2, len(parameter_names(kind)), d.shape[1]))

    def to(letter: str) -> FloatArray:
        return d_step[:, parameter_part(kind, letter)]

    on_a = tangents(model.A)
    np.negative(d_points, out=to("C"))
    np.multiply(-pixels[:, None], on_a @ q, out=to("A"))
    to("H")[0] = to("V")[1] = q
    if kind == "CAHV":
        return d_step
    d_turn = crossed_rows(q * depth, d_q) - crossed_rows(d, d_points)
    bent = lens.coefficient_rates(axes @ d)
    rates = by_slope[:, 0, None] * bent[0] + by_slope[:, 1, None] * bent[1]
    if kind in FREE:
        (x, y, z), (_, fy, cy) = axes, model.camera_matrix[1]
        turns = np.stack([-on_a @ y, on_a @ x, cy / fy * (on_a @ x)], axis=1) @ axes
        to("A")[...] += turns @ d_turn
        to("V")[...] += (z @ d_turn)[:, None] * (-x / fy)[:, None]
        to("D")[...] = rates
    else:
        np.matmul(np.cross(model.O, tangents(model.O)), d_turn, out=to("O"))
        to("R")[...] = rates[:, :2]
        if kind == "CAHVORE":
            to("E")[...] = rates[:, 2:]
    return d_step
