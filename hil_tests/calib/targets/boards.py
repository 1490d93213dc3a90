"""Pictures of the dot board on a gravelly ground, and the truth about them, for the tests of dot finding."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel, Kind
from calib.geometry.rigid import Rigid
from calib.targets.boards import Board
from calib.targets.dots import PredictedBoard
from hil_tests.support.sim_survey.board import BoardLook, draw_board, photograph

BOARD = Board(10, 10, 0.08, 0.04, {})
LOOK = BoardLook()
ROWS, COLUMNS = (a.ravel() for a in np.mgrid[0:10, 0:10])
NAVCAM_PX, PANCAM_PX = 1290.0, 3441.0
SIZE_PX = (1024, 768)


def camera(focal_px: float, size_px: tuple[int, int] = SIZE_PX, kind: Kind = "CAHVOR") -> CameraModel:
    """A camera at the origin that looks along z, x right, y down, with a little distortion."""
    x_px, y_px = ((n - 1) / 2 for n in size_px)
    return CameraModel(
        kind,
        size_px,
        C=[0, 0, 0],
        A=[0, 0, 1],
        H=[focal_px, 0, x_px],
        V=[0, focal_px, y_px],
        R=[0, -0.05, 0.015],
    )


def pose(range_m: float, tilt: tuple[float, float] = (0, 0), roll_deg: float = 0, aside_m=(0, 0)) -> Rigid:
    """camera_from_board; ``tilt`` is (degrees, degrees round from x of the axis)."""
    angle, around = np.radians(tilt)
    tilted = Rotation.from_rotvec(angle * np.array([np.cos(around), np.sin(around), 0]))
    turn = tilted * Rotation.from_rotvec([0, 0, np.radians(roll_deg)])
    return Rigid(turn.as_matrix(), np.array([*aside_m, range_m]))


def gravel(rng: np.random.Generator, size_px: tuple[int, int] = SIZE_PX) -> np.ndarray:
    """Noise of several scales with thousands of dark and bright pebbles: the trap for loose blob finders."""
    width, height = size_px
    ground = np.full((height, width), 110.0, dtype=np.float32)
    for cell in (2, 4, 8, 32, 128):
        noise = rng.normal(0, 7, (height // cell + 2, width // cell + 2)).astype(np.float32)
        ground += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    for _ in range(2500):
        at = tuple(int(n) for n in rng.uniform(0, size_px))
        axes = tuple(int(n) for n in rng.uniform(1, 7, 2))
        cv2.ellipse(ground, at, axes, rng.uniform(0, 180), 0, 360, float(rng.uniform(40, 180)), -1)
    return ground


@dataclass(frozen=True)
class Shot:
    """A picture and what it shows."""

    image: np.ndarray
    camera: CameraModel
    camera_from_board: Rigid
    board: Board

    def true_px(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Where the centres of dots are."""
        dots = self.camera_from_board.points(self.board.dots_in_board_m(rows, columns))
        return self.camera.project(dots)[0]

    def roughly(self, rng: np.random.Generator) -> PredictedBoard:
        """A prediction that is wrong by 20 cm, 10 degrees and 5 % of the focal length."""
        axis, aside = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
        wrong = Rotation.from_rotvec(np.radians(10) * axis)
        c = self.camera_from_board
        rough = replace(
            self.camera, kind="CAHV", O=None, R=None, H=_longer(self.camera.H), V=_longer(self.camera.V)
        )
        return PredictedBoard(
            rough, Rigid(wrong.as_matrix() @ c.rotation, wrong.apply(c.translation_m + 0.2 * aside))
        )


def _longer(row: np.ndarray) -> np.ndarray:
    return row * [1.05, 1.05, 1.0]


def shoot(
    rng: np.random.Generator,
    model: CameraModel,
    camera_from_board: Rigid,
    board: Board = BOARD,
    look: BoardLook = LOOK,
    ground: np.ndarray | None = None,
    noise_dn: float = 2.0,
    shade: np.ndarray | float = 1.0,
) -> Shot:
    """Photograph the board on gravel; ``shade`` multiplies the light."""
    behind = gravel(rng, model.size_px) if ground is None else ground
    picture = draw_board(behind, model, camera_from_board, board, look) * shade
    return Shot(photograph(picture, 0.7, noise_dn, rng), model, camera_from_board, board)
