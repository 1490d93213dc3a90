"""A rig that is not there yet, built from a few numbers as a workshop builds it: a little off its drawing."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast, Rig, RigCamera
from calib.geometry.rigid import FloatArray, Rigid, rot_x, rot_y, rot_z
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
    """What a new rig is made of; its axes meet ``height_m`` over the ground, over the rover's origin.

    ``focal_px`` has to see 1 to 110 degrees along the longer side: 2 atan(side / 2 / focal_px). Raises BadRig
    with the option of ``mastctl rig sim new`` that is out of bounds.
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
                size = "x".join(map(str, self.size_px))
                raise BadRig(f"--size is {size} where 64 to 4096 pixels a side are expected")
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
