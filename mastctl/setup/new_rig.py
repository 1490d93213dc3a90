"""A rig that is not there yet: built from a few numbers, or drawn as the twin of a mast file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import RigCovariance, moved_rig, stored_covariance
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import JointErrors, Mast, Rig, RigCamera
from calib.geometry.rigid import FloatArray, Rigid, rot_x, rot_y, rot_z, tangents
from mastctl.errors import MastctlError

FORWARD_M, DOWN_M = 0.06, 0.03
"""Of the cameras from the middle of the head, as on the packaged rover."""

# How far a rig is built from its drawing, one sigma: as the packaged rover (configs/sim/rocky8.yaml).
BUILT_ANGLE_RAD = 4e-3
BUILT_PLACE_M = 2e-3
BUILT_FOCAL = 4e-3
BUILT_ASPECT = 1e-3
BUILT_MIDDLE = 7e-3  # of the width
BUILT_LENS_AXIS_RAD = 3e-3
LENS = ((-0.05, 0.01), (0.012, 0.002))  # R1 and R2: usual, sigma

WIDEST_RAD = math.radians(110)
"""Beyond, a CAHVOR lens of usual R1 and R2 is too far from a real one."""


class BadRig(MastctlError):
    """Numbers of which no rig can be made: which one, and what would do."""

    code = "bad_rig"
    exit_code = 2


@dataclass(frozen=True)
class RigNumbers:
    """What a new rig is made of.

    Attributes
    ----------
    height_m
        Of the pan and tilt axes over the ground; they meet over the rover's origin. 0.3 to 5.
    baseline_m
        Between the two cameras, 0.02 to 1.
    focal_px
        Focal length; the view along the longer side, 2 atan(side / 2 / focal_px), is 1 to 110 degrees.
    size_px
        (width, height), 64 to 4096 each.
    name
        Of the rig.

    Raises
    ------
    BadRig
        With the option of ``mastctl sim new`` that is out of bounds.
    """

    height_m: float = 1.5
    baseline_m: float = 0.2
    focal_px: float = 1290.0
    size_px: tuple[int, int] = (1024, 768)
    name: str = "new_rig"

    def __post_init__(self) -> None:
        for option, value, low, high in (
            ("--height", self.height_m, 0.3, 5.0),
            ("--baseline", self.baseline_m, 0.02, 1.0),
        ):
            if not low <= value <= high:
                raise BadRig(f"{option} is {value:g} m where {low:g} to {high:g} m are expected")
        for side in self.size_px:
            if not 64 <= side <= 4096:
                told = "x".join(str(one) for one in self.size_px)
                raise BadRig(f"--size is {told} where 64 to 4096 pixels a side are expected")
        longest_px = max(self.size_px)
        view_rad = 2.0 * math.atan(longest_px / 2.0 / self.focal_px)
        if not math.radians(1.0) <= view_rad <= WIDEST_RAD:
            low_px, high_px = (focal_of(view, longest_px) for view in (WIDEST_RAD, math.radians(1.0)))
            raise BadRig(
                f"a focal length of {self.focal_px:g} px sees {math.degrees(view_rad):.3g} degrees across "
                f"{longest_px} px where 1 to 110 degrees ({high_px:.0f} to {low_px:.0f} px) are possible"
            )


def focal_of(view_rad: float, width_px: int) -> float:
    """Return the focal length in pixels of a view across the picture."""
    return width_px / 2.0 / math.tan(view_rad / 2.0)


def built_rig(numbers: RigNumbers, rng: np.random.Generator) -> Rig:
    """Return the rig as a workshop builds it: mast and cameras a little off what the drawing says."""
    mast = Mast(
        np.array([0.0, 0.0, -numbers.height_m]) + BUILT_PLACE_M * rng.standard_normal(3),
        BUILT_ANGLE_RAD * rng.standard_normal(3),
    )
    half_m = numbers.baseline_m / 2.0
    cameras = {
        f"navcam_{side}": RigCamera("head", _built_camera(numbers, np.array([FORWARD_M, y_m, DOWN_M]), rng))
        for side, y_m in (("left", -half_m), ("right", half_m))
    }
    return Rig(numbers.name, mast, cameras, {"navcam": ("navcam_left", "navcam_right")})


def _built_camera(numbers: RigNumbers, place_m: FloatArray, rng: np.random.Generator) -> CameraModel:
    """One camera that looks ahead along x of the head."""
    width, height = numbers.size_px
    focal_px = numbers.focal_px * (1.0 + BUILT_FOCAL * rng.standard_normal())
    across_px = focal_px * (1.0 + BUILT_ASPECT * rng.standard_normal())
    middle_px = np.array([(width - 1) / 2, (height - 1) / 2])
    middle_px = middle_px + BUILT_MIDDLE * width * rng.standard_normal(2)
    ahead, right, down = np.eye(3)
    lens_axis = ahead + np.array([0.0, *(BUILT_LENS_AXIS_RAD * rng.standard_normal(2))])
    bends = [usual + sigma * rng.standard_normal() for usual, sigma in LENS]
    model = CameraModel(
        kind="CAHVOR",
        size_px=numbers.size_px,
        C=np.zeros(3),
        A=ahead,
        H=across_px * right + middle_px[0] * ahead,
        V=focal_px * down + middle_px[1] * ahead,
        O=lens_axis / np.linalg.norm(lens_axis),
        R=np.array([0.0, *bends]),
    )
    x, y, z = BUILT_ANGLE_RAD * rng.standard_normal(3)
    return model.moved(
        Rigid(rot_x(x) @ rot_y(y) @ rot_z(z), place_m + BUILT_PLACE_M * rng.standard_normal(3))
    )


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


@dataclass(frozen=True, eq=False)
class Twin:
    """A true rig beside the rig that is believed, and how it was drawn.

    Attributes
    ----------
    true_rig
        What is simulated.
    by
        ``fit.covariance`` or ``stated sigmas``.
    apart_px
        By camera: how far apart at most, over the picture, the two models see one thing 5 m away, in the
        frame that the camera is mounted on.
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
    size = len(names)
    covariance, start = np.zeros((size, size)), 0
    for block in blocks:
        end = start + len(block)
        covariance[start:end, start:end] = block
        start = end
    return RigCovariance(tuple(names), covariance)


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
        return lambda t: model.bent(place, t * LEFT_BENDS[place])

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
