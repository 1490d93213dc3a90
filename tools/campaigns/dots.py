"""Draw boards at random poses on gravel, find their dots, and print how well, by camera, range and tilt.

The truth is the projected centre of each dot. Every prediction is wrong by up to 20 cm, 10 degrees and 5 % of
the focal length, as rough cameras of a survey may be. Stresses: more noise, little contrast, uneven light.

    .venv/bin/python -m tools.campaigns.dots --cases 12 --seed 1
    .venv/bin/python -m tools.campaigns.dots --cases 4 --stress contrast --pictures FOLDER
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from calib.targets.boards import Board
from calib.targets.dot_grid import DetectionFailure
from calib.targets.dot_order import PredictedBoard
from calib.targets.dots import DotsFound, find_dots
from drivers.sim.render import Renderer
from drivers.sim.scene import SceneSettings, build_scene
from tools.campaigns.board_photos import keep_pictures
from tools.command import end, options, run_cases
from tools.sim_survey.board import BoardLook, draw_board, half_size_m, photograph

BOARD = Board(10, 10, 0.08, 0.04, {})
SIZE_PX = (1024, 768)
NAVCAM_PX, PANCAM_PX = 1290.0, 3441.0
CELLS = [(NAVCAM_PX, r) for r in (3.0, 4.5, 6.0, 8.0, 10.0)] + [(PANCAM_PX, r) for r in (5.0, 7.0, 10.0)]
TILTS_DEG = (0.0, 15.0, 30.0, 45.0)
ROLL_DEG = 15.0
WRONG_BY_M, WRONG_BY_RAD, WRONG_FOCAL = 0.20, np.radians(10.0), 0.05
LOOK = BoardLook()
R_LENS = [0.0, -0.05, 0.015]


@dataclass(frozen=True)
class Stress:
    """What a picture suffers."""

    blur_px: float = 0.7
    noise_dn: float = 2.0
    look: BoardLook = LOOK
    gradient: float = 0.0


STRESSES = {
    "none": Stress(),
    "noise": Stress(noise_dn=6.0),
    "blur": Stress(blur_px=1.5),
    "sharp": Stress(blur_px=0.3),
    "contrast": Stress(noise_dn=3.0, look=BoardLook(150.0, 90.0)),
    "gradient": Stress(gradient=0.6),
}


@dataclass(frozen=True)
class BoardTrial:
    """A picture of a board, and what it shows."""

    image: np.ndarray
    camera: CameraModel
    camera_from_board: Rigid
    predicted: PredictedBoard


@dataclass(frozen=True)
class DotsOutcome:
    """How a trial went: errors (n, 2) px and their sigmas, or why it failed."""

    errors_px: np.ndarray
    sigma_px: np.ndarray
    failure: str
    order_wrong: bool
    seconds: float


def camera_of(focal_px: float, wrong: float = 0.0) -> CameraModel:
    """Return a camera with lens distortion that looks along z; with ``wrong``, a rough CAHV one."""
    f = focal_px * (1.0 + wrong)
    return CameraModel(
        "CAHV" if wrong else "CAHVOR",
        SIZE_PX,
        C=[0.0, 0.0, 0.0],
        A=[0.0, 0.0, 1.0],
        H=[f, 0.0, (SIZE_PX[0] - 1) / 2],
        V=[0.0, f, (SIZE_PX[1] - 1) / 2],
        R=R_LENS,
    )


@cache
def ground_renderer(seed: int) -> Renderer:
    """Return what draws gravel with stones."""
    return Renderer(build_scene(SceneSettings(seed=seed)), workers=1)


@cache
def ground(seed: int, focal_px: float, range_m: float, azimuth_rad: float) -> np.ndarray:
    """Return what a camera 1.5 m up sees that looks at the ground ``range_m`` away, noise-free."""
    down = np.arcsin(min(1.0, 1.5 / range_m))
    turn = Rotation.from_rotvec([0, 0, azimuth_rad]) * Rotation.from_rotvec([0, -down, 0])
    axes = turn.as_matrix() @ np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    site_from_camera = Rigid(axes, np.array([0.0, 0.0, -1.5]))
    return ground_renderer(seed).image(camera_of(focal_px), site_from_camera)


def random_pose(rng: np.random.Generator, camera: CameraModel, range_m: float, tilt_rad: float) -> Rigid:
    """Return camera_from_board: tilted about a random axis, whole in the image wherever there is room."""
    axis_rad = rng.uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(tilt_rad * np.array([np.cos(axis_rad), np.sin(axis_rad), 0.0]))
    roll = Rotation.from_rotvec([0, 0, np.radians(rng.uniform(-ROLL_DEG, ROLL_DEG))])
    turn = (tilt * roll).as_matrix()
    corners = np.array([[x, y, 0.0] for x in (-1, 1) for y in (-1, 1)])
    corners = corners * [*half_size_m(BOARD, replace(LOOK, margin_m=0.04)), 0.0]
    for shrink in np.repeat(np.linspace(1.0, 0.0, 40), 4):
        pixel = (np.array(SIZE_PX) - 1) * (0.5 + 0.5 * shrink * rng.uniform(-1, 1, 2))
        ray = camera.ray(pixel).directions
        pose = Rigid(turn, range_m * ray)
        seen, valid = camera.project(pose.points(corners))
        if valid.all() and (seen > 6).all() and (seen < np.array(SIZE_PX) - 7).all():
            return pose
    raise RuntimeError(f"a board {range_m} m away does not fit into the image")


def make_trial(
    rng: np.random.Generator, behind: np.ndarray, focal_px: float, pose: Rigid, stress: Stress
) -> BoardTrial:
    """Return a picture of the board in front of the ground, and a rough prediction of the board's pose."""
    camera = camera_of(focal_px)
    picture = draw_board(behind, camera, pose, BOARD, stress.look, samples=6)
    if stress.gradient:
        angle = rng.uniform(0, 2 * np.pi)
        y, x = np.mgrid[0 : SIZE_PX[1], 0 : SIZE_PX[0]]
        along = (x * np.cos(angle) + y * np.sin(angle)).astype(np.float32)
        picture = picture * (1.0 - stress.gradient * (along - along.min()) / np.ptp(along))
    image = photograph(picture, stress.blur_px, stress.noise_dn, rng)
    axis = rng.normal(size=3)
    wrong = Rotation.from_rotvec(rng.uniform(0, WRONG_BY_RAD) * axis / np.linalg.norm(axis))
    aside = rng.normal(size=3)
    shift = rng.uniform(0, WRONG_BY_M) * aside / np.linalg.norm(aside)
    predicted = Rigid(wrong.as_matrix() @ pose.rotation, wrong.apply(pose.translation_m + shift))
    rough = camera_of(focal_px, rng.choice([-1, 1]) * rng.uniform(0.001, WRONG_FOCAL))
    return BoardTrial(image, camera, pose, PredictedBoard(rough, predicted))


def judge(trial: BoardTrial) -> tuple[DotsOutcome, DotsFound | DetectionFailure]:
    """Find the dots and compare them with the truth."""
    start_s = time.perf_counter()
    found = find_dots(trial.image, BOARD, trial.predicted)
    seconds = time.perf_counter() - start_s
    if isinstance(found, DetectionFailure):
        return DotsOutcome(np.empty((0, 2)), np.empty(0), found.reason, False, seconds), found
    centres = BOARD.dots_in_board_m(found.rows, found.columns)
    truth, _ = trial.camera.project(trial.camera_from_board.points(centres))
    errors = found.pixels_px - truth
    if np.median(np.linalg.norm(errors, axis=1)) > 2.0:
        return DotsOutcome(np.empty((0, 2)), np.empty(0), "", True, seconds), found
    return DotsOutcome(errors, found.sigma_px, "", False, seconds), found


@dataclass(frozen=True)
class Cell:
    """Boards of one focal length, range and tilt; with ``pictures`` those worth a look are kept."""

    focal_px: float
    range_m: float
    tilt_deg: float
    poses: int
    seed: int
    stress: Stress
    pictures: bool = False


@dataclass(frozen=True)
class CellFound:
    """What became of a cell: an outcome a pose, and pictures (PNG) by their names."""

    outcomes: list[DotsOutcome]
    pictures: dict[str, bytes] = field(default_factory=dict)


def run_cell(cell: Cell) -> CellFound:
    """Draw a cell's boards and find their dots."""
    views = [ground(cell.seed, cell.focal_px, cell.range_m, a) for a in (-0.8, 0.0, 0.8)]
    rng = np.random.default_rng([cell.seed, int(cell.focal_px), int(10 * cell.range_m), int(cell.tilt_deg)])
    told = CellFound([])
    for k in range(cell.poses):
        pose = random_pose(rng, camera_of(cell.focal_px), cell.range_m, np.radians(cell.tilt_deg))
        trial = make_trial(rng, views[k % len(views)], cell.focal_px, pose, cell.stress)
        outcome, found = judge(trial)
        told.outcomes.append(outcome)
        if cell.pictures and (k == 0 or outcome.failure or outcome.order_wrong):
            name = f"f{cell.focal_px:.0f}_{cell.range_m:g}m_{cell.tilt_deg:g}deg_{k}.png"
            told.pictures[name] = cv2.imencode(".png", overlay(trial.image, found))[1].tobytes()
    return told


def overlay(image: np.ndarray, found: DotsFound | DetectionFailure) -> np.ndarray:
    """Return the picture with a cross and "row,column" on each dot, or the reason of failure."""
    shown = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    if isinstance(found, DetectionFailure):
        cv2.putText(shown, found.reason, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 255), 1)
        return shown
    for row, column, pixel in zip(found.rows, found.columns, found.pixels_px, strict=True):
        at = tuple(np.rint(pixel).astype(int).tolist())
        cv2.drawMarker(shown, at, (0, 255, 0), cv2.MARKER_CROSS, 5)
        if row in (0, 9) or column in (0, 9):
            cv2.putText(shown, f"{row},{column}", at, cv2.FONT_HERSHEY_SIMPLEX, 0.3, (0, 160, 255), 1)
    return shown


def tell(cell: Cell, outcomes: list[DotsOutcome]) -> int:
    """Print a cell's row and why boards were not found; return how many were not, or in a wrong order."""
    errors = np.concatenate([o.errors_px for o in outcomes])
    sigma = np.concatenate([o.sigma_px for o in outcomes])[:, None]
    failures = [o.failure for o in outcomes if o.failure]
    wrong = sum(o.order_wrong for o in outcomes)
    ms = [1e3 * o.seconds for o in outcomes]
    line = f"{cell.focal_px:6.0f}  {cell.range_m:5.1f}  {cell.tilt_deg:4.0f} |"
    if len(errors):
        rms, worst = np.sqrt(np.mean(errors**2)), np.abs(errors).max()
        line += f" {rms:.4f}  {worst:.4f}  {np.sqrt(np.mean((errors / sigma) ** 2)):9.2f} |"
    else:
        line += " " * 27 + "|"
    print(f"{line} {len(failures):6d}  {wrong:5d} | {np.median(ms):9.0f}  {max(ms):8.0f}")
    for reason in sorted(set(failures)):
        print(f"        failed: {reason}")
    return len(failures) + wrong


def main() -> int:
    """Run the campaign and print its table."""
    parser = options(__doc__, 6, "poses for each range and tilt")
    parser.add_argument("--stress", choices=sorted(STRESSES), default="none")
    parser.add_argument("--pictures", type=Path, help="folder for pictures with what was found")
    args = parser.parse_args()
    stress, pictures = STRESSES[args.stress], args.pictures is not None
    cells = [
        Cell(focal_px, range_m, tilt_deg, args.cases, args.seed, stress, pictures)
        for focal_px, range_m in CELLS
        for tilt_deg in TILTS_DEG
    ]
    label = "{0.focal_px:g} px, {0.range_m:g} m, {0.tilt_deg:g} deg".format
    founds = run_cases(args, "cells", run_cell, cells, label)
    print(f"stress {args.stress}, seed {args.seed}, {args.cases} poses a line; px per axis")
    print("  f px  range  tilt |   rms   worst  rms/sigma | failed  order | median ms  worst ms")
    bad = sum(tell(cell, found.outcomes) for cell, found in zip(cells, founds, strict=True))
    keep_pictures(args.pictures, founds)
    return 1 if bad else 0


if __name__ == "__main__":
    end(main)
