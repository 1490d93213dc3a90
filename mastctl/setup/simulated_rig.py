"""A simulated rig from numbers or a mast file: configuration, the mast file that is believed, the truth.

The true rig is one that the file could be the calibration of, drawn for a simulation.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from calib.files import save_bytes
from calib.files.mast_file import load_rig, save_rig
from calib.files.yaml_text import dump_mapping
from calib.geometry.cahvor import FREE, CameraModel
from calib.geometry.covariance import RigCovariance, moved_rig, stored_covariance
from calib.geometry.parameters import parameter_names, parameter_part
from calib.geometry.rig import JointErrors, Mast, Rig, RigCamera
from calib.geometry.rigid import FloatArray, Rigid, rot_x, rot_y, rot_z, tangents
from drivers.sim.axis import AxisSettings
from drivers.sim.heads import DEFAULT_HEADS, PRESETS
from drivers.sim.settings import simulation_settings
from mastctl.calibration.run import rounded_matrix
from mastctl.config import CONFIG_SCHEMA, check_cameras, load_config
from mastctl.errors import MastctlError
from mastctl.packaged import driver_of_hardware, name_schema

CONFIG, MAST, TRUE_RIG = "config.yaml", "mast.yaml", "true_rig.yaml"
NAME = "new_rig"

USUAL_LIMITS_RAD = ((-2.6, 2.6), (-1.2, 0.5))
MARGIN_RAD = 0.05
"""Between the soft limits and the ends of the head's range."""

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

LEAST_DEG = 15.0
"""Between the ends of an axis: both keep a margin."""


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


class InTheWay(MastctlError):
    """Files of a rig are there already."""

    code = "in_the_way"
    exit_code = 2


class BadRig(MastctlError):
    """Numbers of which no rig can be made: which one, and what would do."""

    code = "bad_rig"
    exit_code = 2


@dataclass(frozen=True)
class RigNumbers:
    """What a rig cannot report itself; its axes meet ``height_m`` over the ground, over the rover's origin.

    ``view_deg`` is the cameras' view across their images; beyond 110 degrees a CAHVOR lens of usual R1 and R2
    is too far from a real one. ``pan_deg`` and ``tilt_deg`` are the ends of the axes. Raises BadRig with the
    option that is out of bounds.
    """

    height_m: float
    baseline_m: float
    view_deg: float
    size_px: tuple[int, int] = (1024, 768)
    pan_deg: tuple[float, float] = (-85.0, 85.0)
    tilt_deg: tuple[float, float] = (-40.0, 30.0)
    pan_id: int = 1
    tilt_id: int = 2

    def __post_init__(self) -> None:
        bounds = [
            ("--height", self.height_m, 0.3, 5.0),
            ("--baseline", self.baseline_m, 0.02, 1.0),
            ("--view-deg", self.view_deg, 1.0, 110.0),
            *(("--size", side, 64, 4096) for side in self.size_px),
        ]
        for option, (low, high) in {"--pan-deg": self.pan_deg, "--tilt-deg": self.tilt_deg}.items():
            bounds += [(option, low, -175.0, 175.0 - LEAST_DEG), (option, high, low + LEAST_DEG, 175.0)]
        for option, value, least, most in bounds:
            if not least <= value <= most:
                raise BadRig(f"{option} is {value:g} where {least:g} to {most:g} is expected")

    def focal_px(self, width_px: int) -> float:
        """Return the focal length of images of this width, pixels."""
        return width_px / 2.0 / math.tan(math.radians(self.view_deg) / 2.0)


def camera_ahead(
    size_px: tuple[int, int], focal_px: tuple[float, float], y_m: float, middle_px: FloatArray | None = None
) -> CameraModel:
    """Return a camera of a drawing, in the head frame: it looks along x, without distortion.

    ``focal_px`` are across and down, ``y_m`` is its place to the right, ``middle_px`` (2,) that of the image
    by default.
    """
    if middle_px is None:
        middle_px = (np.array(size_px) - 1) / 2
    ahead, right, down = np.eye(3)
    return CameraModel(
        kind="CAHVOR",
        size_px=size_px,
        C=np.array([FORWARD_M, y_m, DOWN_M]),
        A=ahead,
        H=focal_px[0] * right + middle_px[0] * ahead,
        V=focal_px[1] * down + middle_px[1] * ahead,
        O=ahead,
        R=np.zeros(3),
    )


def built_rig(numbers: RigNumbers, rng: np.random.Generator) -> Rig:
    """Return the rig as a workshop builds it: mast and cameras a little off what the drawing says.

    It is known as well as a usual calibration leaves it.
    """
    mast = Mast(
        np.array([0.0, 0.0, -numbers.height_m]) + BUILT_PLACE_M * rng.standard_normal(3),
        BUILT_ANGLE_RAD * rng.standard_normal(3),
    )
    half_m = numbers.baseline_m / 2.0
    cameras = {
        f"navcam_{side}": RigCamera("head", _built_camera(numbers, y_m, rng))
        for side, y_m in (("left", -half_m), ("right", half_m))
    }
    rig = Rig(NAME, mast, cameras, {"navcam": ("navcam_left", "navcam_right")})
    known = usual_covariance(rig)
    fit = {
        "method": "stated",
        "stated": STATED,
        "parameters": list(known.names),
        "covariance": rounded_matrix(known.covariance),
    }
    return replace(rig, fit=fit, provenance={"kind": "made by mastctl rig sim new from numbers"})


def _built_camera(numbers: RigNumbers, y_m: float, rng: np.random.Generator) -> CameraModel:
    """One camera of the drawing, with the errors of its making."""
    width, height = numbers.size_px
    down_px = numbers.focal_px(width) * (1.0 + BUILT_FOCAL * rng.standard_normal())
    across_px = down_px * (1.0 + BUILT_ASPECT * rng.standard_normal())
    middle_px = np.array([width - 1, height - 1]) / 2 + BUILT_MIDDLE * width * rng.standard_normal(2)
    drawn = camera_ahead(numbers.size_px, (across_px, down_px), y_m, middle_px)
    lens_axis = drawn.A + np.array([0.0, *(BUILT_LENS_AXIS_RAD * rng.standard_normal(2))])
    bends = [usual + sigma * rng.standard_normal() for usual, sigma in LENS]
    lens = replace(drawn, O=lens_axis / np.linalg.norm(lens_axis), R=np.array([0.0, *bends]))
    x, y, z = BUILT_ANGLE_RAD * rng.standard_normal(3)
    turn = rot_x(x) @ rot_y(y) @ rot_z(z)
    return lens.moved(Rigid(turn, drawn.C - turn @ drawn.C + BUILT_PLACE_M * rng.standard_normal(3)))


def check_free(folder: Path, names: Sequence[str] = (CONFIG, MAST, TRUE_RIG)) -> None:
    """Refuse a folder in which a file would be replaced. Raises InTheWay with the first."""
    for path in (folder / name for name in names):
        if path.exists() or path.is_symlink():  # a link to nowhere too
            raise InTheWay(f"{path} exists, and nothing is replaced; another folder is expected")


def write_rover(
    believed: Rig,
    folder: Path,
    simulation: Mapping[str, Any],
    seed: int,
    limits_rad: Sequence[Sequence[float]] = USUAL_LIMITS_RAD,
    mast_file: Path | None = None,
) -> Twin:
    """Write the mast file of a rig (``mast_file``, to the byte, if it has one), a true rig that it could be
    the calibration of, and the configuration; and read all of it as the daemon does.

    ``limits_rad`` are the soft limits of pan and tilt that are wanted, within what the head reaches. Raises
    BadFile, BadOptions for ``simulation``, and as `true_twin` if no true rig can be drawn.
    """
    twin = true_twin(believed, np.random.default_rng(seed))  # before anything is written
    stated = "" if twin.by == "fit.covariance" else f": {STATED}"
    provenance = {
        "kind": "the true rig of a simulated rover, which the service never reads",
        "drawn": f"about {MAST} by {twin.by}{stated}",
        "seed": seed,
    }
    true_rig = replace(twin.true_rig, name=f"{believed.name}_true", fit={}, provenance=provenance)
    folder.mkdir(parents=True, exist_ok=True)
    if mast_file is None:
        save_rig(believed, folder / MAST)
        name_schema(folder / MAST, "mast")
    else:
        save_bytes(folder / MAST, mast_file.read_bytes())
    save_rig(true_rig, folder / TRUE_RIG)
    save_bytes(folder / CONFIG, dump_mapping(_configuration(believed, simulation, limits_rad)))
    for name, kind in ((TRUE_RIG, "mast"), (CONFIG, "config")):
        name_schema(folder / name, kind)
    config = load_config(folder / CONFIG)
    check_cameras(config, load_rig(config.mast_file).rig)
    simulation_settings(config.hardware.simulation, config.hardware.folder)
    return twin


def _configuration(
    rig: Rig, simulation: Mapping[str, Any], limits_rad: Sequence[Sequence[float]]
) -> dict[str, Any]:
    """The configuration that runs the rig: every camera simulated, soft limits inside the head's range."""
    wire = simulation.get("wire")
    head = PRESETS[simulation.get("head", DEFAULT_HEADS.get(str(wire), "ptu_d46_70"))]
    limits = {}
    for axis, (low, high) in zip(("pan", "tilt"), limits_rad, strict=True):
        own: AxisSettings = getattr(head, axis)
        margin_rad = MARGIN_RAD + own.approach_rad
        ends = max(low, own.low_rad + margin_rad), min(high, own.high_rad - margin_rad)
        limits[f"{axis}_rad"] = [round(end, 3) for end in ends]
    simulated = driver_of_hardware("simulated")
    return {
        "schema": CONFIG_SCHEMA,
        "mast_file": MAST,
        "listen": {"host": "127.0.0.1", "port": 8420},
        "pan_tilt": {"driver": simulated},
        "cameras": {name: {"driver": simulated} for name in rig.cameras},
        "limits": {
            **limits,
            "speed_rad_per_s": min(1.0, head.pan.speed_rad_per_s, head.tilt.speed_rad_per_s),
        },
        "simulation": {"rover": TRUE_RIG, **simulation},
    }


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
    # By the symmetric root, which is one: equal eigenvalues have no vectors of their own to draw by.
    step = vectors @ (np.sqrt(np.maximum(values, 0.0)) * (vectors.T @ rng.standard_normal(len(values))))
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
        rates = np.column_stack([_step(camera.model, error) for error in _errors(camera.model)])
        blocks.append(rates @ rates.T)
    return RigCovariance(tuple(names), block_diag(*blocks))


def _errors(model: CameraModel) -> list[dict[str, FloatArray]]:
    """By how much each usual error of one sigma changes a camera's letters, to first order."""
    axes, ahead = np.eye(3), model.A
    found = [{"C": LEFT_PLACE_M * axis} for axis in axes]
    turning = [letter for letter in "AHVO" if letter in model.letters]
    for axis in axes:
        found.append({one: LEFT_ANGLE_RAD * np.cross(axis, getattr(model, one)) for one in turning})
    across = {one: getattr(model, one) - (getattr(model, one) @ ahead) * ahead for one in "HV"}
    found.append({one: LEFT_FOCAL * part for one, part in across.items()})
    found += [{one: LEFT_MIDDLE_PX * ahead} for one in "HV"]
    if model.kind in FREE:
        found += [{"D": bend * np.eye(len(model.distortion))[n]} for n, bend in enumerate(LEFT_BENDS)]
    elif model.kind != "CAHV":
        found += [{"R": bend * axes[n]} for n, bend in enumerate(LEFT_BENDS, 1)]
    return found


def _step(model: CameraModel, error: Mapping[str, FloatArray]) -> FloatArray:
    """A change of a camera's letters as a step of a fit: A and O turn, and R0 stays."""
    step = np.zeros(len(parameter_names(model.kind)))
    for letter, change in error.items():
        if letter in "AO":
            change = tangents(getattr(model, letter)) @ change
        step[parameter_part(model.kind, letter)] = change[1:] if letter == "R" else change
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
