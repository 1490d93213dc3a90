"""Draw boards at random poses, find their corners, and print how well, by board and by what spoils pictures.

Most are drawn by casting the rays of a CAHVOR camera with lens distortion at the board
(drivers/sim/bench_boards.py); for one case OpenCV's own drawing of a ChArUco board is warped by a
homography, 64 texels a pixel. Truth is where the camera, or the homography, has each corner. Beside the
corners found here stand those of OpenCV's CharucoDetector on the same pictures.

    .venv/bin/python -m tools.campaigns.corners --poses 10 --seed 1
    .venv/bin/python -m tools.campaigns.corners --poses 3 --kind aprilgrid --pictures FOLDER
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.boards import AnyBoard, AprilGrid, Charuco, Checkerboard, Corners, DotBoard
from calib.camera.cahvor import CameraModel
from calib.corners import CornersNotFound, find_corners
from calib.rigid import Rigid
from drivers.sim.bench_boards import BenchBoard, BenchBoards
from mastctl.cli.output import at_least
from mastctl.cli.tasks import add_task_options, results_of
from tools.arguments import end

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]

BOARDS: dict[str, AnyBoard] = {
    "charuco": Charuco(12, 9, 0.04, 0.03, "DICT_5X5_100"),
    "aprilgrid": AprilGrid(6, 5, 0.06, 0.018),
    "checkerboard": Checkerboard(12, 9, 0.04),
    "dots": DotBoard(14, 10, 0.035, 0.0175),
}
SIZE_PX, FOCAL_PX = (1024, 768), 1290.0
MIDDLE = (np.array(SIZE_PX) - 1) / 2
OUTLIER_PX = 1.0
"""A corner so far from its truth is another corner: a wrong id."""


@dataclass(frozen=True)
class Case:
    """What a picture suffers; blur and noise are standard deviations, ``hidden`` a part of the corners."""

    name: str
    slant_deg: tuple[float, float] = (0.0, 40.0)
    range_m: tuple[float, float] = (0.7, 1.3)
    blur_px: float = 0.7
    noise_dn: float = 2.0
    smear_px: int = 0
    hidden: float = 0.0
    contrast: float = 1.0
    gradient: float = 0.0


CASES = {
    case.name: case
    for case in (
        Case("sharp"),
        Case("very sharp", blur_px=0.4),
        Case("slant 60", slant_deg=(55.0, 60.0)),
        Case("far", range_m=(1.6, 2.2)),
        Case("half hidden", hidden=0.5),
        Case("blur 1.5", blur_px=1.5),
        Case("blur 2.5", blur_px=2.5),
        Case("smear 6 px", smear_px=6),
        Case("noise 8", noise_dn=8.0),
        Case("dark", contrast=0.12),
        Case("uneven light", gradient=0.7),
        Case("opencv's drawing"),
    )
}


@dataclass(frozen=True)
class Cell:
    """Pictures of one board in one case."""

    kind: str
    case: Case
    poses: int
    seed: int
    pictures: bool = False


@dataclass(frozen=True)
class Outcome:
    """One picture: errors (n, 2) px, sigmas (n,), corners in view, OpenCV's errors, the reason if none."""

    errors_px: FloatArray
    sigma_px: FloatArray
    in_view: int
    theirs_px: FloatArray
    reason: str
    seconds: float


@dataclass(frozen=True)
class Found:
    """What became of a cell: an outcome a picture, and pictures (PNG) by their names."""

    outcomes: list[Outcome]
    pictures: dict[str, bytes] = field(default_factory=dict)


class Grey:
    """A scene of nothing but soft shades."""

    def image(
        self, camera: CameraModel, pose: Rigid, samples: int = 2, rows: tuple[int, int] | None = None
    ) -> NDArray[np.float32]:
        """Return its picture."""
        width, height = camera.size_px
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        return np.asarray(110.0 + 40.0 * np.sin(x / 61.0) * np.cos(y / 47.0), dtype=np.float32)

    def close(self) -> None:
        """Nothing is held."""


CAMERA = CameraModel(
    "CAHVOR", SIZE_PX, C=[0, 0, 0], A=[0, 0, 1], H=[FOCAL_PX, 0, MIDDLE[0]], V=[0, FOCAL_PX, MIDDLE[1]],
    R=[0.0, -0.05, 0.015],
)  # fmt: skip


def random_pose(rng: np.random.Generator, case: Case) -> Rigid:
    """Return camera_from_board: slanted about a random axis, its middle in the middle half of the image."""
    about = rng.uniform(0, 2 * np.pi)
    slant = np.radians(rng.uniform(*case.slant_deg))
    tilt = Rotation.from_rotvec(slant * np.array([np.cos(about), np.sin(about), 0.0]))
    roll = Rotation.from_rotvec([0, 0, np.radians(rng.uniform(-20.0, 20.0))])
    pixel = MIDDLE * (1.0 + 0.35 * rng.uniform(-1, 1, 2))
    ray = CAMERA.ray(pixel).directions
    return Rigid((tilt * roll).as_matrix(), rng.uniform(*case.range_m) * ray)


def drawn(rng: np.random.Generator, board: AnyBoard, case: Case) -> tuple[NDArray[np.float32], FloatArray]:
    """Return a noise-free picture and where every corner of the board truly is, (n, 2)."""
    pose = random_pose(rng, case)
    if case.name == "opencv's drawing":
        assert isinstance(board, Charuco)
        return warped(board, pose)
    scene = BenchBoards(Grey())
    scene.put("board", BenchBoard(board, pose))
    truth, _ = CAMERA.project(pose.points(board.in_board_m(board.ids)))
    return scene.image(CAMERA, Rigid.identity()), np.asarray(truth)


def warped(board: Charuco, pose: Rigid) -> tuple[NDArray[np.float32], FloatArray]:
    """OpenCV's drawing of its board through a homography, and its own corners."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    theirs = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)
    texels, finer = 280, 8  # of a square, and of a pixel along each side
    paper = theirs.generateImage((board.columns * texels, board.rows * texels), marginSize=0, borderBits=1)
    paper = cv2.copyMakeBorder(paper, texels, texels, texels, texels, cv2.BORDER_CONSTANT, value=255)
    from_texel = np.array([[1, 0, -texels + 0.5], [0, 1, -texels + 0.5], [0, 0, texels / board.square_m]])
    shift = np.array(
        [[1, 0, -board.columns * board.square_m / 2], [0, 1, -board.rows * board.square_m / 2], [0, 0, 1]]
    )
    to_camera = np.column_stack([pose.rotation[:, :2], pose.translation_m])
    matrix = np.array([[FOCAL_PX, 0, MIDDLE[0]], [0, FOCAL_PX, MIDDLE[1]], [0, 0, 1]])
    to_fine = np.array([[finer, 0, (finer - 1) / 2], [0, finer, (finer - 1) / 2], [0, 0, 1]])
    to_image = matrix @ to_camera @ shift
    size = (SIZE_PX[0] * finer, SIZE_PX[1] * finer)
    fine = cv2.warpPerspective(
        paper,
        to_fine @ to_image @ from_texel,
        size,
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=128,
    )
    light = cv2.resize(fine, SIZE_PX, interpolation=cv2.INTER_AREA).astype(np.float32)
    corners = theirs.getChessboardCorners().astype(np.float64) * [1, 1, 0] + [0, 0, 1]
    carried = corners @ to_image.T
    return 35.0 + light * (170.0 / 255.0), np.asarray(carried[:, :2] / carried[:, 2:])


def photographed(rng: np.random.Generator, light: NDArray[np.float32], case: Case) -> Image:
    """Return the picture as a camera delivers it."""
    light = cv2.GaussianBlur(light, (0, 0), case.blur_px).astype(np.float32)
    if case.smear_px:
        light = cv2.blur(light, (case.smear_px + 1 - case.smear_px % 2, 1)).astype(np.float32)
    if case.gradient:
        light = light * np.linspace(1.0, 1.0 - case.gradient, light.shape[1], dtype=np.float32)
    noisy = light * case.contrast + case.noise_dn * rng.standard_normal(light.shape)
    return np.asarray(np.clip(np.rint(noisy), 0, 255), dtype=np.uint8)


def hide(rng: np.random.Generator, image: Image, truth: FloatArray, part: float) -> NDArray[np.bool_]:
    """Lay something over a side of the board, and return which corners are not under it."""
    if not part:
        return np.ones(len(truth), dtype=bool)
    way = rng.uniform(0, 2 * np.pi)
    normal = np.array([np.cos(way), np.sin(way)])
    edge = float(np.quantile(truth @ normal, part))
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    under = x * normal[0] + y * normal[1] < edge
    cloth = cv2.GaussianBlur(rng.integers(0, 256, image.shape).astype(np.float32), (0, 0), 3.0)
    image[under] = np.clip(120 + 4 * (cloth - cloth.mean()), 0, 255).astype(np.uint8)[under]
    return np.asarray(truth @ normal > edge + 1.0)


def opencvs(board: AnyBoard, image: Image, truth: FloatArray) -> FloatArray:
    """Return the errors (n, 2) of OpenCV's own detector, for a ChArUco board."""
    if not isinstance(board, Charuco):
        return np.empty((0, 2))
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    theirs = cv2.aruco.CharucoBoard((board.columns, board.rows), board.square_m, board.marker_m, dictionary)
    corners, ids, _, _ = cv2.aruco.CharucoDetector(theirs).detectBoard(image)
    if ids is None:
        return np.empty((0, 2))
    return np.asarray(np.reshape(corners, (-1, 2)) - truth[np.ravel(ids)], dtype=np.float64)


def run_cell(cell: Cell) -> Found:
    """Draw a cell's pictures and find the board in each."""
    board, case = BOARDS[cell.kind], cell.case
    rng = np.random.default_rng([cell.seed, *cell.kind.encode(), *case.name.encode()])
    told = Found([])
    for k in range(cell.poses):
        light, truth = drawn(rng, board, case)
        image = photographed(rng, light, case)
        seen = hide(rng, image, truth, case.hidden)
        seen &= ((truth > 8) & (truth < np.array(SIZE_PX) - 9)).all(axis=1)
        start_s = time.perf_counter()
        found = find_corners(board, image)
        seconds = time.perf_counter() - start_s
        theirs = opencvs(board, image, truth)
        if isinstance(found, CornersNotFound):
            none = np.empty((0, 2))
            told.outcomes.append(Outcome(none, np.empty(0), int(seen.sum()), theirs, found.reason, seconds))
        else:
            errors = found.pixels_px - truth[found.ids]
            told.outcomes.append(Outcome(errors, found.sigma_px, int(seen.sum()), theirs, "", seconds))
        if cell.pictures and (k == 0 or isinstance(found, CornersNotFound)):
            name = f"{cell.kind}_{case.name.replace(' ', '_')}_{k}.png"
            told.pictures[name] = cv2.imencode(".png", overlay(image, found))[1].tobytes()
    return told


def overlay(image: Image, found: Corners | CornersNotFound) -> Image:
    """Return the picture with a cross and the id on each corner, or the reason why there are none."""
    shown = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    if isinstance(found, CornersNotFound):
        cv2.putText(shown, found.reason, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (0, 0, 255), 1)
        return np.asarray(shown, dtype=np.uint8)
    for number, pixel in zip(found.ids, found.pixels_px, strict=True):
        at = np.rint(pixel).astype(int).tolist()
        cv2.drawMarker(shown, at, (0, 255, 0), cv2.MARKER_CROSS, 7)
        cv2.putText(
            shown, str(number), (at[0] + 3, at[1] - 3), cv2.FONT_HERSHEY_SIMPLEX, 0.3, (0, 120, 255), 1
        )
    return np.asarray(shown, dtype=np.uint8)


def tell(cell: Cell, outcomes: list[Outcome]) -> int:
    """Print a cell's row; return how many ids were wrong."""
    errors = np.concatenate([o.errors_px for o in outcomes])
    sigma = np.concatenate([o.sigma_px for o in outcomes])[:, None]
    theirs = np.concatenate([o.theirs_px for o in outcomes])
    lost = [o.reason for o in outcomes if o.reason]
    ms = [1e3 * o.seconds for o in outcomes]
    wrong = int((np.abs(errors).max(axis=1) > OUTLIER_PX).sum()) if len(errors) else 0
    line = f"{cell.kind:12s} {cell.case.name:16s}|"
    if len(errors):
        part = 100 * len(errors) / max(1, sum(o.in_view for o in outcomes))
        within = 100 * float(np.mean(np.abs(errors) < 1.96 * sigma))
        rms, worst = float(np.sqrt(np.mean(errors**2))), float(np.abs(errors).max())
        ratio = float(np.sqrt(np.mean((errors / sigma) ** 2)))
        line += f" {part:4.0f} {rms:7.4f} {worst:7.3f} {ratio:9.2f} {within:5.1f} {wrong:6d} |"
    else:
        line += " " * 44 + "|"
    near = theirs[np.abs(theirs).max(axis=1) < OUTLIER_PX] if len(theirs) else theirs
    told = (
        f"{float(np.sqrt(np.mean(near**2))):7.4f} {len(theirs) - len(near):5d}"
        if len(near)
        else f"{'-':>7s} {'-':>5s}"
    )
    print(f"{line} {len(lost):3d} of {len(outcomes):3d} {np.median(ms):6.0f} | {told}")
    for reason in sorted(set(lost)):
        print(f"        {lost.count(reason)} not found: {reason}")
    return wrong


def main() -> int:
    """Run the campaign and print its table."""
    parser = argparse.ArgumentParser(
        description="Corners found on drawn boards: error, sigma, wrong ids, time."
    )
    parser.add_argument("--poses", type=at_least(1), default=10, help="pictures for each board and case")
    parser.add_argument("--seed", type=at_least(0), default=1)
    parser.add_argument("--kind", choices=sorted(BOARDS), help="one kind of board only")
    parser.add_argument("--pictures", type=Path, help="folder for pictures with what was found")
    add_task_options(parser)
    arguments = parser.parse_args()
    cells = [
        Cell(kind, case, arguments.poses, arguments.seed, arguments.pictures is not None)
        for kind in BOARDS
        for case in CASES.values()
        if arguments.kind in (None, kind)
        and not (case.hidden and kind in ("checkerboard", "dots"))
        and not (case.name == "opencv's drawing" and kind != "charuco")
    ]
    cells = [whole(cell) for cell in cells]
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
    founds = results_of(arguments, "cells", run_cell, cells, lambda c: f"{c.kind}, {c.case.name}")
    if founds is None:
        return 0
    print(f"seed {arguments.seed}, {arguments.poses} pictures a line; px per axis; % of corners in view")
    print(f"{'':29s}|    %     rms   worst rms/sigma  95 %  wrong |  lost of  ms    | OpenCV wrong")
    wrong = 0
    for cell, found in zip(cells, founds, strict=True):
        wrong += tell(cell, found.outcomes)
        for name, png in found.pictures.items():
            (arguments.pictures / name).write_bytes(png)
    return 1 if wrong else 0


def whole(cell: Cell) -> Cell:
    """Boards without markers are put farther away, so that all of them is in the picture."""
    if cell.kind not in ("checkerboard", "dots"):
        return cell
    low, high = cell.case.range_m
    return replace(cell, case=replace(cell.case, range_m=(max(low, 1.1), max(high, 1.5))))


if __name__ == "__main__":
    end(main)
