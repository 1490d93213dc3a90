"""What a simulated survey measures, how well, and the truth about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast, Rig
from calib.geometry.rigid import FloatArray, Rigid
from calib.survey.records import Sigma, Survey
from calib.targets.boards import Board

PRISMS_IN_ROVER_M = {
    "p1": (0.10, -0.25, -0.75),
    "p2": (0.10, 0.25, -0.80),
    "p3": (-0.30, -0.25, -0.90),
    "p4": (-0.30, 0.25, -0.70),
}
"""Prisms on poles, 40 to 67 cm apart, as the drawing has them."""

TAPES_IN_BOARD_M = {"a": (-0.44, -0.44, 0.0), "b": (0.44, -0.44, 0.0), "c": (-0.44, 0.44, 0.0)}
BOARD = Board(10, 10, 0.08, 0.04, {name: np.array(place) for name, place in TAPES_IN_BOARD_M.items()})


@dataclass(frozen=True)
class Ring:
    """Boards at one distance from a pair of cameras, for its calibration.

    ``also`` names a pair on the head that turns to each of them and photographs it too, so that both pairs
    hang on the same boards.
    """

    pair: str
    range_m: float
    boards: int = 4
    head_tilt_rad: float = 0.0
    also: str = ""


PAPER_RINGS = (
    Ring("pancam", 5.0, head_tilt_rad=np.radians(-5)),
    Ring("pancam", 10.0, head_tilt_rad=np.radians(-5)),
    Ring("navcam", 3.0, head_tilt_rad=np.radians(-10)),
    Ring("navcam", 6.0, head_tilt_rad=np.radians(-10)),
    Ring("hazcam", 1.5),
    Ring("hazcam", 3.0),
)


@dataclass(frozen=True)
class SurveyPlan:
    """What is measured, and how well.

    Attributes
    ----------
    rings
        Boards for the cameras; rings of pairs that a rig does not have are passed over.
    mast_boards, attitudes
        Boards for the mast over its range, and joint angles from which each is photographed.
    check_boards
        Boards for the mast cameras that are never fitted; half as many for each pair on the body.
    pan_rad, tilt_rad
        Range of pan to both sides; first and last tilt of the mast's boards.
    level_setups
        Standings of the station for mast boards; the rings of the head belong to the first.
    tilted_back_rad
        How far the rover's nose is raised in the set-up for cameras on the body.
    prisms
        How many of the four prisms are there, 3 or 4.
    sigma
        What the survey states.
    noise
        What happens, times what is stated.
    rough
        Whether rough camera poses are noted.
    """

    rings: tuple[Ring, ...] = PAPER_RINGS
    mast_boards: int = 8
    attitudes: int = 1
    check_boards: int = 4
    pan_rad: float = 1.0
    tilt_rad: tuple[float, float] = (-0.1, -0.8)
    level_setups: int = 1
    tilted_back_rad: float = float(np.radians(30))
    prisms: int = 4
    sigma: Sigma = field(default_factory=lambda: Sigma(0.001, 0.1))
    noise: float = 1.0
    rough: bool = True


@dataclass(frozen=True, eq=False)
class SurveyTruth:
    """What no calibration may read.

    Attributes
    ----------
    rig
        The true rig.
    rover_from_station, site_from_rover
        By set-up; the ground is z = 0 of the site.
    rover_from_board
        By set-up and placement.
    prisms_in_rover_m
        Where the prisms are, the drawing being off by its sigma.
    joints_rad
        True pan and tilt by image; (0, 0) for a camera on the body.
    """

    rig: Rig
    rover_from_station: Mapping[str, Rigid]
    site_from_rover: Mapping[str, Rigid]
    rover_from_board: Mapping[tuple[str, str], Rigid]
    prisms_in_rover_m: Mapping[str, FloatArray]
    joints_rad: Mapping[str, tuple[float, float]]

    def camera_from_board(self, survey: Survey, image: str) -> tuple[CameraModel, Rigid]:
        """Return the true camera of an image in its own mount's frame, and the board's pose there."""
        row = next(i for i in survey.images if i.name == image)
        camera = self.rig.cameras[row.camera]
        pose = self.rover_from_board[row.setup, row.placement]
        if camera.on == "head":
            pose = rover_from_head(self.rig.mast, *self.joints_rad[image]).inverse @ pose
        return camera.model, pose


def rover_from_head(mast: Mast, pan_rad: float, tilt_rad: float) -> Rigid:
    """Return the head's true pose: the documented kinematics, written with SciPy's rotations."""
    panned = Rotation.from_euler("XYZ", mast.rotation_rad) * Rotation.from_rotvec([0, 0, pan_rad])
    head = panned * Rotation.from_rotvec([mast.axis_twist_rad, 0, 0]) * Rotation.from_rotvec([0, tilt_rad, 0])
    return Rigid(head.as_matrix(), mast.translation_m + panned.apply([mast.axis_offset_m, 0.0, 0.0]))
