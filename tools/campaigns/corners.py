"""Photograph boards at random poses, find their corners, and print how well, by board and by what spoils
pictures.

Boards are drawn, and their corners projected, by OpenCV (tools/campaigns/board_photos.py), with a lens that
bends, at random slants, rolls and places; a scene's pictures are of the same boards, each spoilt in every
way of its scene. Beside the corners found here stand those of OpenCV's CharucoDetector on the same pictures.

    .venv/bin/python -m tools.campaigns.corners --cases 20 --seed 1
    .venv/bin/python -m tools.campaigns.corners --cases 3 --kind aprilgrid --pictures FOLDER
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.targets.boards import AnyBoard, AprilGrid, Charuco, Checkerboard, Corners, DotBoard
from calib.targets.corners import CornersNotFound, find_corners
from tools.campaigns.board_photos import SIZE_PX, Levels, keep_pictures, light, photographed, placed
from tools.command import end, options, run_cases

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]

BOARDS: dict[str, AnyBoard] = {
    "charuco": Charuco(12, 9, 0.04, 0.03, "DICT_5X5_100"),
    "aprilgrid": AprilGrid(6, 5, 0.06, 0.018),
    "checkerboard": Checkerboard(12, 9, 0.04),
    "dots": DotBoard(14, 10, 0.035, 0.0175),
}
WHOLE_M = (1.15, 1.5)
"""Boards without markers are put so far away that all of them is in the picture."""

OUTLIER_PX = 1.0
"""A corner so far from its truth is another corner: a wrong id."""


@dataclass(frozen=True)
class PictureCase:
    """What a picture suffers; blur and noise are standard deviations, ``hidden`` a part of the corners."""

    name: str
    blur_px: float = 0.7
    noise_dn: float = 2.0
    smear_px: float = 0.0
    hidden: float = 0.0
    contrast: float = 1.0
    gradient: float = 0.0
    bits: int = 8


@dataclass(frozen=True)
class BoardScene:
    """Where boards are, and what their pictures suffer."""

    name: str
    slant_deg: tuple[float, float]
    range_m: tuple[float, float]
    cases: tuple[PictureCase, ...]


SHARP = PictureCase("blur 0.7, noise 2")
SCENES = (
    BoardScene(
        "slant 0 to 40, 0.7 to 1.3 m",
        (0.0, 40.0),
        (0.7, 1.3),
        (
            SHARP,
            PictureCase("no blur", blur_px=0.0, noise_dn=1.0),
            PictureCase("blur 0.5", blur_px=0.5, noise_dn=1.0),
            PictureCase("blur 1.5", blur_px=1.5),
            PictureCase("blur 2.5", blur_px=2.5),
            PictureCase("smear 6 px", smear_px=6.0),
            PictureCase("noise 5", noise_dn=5.0),
            PictureCase("dark", contrast=0.12),
            PictureCase("uneven light", gradient=0.7),
            PictureCase("half hidden", hidden=0.5),
            PictureCase("16 bits, noise 1", noise_dn=1.0, bits=16),
        ),
    ),
    BoardScene("slant 55 to 60", (55.0, 60.0), (0.7, 1.3), (SHARP, PictureCase("blur 1.5", blur_px=1.5))),
    BoardScene("1.6 to 2.4 m", (0.0, 40.0), (1.6, 2.4), (SHARP, PictureCase("noise 5", noise_dn=5.0))),
    BoardScene("3 to 4.5 m", (0.0, 40.0), (3.0, 4.5), (PictureCase("blur 0.5, noise 2", blur_px=0.5),)),
    BoardScene("0.45 to 0.6 m", (0.0, 40.0), (0.45, 0.6), (SHARP,)),
)


@dataclass(frozen=True)
class PoseTask:
    """One board at one pose of a scene, in all its cases."""

    kind: str
    scene: BoardScene
    pose: int
    seed: int
    pictures: bool = False


@dataclass(frozen=True)
class CornersOutcome:
    """One picture: errors (n, 2) px, sigmas (n,), corners in view, OpenCV's errors, the reason if none."""

    errors_px: FloatArray
    sigma_px: FloatArray
    in_view: int
    theirs_px: FloatArray
    reason: str
    seconds: float


@dataclass(frozen=True)
class PoseFound:
    """What became of a pose: an outcome a case, and pictures (PNG) by their names."""

    outcomes: dict[str, CornersOutcome]
    pictures: dict[str, bytes] = field(default_factory=dict)


def hide(rng: np.random.Generator, image: Levels, truth: FloatArray, part: float) -> NDArray[np.bool_]:
    """Lay something over a side of the board, and return which corners are not under it."""
    if not part:
        return np.ones(len(truth), dtype=bool)
    way = rng.uniform(0, 2 * np.pi)
    normal = np.array([np.cos(way), np.sin(way)])
    edge = float(np.quantile(truth @ normal, part))
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    under = x * normal[0] + y * normal[1] < edge
    cloth = cv2.GaussianBlur(rng.integers(0, 256, image.shape).astype(np.float32), (0, 0), 3.0)
    image[under] = np.clip(120 + 4 * (cloth - cloth.mean()), 0, 255).astype(image.dtype)[under]
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


def run_pose(task: PoseTask) -> PoseFound:
    """Draw a board, photograph it in every case, and find its corners."""
    board, scene = BOARDS[task.kind], task.scene
    rng = np.random.default_rng([task.seed, task.pose, *task.kind.encode(), *scene.name.encode()])
    marked = task.kind in ("charuco", "aprilgrid")
    low, high = scene.range_m
    range_m = scene.range_m if marked else (max(low, WHOLE_M[0]), max(high, WHOLE_M[1]))
    # without markers the upper side in the picture is taken for the board's
    one = placed(rng, board, scene.slant_deg, range_m, 0.35 if marked else 0.1, 180.0 if marked else 20.0)
    fine, truth = light([one]), one.truth_px
    told = PoseFound({})
    for case in scene.cases:
        if case.hidden and not marked:
            continue
        image = photographed(
            rng, fine, case.blur_px, case.noise_dn, smear_px=case.smear_px, contrast=case.contrast,
            gradient=case.gradient, bits=case.bits,
        )  # fmt: skip
        seen = hide(rng, image, truth, case.hidden)
        rim = 2.0 * case.blur_px + 1.0
        seen &= ((truth > rim) & (truth < np.array(SIZE_PX) - 1 - rim)).all(axis=1)
        start_s = time.process_time()
        found = find_corners(board, image)
        seconds = time.process_time() - start_s
        eight = image.astype(np.uint8) if case.bits == 8 else (image / 200.0).astype(np.uint8)
        theirs = opencvs(board, eight, truth)
        if isinstance(found, CornersNotFound):
            none = np.empty((0, 2))
            told.outcomes[case.name] = CornersOutcome(
                none, np.empty(0), int(seen.sum()), theirs, found.reason, seconds
            )
        else:
            errors = found.pixels_px - truth[found.ids]
            told.outcomes[case.name] = CornersOutcome(
                errors, found.sigma_px, int(seen.sum()), theirs, "", seconds
            )
        if task.pictures and (task.pose == 0 or isinstance(found, CornersNotFound)):
            name = f"{task.kind}_{scene.name}_{case.name}_{task.pose}.png".replace(" ", "_")
            told.pictures[name] = cv2.imencode(".png", overlay(eight, found))[1].tobytes()
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


def tell(kind: str, name: str, outcomes: list[CornersOutcome]) -> int:
    """Print a case's row; return how many ids were wrong."""
    errors = np.concatenate([o.errors_px for o in outcomes])
    sigma = np.concatenate([o.sigma_px for o in outcomes])[:, None]
    theirs = np.concatenate([o.theirs_px for o in outcomes])
    lost = [o.reason for o in outcomes if o.reason]
    ms = [1e3 * o.seconds for o in outcomes]
    wrong = int((np.abs(errors).max(axis=1) > OUTLIER_PX).sum()) if len(errors) else 0
    line = f"{kind:12s} {name:18s}|"
    if len(errors):
        part = 100 * len(errors) / max(1, sum(o.in_view for o in outcomes))
        within = 100 * float(np.mean(np.abs(errors) < 1.96 * sigma))
        rms, worst = float(np.sqrt(np.mean(errors**2))), float(np.abs(errors).max())
        # of each picture: its corners share a pose, so pictures are what is independent
        squares = np.array(
            [np.mean((o.errors_px / o.sigma_px[:, None]) ** 2) for o in outcomes if len(o.errors_px)]
        )
        ratio = float(np.sqrt(squares.mean()))
        unsure = (
            float(squares.std(ddof=1) / np.sqrt(len(squares)) / (2 * ratio)) if len(squares) > 1 else np.nan
        )
        line += (
            f" {part:4.0f} {rms:7.4f} {worst:7.3f} {ratio:6.2f} ±{2 * unsure:4.2f} {within:5.1f} {wrong:6d} |"
        )
    else:
        line += " " * 47 + "|"
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
    parser = options(__doc__, 20, "poses of each board in each scene")
    parser.add_argument("--kind", choices=sorted(BOARDS), help="one kind of board only")
    parser.add_argument("--pictures", type=Path, help="folder for pictures with what was found")
    args = parser.parse_args()
    tasks = [
        PoseTask(kind, scene, pose, args.seed, args.pictures is not None)
        for kind in BOARDS
        for scene in SCENES
        if args.kind in (None, kind)
        for pose in range(args.cases)
    ]
    founds = run_cases(args, "poses", run_pose, tasks, lambda t: f"{t.kind}, {t.scene.name}, {t.pose}")
    print(f"seed {args.seed}, {args.cases} pictures a line; px per axis; % of corners in view")
    print(f"{'':31s}|    %     rms   worst rms/sigma     95 %  wrong |  lost of  ms    | OpenCV wrong")
    wrong = 0
    for kind in BOARDS:
        for scene in SCENES:
            of_scene = [f for t, f in zip(tasks, founds, strict=True) if (t.kind, t.scene) == (kind, scene)]
            if of_scene:
                print(f"{kind}, {scene.name}:")
            for case in scene.cases:
                outcomes = [f.outcomes[case.name] for f in of_scene if case.name in f.outcomes]
                if outcomes:
                    wrong += tell(kind, case.name, outcomes)
    keep_pictures(args.pictures, founds)
    return 1 if wrong else 0


if __name__ == "__main__":
    end(main)
