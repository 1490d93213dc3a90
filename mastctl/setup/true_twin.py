"""The true twin of a mast file: a rig that the file could be the calibration of, drawn for a simulation."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.linalg import block_diag

from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import RigCovariance, moved_rig, stored_covariance
from calib.geometry.parameters import focus_and_turn_rates, parameter_names, parameter_part
from calib.geometry.rig import JointErrors, Rig
from calib.geometry.rigid import FloatArray
from mastctl.setup.new_rig import BadRig

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

GRID = 9


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
    that of a usual calibration (``STATED``) where the file has none.

    Raises
    ------
    CalibError
        If the covariance of the file is none.
    BadRig
        If what is drawn is no camera any more: the covariance is far too wide.
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
    """The step of a fit (p,) by each usual error of one sigma: (p, 11), for a CAHV camera (p, 9)."""
    rows = np.eye(len(parameter_names(model.kind)))
    part = partial(parameter_part, model.kind)
    columns = [
        LEFT_PLACE_M * rows[:, part("C")],
        focus_and_turn_rates(model) * [LEFT_FOCAL, *[LEFT_ANGLE_RAD] * 3],
        *(LEFT_MIDDLE_PX * rows[:, part(letter)] @ model.A[:, None] for letter in "HV"),
    ]
    if model.kind != "CAHV":
        lens = part("D" if "D" in model.letters else "R").start
        columns.append(rows[:, lens : lens + 2] * LEFT_BENDS)
    return np.hstack(columns)


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
