"""Find a board in somebody's pictures with this project and with OpenCV, and let OpenCV fit a camera to both.

    .venv/bin/python -m tools.against_others.boards BOARD.yaml FOLDER [--negative] [--kept OUT]

Pictures of one camera, of one size, one board in each. OpenCV's corners are those of its CharucoDetector,
or, for a board that it does not know, what cornerSubPix makes of the tags' or squares' corners. Both sets
are fitted twice by cv2.calibrateCamera: with all corners of each, and with those that both found. Our
corners are fitted with this project's camera as well (CAHVOR, the boards' poses free). Last, each corner's
residual over its sigma: 1 where sigma is right and camera and board are as the model says.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.adjust.adjustment import Adjustment
from calib.adjust.solver import minimise
from calib.adjust.terms import ImageTerm
from calib.adjust.unknowns import Estimate
from calib.calibrate.starts.views import view_poses
from calib.errors import CalibError
from calib.targets.board_file import load_board
from calib.targets.boards import AnyBoard, AprilGrid, Charuco, Corners, DotBoard
from calib.targets.corners import find_corners
from calib.targets.markers import corners_on_board_m, detect
from tools.against_others.calibration import boards_residuals, rms
from tools.command import end

Image = NDArray[np.uint8]
Found = dict[int, NDArray[np.float64]]
"""Pixels by a corner's id."""

SUFFIXES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm"}
FEWEST = 8
EVEN_PX = 0.1
SAME_PX = 3.0
"""Two corners of one id farther apart than this are different corners: one of both is wrong."""


def theirs(board: AnyBoard, image: Image) -> Found:
    """Return what OpenCV finds, by our ids."""
    if isinstance(board, Charuco):
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        ids = np.arange(board.columns * board.rows // 2) + board.first_id
        size = (board.columns, board.rows)
        drawn = cv2.aruco.CharucoBoard(size, board.square_m, board.marker_m, dictionary, ids)
        drawn.setLegacyPattern(board.legacy)
        corners, numbers, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(image)
        if numbers is None or not len(numbers):
            return {}
        return dict(zip(np.ravel(numbers).tolist(), np.reshape(corners, (-1, 2)).astype(float), strict=True))
    if isinstance(board, AprilGrid):
        tags = detect(image, board)
        on_board = corners_on_board_m(board)
        places = board.in_board_m(board.ids)[:, :2]
        found: Found = {}
        for number, pixels in zip(tags.ids - board.first_id, tags.corners_px, strict=True):
            if 0 <= number < len(on_board):
                near = np.linalg.norm(places[:, None] - on_board[number], axis=2).argmin(axis=0)
                found |= dict(zip(near.tolist(), pixels, strict=True))
        return _refined(image, found)
    if isinstance(board, DotBoard):
        seen, dots = cv2.findCirclesGrid(image, (board.columns, board.rows))
        return dict(enumerate(np.reshape(dots, (-1, 2)).astype(float))) if seen else {}
    seen, corners = cv2.findChessboardCorners(image, (board.columns - 1, board.rows - 1))
    return _refined(image, dict(enumerate(np.reshape(corners, (-1, 2))))) if seen else {}


def _refined(image: Image, found: Found) -> Found:
    """Corners after cornerSubPix in windows of 11 px."""
    if not found:
        return {}
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
    start = np.array(list(found.values()), dtype=np.float32).reshape(-1, 1, 2)
    better = cv2.cornerSubPix(image, start, (5, 5), (-1, -1), stop).reshape(-1, 2)
    return dict(zip(found, better.astype(float), strict=True))


def calibrated(
    board: AnyBoard, pictures: Mapping[str, Found], size_px: tuple[int, int]
) -> tuple[float, NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Return rms px, the camera matrix and each picture's residuals (n, 2), by cv2.calibrateCamera with
    five numbers for the lens.
    """
    points = [board.in_board_m(list(found)).astype(np.float32) for found in pictures.values()]
    pixels = [np.array(list(found.values()), dtype=np.float32) for found in pictures.values()]
    rms, matrix, lens, turns, places = cv2.calibrateCamera(points, pixels, size_px, None, None)
    left = {}
    for name, one, seen, turn, place in zip(pictures, points, pixels, turns, places, strict=True):
        left[name] = np.asarray(cv2.projectPoints(one, turn, place, matrix, lens)[0].reshape(-1, 2) - seen)
    return float(rms), np.asarray(matrix), left


def main() -> int:
    """Find, fit and print."""
    parser = argparse.ArgumentParser(
        description="One board in pictures of one camera: our corners and OpenCV's."
    )
    parser.add_argument("board", type=Path, help="BOARD.yaml")
    parser.add_argument("folder", type=Path, help="pictures, all of one camera")
    parser.add_argument("--negative", action="store_true", help="the board is printed white on black")
    parser.add_argument("--kept", type=Path, help="folder for pictures with what was found")
    arguments = parser.parse_args()
    board = load_board(arguments.board)
    paths = sorted(path for path in arguments.folder.iterdir() if path.suffix.lower() in SUFFIXES)
    ours: dict[str, Found] = {}
    others: dict[str, Found] = {}
    sigmas: dict[str, dict[int, float]] = {}
    times: list[float] = []
    size_px = (0, 0)
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            print(f"{path.name}: not a picture that OpenCV reads")
            continue
        grey = np.asarray(255 - image if arguments.negative else image, dtype=np.uint8)
        size_px = (grey.shape[1], grey.shape[0])
        start_s = time.process_time()
        found = find_corners(board, grey)
        times.append(time.process_time() - start_s)
        other = theirs(board, grey)
        if isinstance(found, Corners):
            ours[path.name] = dict(zip(found.ids.tolist(), found.pixels_px, strict=True))
            sigmas[path.name] = dict(zip(found.ids.tolist(), found.sigma_px.tolist(), strict=True))
            if arguments.kept:
                arguments.kept.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(arguments.kept / f"{path.stem}.png"), _shown(grey, found))
        elif other:
            print(f"{path.name}: {len(other)} corners by OpenCV, none here: {found.reason}")
        if other:
            others[path.name] = other
    if not times:
        print(f"{arguments.folder}: no pictures ({', '.join(sorted(SUFFIXES))})")
        return 2
    _compare(board, size_px, ours, others, sigmas)
    print(
        f"{1e3 * statistics.median(times):.0f} ms of processor time a picture "
        f"of {size_px[0]} x {size_px[1]} px"
    )
    return 0


def _compare(
    board: AnyBoard,
    size_px: tuple[int, int],
    ours: dict[str, Found],
    others: dict[str, Found],
    sigmas: dict[str, dict[int, float]],
) -> None:
    both = {name: [i for i in ours[name] if i in others[name]] for name in ours if name in others}
    apart = [ours[name][i] - others[name][i] for name, ids in both.items() for i in ids]
    wrong = sum(float(np.linalg.norm(one)) > SAME_PX for one in apart)
    print(f"ours: {sum(map(len, ours.values()))} corners in {len(ours)} pictures; ", end="")
    print(f"OpenCV's: {sum(map(len, others.values()))} in {len(others)}; ", end="")
    print(f"in both {len(apart)}, of which {wrong} are more than {SAME_PX:g} px apart")
    common = [name for name, ids in both.items() if len(ids) >= FEWEST]
    sets = {
        "ours, all": {name: found for name, found in ours.items() if len(found) >= FEWEST},
        "OpenCV's, all": {name: found for name, found in others.items() if len(found) >= FEWEST},
        "ours, in both": {name: {i: ours[name][i] for i in both[name]} for name in common},
        "OpenCV's, in both": {name: {i: others[name][i] for i in both[name]} for name in common},
    }
    for label, pictures in sets.items():
        if len(pictures) < 3:
            print(f"{label:18s} {len(pictures)} pictures with {FEWEST} corners: too few to calibrate")
            continue
        rms_px, matrix, left = calibrated(board, pictures, size_px)
        told = ""
        if label == "ours, all":
            sigma = [sigmas[name][i] for name, found in pictures.items() for i in found]
            over = np.concatenate(list(left.values())) / np.array(sigma)[:, None]
            usual = 1.4826 * float(np.median(np.abs(over)))
            told = f"; over sigma {np.sqrt(np.mean(over**2)):.2f}, by the median {usual:.2f}"
            told += f"; sigma {np.median(sigma):.4f} px{_our_camera(board, pictures, size_px, rms_px)}"
        middle = float(np.median(np.linalg.norm(np.concatenate(list(left.values())), axis=1)))
        count = sum(map(len, pictures.values()))
        print(
            f"{label:18s} {len(pictures):3d} pictures {count:5d} corners: "
            f"OpenCV's camera leaves {rms_px:.4f} px rms, median {middle:.4f}; f {matrix[0, 0]:.1f} px{told}"
        )


def _our_camera(
    board: AnyBoard,
    pictures: Mapping[str, Found],
    size_px: tuple[int, int],
    opencvs_px: float,
) -> str:
    """What this project's camera leaves of the same corners, each weighing as much as any other."""
    terms = []
    for name, found in pictures.items():
        ids = np.array(list(found))
        rows, columns = board.cells(ids)
        pixels, places = np.array(list(found.values())), board.in_board_m(ids)
        even, all_of_them = np.full(len(ids), EVEN_PX), np.ones(len(ids), dtype=bool)
        terms.append(
            ImageTerm(
                name, "camera", ("", name), None, 0.0, 0.0, rows, columns, places, pixels, even, all_of_them
            )
        )
    try:
        found_poses = view_poses(terms, "CAHVOR", size_px, None)
    except CalibError as reason:
        return f"; ours: {reason}"
    terms = [term for term in terms if term.name in found_poses.poses]
    boards = {term.board: found_poses.poses[term.name][0] for term in terms}
    start = Estimate({"camera": found_poses.model}, np.zeros(8), {}, boards, {}, np.zeros((0, 2)))
    problem = Adjustment(terms, (), start, mast_parameters=0)
    state = minimise(problem, start, weak=problem.weak).state
    left = boards_residuals(problem, state)
    ours_px = rms(left[np.isfinite(left).all(axis=-1)])
    return f"; our CAHVOR leaves {ours_px:.4f} px, {ours_px / opencvs_px:.3f} of OpenCV's"


def _shown(image: Image, found: Corners) -> Image:
    shown = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    for number, pixel in zip(found.ids, found.pixels_px, strict=True):
        at = np.rint(pixel).astype(int).tolist()
        cv2.drawMarker(shown, at, (0, 255, 0), cv2.MARKER_CROSS, 9)
        cv2.putText(
            shown, str(number), (at[0] + 3, at[1] - 3), cv2.FONT_HERSHEY_SIMPLEX, 0.35, (0, 120, 255), 1
        )
    return np.asarray(shown, dtype=np.uint8)


if __name__ == "__main__":
    end(main)
