"""The true twin of a mast file: a rig that the file could be the calibration of, drawn for a simulation."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from calib.geometry.cahvor import FREE, CameraModel
from calib.geometry.covariance import RigCovariance, moved_rig, stored_covariance
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import JointErrors, Rig
from calib.geometry.rigid import FloatArray, Rigid, rot_x, rot_y, rot_z, tangents
from mastctl.errors import MastctlError

# LEFT_...: what a survey leaves open, one sigma. Mast: four prisms half a metre apart, 1 mm each. Cameras: so
# that what they see 5 m away is some 0.1 to 0.3 px off, as with the packaged mast file.
LEFT_MAST_PLACE_M = 1e-3
LEFT_MAST_ANGLE_RAD = 1.4e-3
LEFT_PLACE_M = 2e-4
LEFT_ANGLE_RAD = 5e-5
LEFT_FOCAL = 1e-4
LEFT_MIDDLE_PX = 0.1
LEFT_BENDS = (5e-4, 1e-3)
STATED = (
    f"mast {LEFT_MAST_PLACE_M * 1e3:g} mm and {LEFT_MAST_ANGLE_RAD * 1e3:g} mrad; "
    f"each camera {LEFT_PLACE_M * 1e3:g} mm, {LEFT_ANGLE_RAD * 1e3:g} mrad, "
    f"focal length {LEFT_FOCAL * 1e2:g} %, middle of the picture {LEFT_MIDDLE_PX:g} px, "
    f"R1 {LEFT_BENDS[0]:g}, R2 {LEFT_BENDS[1]:g} (one sigma, independent)"
)

_SMALL = 1e-6  # of a sigma: steps of the differences that turn these into a camera's own parameters
GRID = 9


class BadRig(MastctlError):
    """Numbers of which no rig can be made: which one, and what would do."""

    code = "bad_rig"
    exit_code = 2


@dataclass(frozen=True, eq=False)
class Twin:
    """A true rig, drawn ``by`` ``fit.covariance`` or ``stated sigmas`` about the one that is believed.

    ``apart_px``: by camera how far apart at most, over the image, the two models see one thing 5 m away, in
    the frame that the camera is mounted on.
    """

    true_rig: Rig
    by: str
    apart_px: dict[str, float]


def true_twin(believed: Rig, rng: np.random.Generator) -> Twin:
    """Return a true rig that ``believed`` could be the calibration of.

    It is drawn from a normal distribution about ``believed`` with the covariance of the file's fit, or with
    that of a usual calibration (``STATED``) where the file has none. Raises CalibError if the covariance of
    the file is none, BadRig if what is drawn is no camera any more: it is far too wide.
    """
    known = stored_covariance(believed)
    by = "stated sigmas" if known is None else "fit.covariance"
    if known is None:
        known = usual_covariance(believed)
    values, vectors = np.linalg.eigh(known.covariance)
    step = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
    try:
        true_rig = moved_rig(believed, known.names, step)
        drawn = (true_rig.joints.pan, true_rig.joints.tilt)
        pan, tilt = (replace(axis, backlash_rad=max(axis.backlash_rad, 0.0)) for axis in drawn)
        true_rig = replace(true_rig, joints=JointErrors(pan, tilt))
        apart = {name: _apart_px(believed, true_rig, name) for name in believed.cameras}
    except ValueError as error:
        raise BadRig(f"a rig drawn with {by} is none ({error}): they are far too wide") from None
    lost = [name for name, px in apart.items() if not np.isfinite(px)]
    if lost:
        raise BadRig(f"{lost[0]} drawn with {by} sees hardly anything any more: they are far too wide")
    return Twin(true_rig, by, apart)


def usual_covariance(rig: Rig) -> RigCovariance:
    """Return what a usual calibration leaves open of a rig, in the parameters of a fit; see ``STATED``."""
    names = [f"mast.{kind}.{axis}" for kind in ("translation_m", "rotation_rad") for axis in "xyz"]
    blocks = [np.diag([LEFT_MAST_PLACE_M] * 3 + [LEFT_MAST_ANGLE_RAD] * 3) ** 2]
    for name, camera in rig.cameras.items():
        names += [f"cameras.{name}.{part}" for part in parameter_names(camera.model.kind)]
        rates = _rates(camera.model)
        blocks.append(rates @ rates.T)
    return RigCovariance(tuple(names), block_diag(*blocks))


def _rates(model: CameraModel) -> FloatArray:
    """How the parameters of a fit (p,) go with each usual error, (p, n), for errors of one sigma."""
    errors = _errors(model)
    return np.column_stack(
        [(_step(model, error(_SMALL)) - _step(model, error(-_SMALL))) / (2 * _SMALL) for error in errors]
    )


def _errors(model: CameraModel) -> list[Callable[[float], CameraModel]]:
    """One function a usual error: the camera with so many sigmas of it."""

    def shifted(axis: int) -> Callable[[float], CameraModel]:
        return lambda t: model.moved(Rigid(np.eye(3), t * LEFT_PLACE_M * np.eye(3)[axis]))

    def turned(turn: Callable[[float], FloatArray]) -> Callable[[float], CameraModel]:
        def error(t: float) -> CameraModel:
            rotation = turn(t * LEFT_ANGLE_RAD)
            return model.moved(Rigid(rotation, model.C - rotation @ model.C))

        return error

    def zoomed(t: float) -> CameraModel:
        h, v = (part + t * LEFT_FOCAL * (part - (part @ model.A) * model.A) for part in (model.H, model.V))
        return replace(model, H=h, V=v)

    def bent(place: int) -> Callable[[float], CameraModel]:
        if model.kind in FREE:
            rate = LEFT_BENDS[place] * np.eye(len(model.distortion))[place]
            return lambda t: replace(model, distortion=model.distortion + t * rate)
        return lambda t: replace(model, R=model.R + t * LEFT_BENDS[place] * np.eye(3)[place + 1])

    found = [shifted(axis) for axis in range(3)] + [turned(turn) for turn in (rot_x, rot_y, rot_z)] + [zoomed]
    found += [
        lambda t: replace(model, H=model.H + t * LEFT_MIDDLE_PX * model.A),
        lambda t: replace(model, V=model.V + t * LEFT_MIDDLE_PX * model.A),
    ]
    if model.kind != "CAHV":
        found += [bent(0), bent(1)]
    return found


def _step(model: CameraModel, other: CameraModel) -> FloatArray:
    """The step of a fit from one camera to another near it, to first order."""
    parts = {
        letter: getattr(other, letter) - getattr(model, letter) for letter in model.letters if letter != "D"
    }
    parts["A"] = tangents(model.A) @ parts["A"]
    if "O" in parts:
        parts["O"], parts["R"] = tangents(model.O) @ parts["O"], parts["R"][1:]
    if "D" in model.letters:
        parts["D"] = other.distortion - model.distortion
    step = np.zeros(len(parameter_names(model.kind)))
    for letter, part in parts.items():
        step[parameter_part(model.kind, letter)] = part
    return step


def _apart_px(believed: Rig, true_rig: Rig, name: str) -> float:
    """The largest distance over a grid of pixels; not-a-number if most see nothing any more."""
    model, true_model = believed.cameras[name].model, true_rig.cameras[name].model
    width, height = model.size_px
    x_px, y_px = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    pixels = np.stack([x_px.ravel(), y_px.ravel()], axis=-1)
    rays = model.ray(pixels)
    seen, valid = true_model.project(rays.origins_m + 5.0 * rays.directions)
    both = rays.valid & valid
    if both.sum() < rays.valid.sum() / 2:
        return float("nan")
    return float(np.linalg.norm(seen - pixels, axis=1)[both].max(initial=0.0))
