"""Look for a board among things that are easily taken for it, and count corners with a wrong id.

Each picture (640 x 480 px) has the board, part of it hidden now and then, or has none; and any of: loose
markers of its own and of other dictionaries, a second board of another kind or with other ids, its own
mirror image as a faint reflection or as a mirrored print, chessboard textures, squares and bars. All is
laid in by OpenCV's warpPerspective, blurred and made noisy. A corner is wrong if it is farther than 1 px
from where the board has it, or if there is no board.

    .venv/bin/python -m tools.campaigns.corner_clutter --cases 2000
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from calib.targets.boards import AnyBoard, AprilGrid, Charuco, Corners
from calib.targets.corners import find_corners
from calib.targets.pattern import pattern_of
from tools.command import end, options, run_cases

FloatArray = NDArray[np.float64]
Image = NDArray[np.uint8]

SIZE_PX, FOCAL_PX = (640, 480), 800.0
MATRIX = np.array([[FOCAL_PX, 0, 319.5], [0, FOCAL_PX, 239.5], [0, 0, 1]])
SPOILT_PX = 1.0
BATCH = 50
TEXELS_M = 2000.0
BOARDS: dict[str, AnyBoard] = {
    "charuco": Charuco(8, 6, 0.04, 0.03, "DICT_5X5_100"),
    "aprilgrid": AprilGrid(5, 4, 0.05, 0.015),
}
SECOND: dict[str, tuple[AnyBoard, ...]] = {
    "charuco": (
        replace(BOARDS["charuco"], first_id=40),
        Charuco(8, 6, 0.04, 0.03, "DICT_4X4_100"),
        Charuco(7, 5, 0.04, 0.03, "DICT_5X5_100", first_id=30),
        BOARDS["aprilgrid"],
    ),
    "aprilgrid": (
        replace(BOARDS["aprilgrid"], first_id=30),
        AprilGrid(5, 4, 0.05, 0.015, border=1, first_id=60),
        BOARDS["charuco"],
    ),
}
LOOSE = ("DICT_5X5_100", "DICT_4X4_50", "DICT_6X6_250", "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11")
KINDS = ("loose", "second", "reflection", "mirrored", "chess", "bars", "none")


@dataclass(frozen=True)
class Batch:
    """Pictures of one board."""

    kind: str
    number: int
    seed: int


@dataclass(frozen=True)
class ClutteredPicture:
    """Of one picture: what lay in it, corners found, wrong and spoilt, and whether the board was there."""

    clutter: tuple[str, ...]
    found: int
    wrong: int
    spoilt: int
    there: bool


@cache
def bitmap(board: AnyBoard) -> Image:
    """The print with a white margin of 1 cm."""
    half = [size / 2 + 0.01 for size in board.size_m]
    x, y = (np.arange(-size, size, 1 / TEXELS_M) + 0.5 / TEXELS_M for size in half)
    return np.where(pattern_of(board).is_black(*np.meshgrid(x, y)), 35, 205).astype(np.uint8)


def homography(rng: np.random.Generator, far: tuple[float, float] = (0.5, 1.3)) -> FloatArray:
    """Pixels from metres of a plane somewhere before the camera."""
    about, slant = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 55))
    tilt = Rotation.from_rotvec(slant * np.array([np.cos(about), np.sin(about), 0.0]))
    turn = (tilt * Rotation.from_rotvec([0, 0, rng.uniform(-np.pi, np.pi)])).as_matrix()
    x, y = rng.uniform(-0.25, 0.25), rng.uniform(-0.18, 0.18)
    place = rng.uniform(*far) * np.array([x, y, 1.0])
    return np.asarray(MATRIX @ np.column_stack([turn[:, :2], place]))


def lay(image: NDArray[np.float32], print_: Image, pixels_from_m: FloatArray, part: float = 1.0) -> None:
    """Lay a print, its middle at the origin, into the picture."""
    height, width = print_.shape
    from_texel = np.array(
        [
            [1 / TEXELS_M, 0, -(width - 1) / 2 / TEXELS_M],
            [0, 1 / TEXELS_M, -(height - 1) / 2 / TEXELS_M],
            [0, 0, 1],
        ]
    )
    whole = pixels_from_m @ from_texel
    near = abs(np.linalg.det(whole / whole[2, 2])) ** 0.5
    smooth = cv2.GaussianBlur(print_, (0, 0), max(0.3, 0.4 / max(near, 0.05)))
    drawn = cv2.warpPerspective(smooth, whole, SIZE_PX, flags=cv2.INTER_LINEAR)
    cover = cv2.warpPerspective(np.full(print_.shape, 255, np.uint8), whole, SIZE_PX) / 255.0 * part
    image[:] = image * (1 - cover) + drawn * cover


def picture(rng: np.random.Generator, kind: str) -> tuple[Image, FloatArray | None, tuple[str, ...]]:
    """Return a picture, pixels from metres of the board (None: not there), and the clutter in it."""
    board = BOARDS[kind]
    clutter = tuple(sorted({KINDS[k] for k in rng.choice(len(KINDS), rng.integers(1, 4))}))
    rough = rng.normal(size=(60, 80)).astype(np.float32)
    image = (110 + 30 * cv2.resize(rough, SIZE_PX, interpolation=cv2.INTER_CUBIC)).astype(np.float32)
    if "chess" in clutter:
        side = rng.integers(8, 30)
        y, x = np.mgrid[:400, :400] // side
        lay(image, np.where((x + y) % 2, 205, 35).astype(np.uint8), homography(rng))
    if "bars" in clutter:
        for _ in range(12):
            a, b = rng.integers(0, SIZE_PX, 2), rng.integers(0, SIZE_PX, 2)
            cv2.rectangle(
                image, a.tolist(), b.tolist(), float(rng.choice([30, 210])), int(rng.integers(2, 12))
            )
    if "second" in clutter:
        others = SECOND[kind]
        lay(image, bitmap(others[rng.integers(len(others))]), homography(rng))
    if "mirrored" in clutter:
        lay(image, np.ascontiguousarray(bitmap(board)[:, ::-1]), homography(rng))
    place = None if rng.random() < 0.2 else homography(rng)
    if place is not None:
        lay(image, bitmap(board), place)
    if "loose" in clutter:
        for _ in range(rng.integers(2, 12)):
            dictionary = cv2.aruco.getPredefinedDictionary(
                getattr(cv2.aruco, LOOSE[rng.integers(len(LOOSE))])
            )
            border = int(rng.integers(1, 3))
            cells = dictionary.markerSize + 2 * border
            number = int(rng.integers(50))
            tag = cv2.aruco.generateImageMarker(dictionary, number, 12 * cells, borderBits=border)
            rim = cv2.copyMakeBorder(tag, 14, 14, 14, 14, cv2.BORDER_CONSTANT, value=255)
            lay(image, np.where(rim > 0, 205, 35).astype(np.uint8), homography(rng, (0.6, 1.6)))
    if "reflection" in clutter:
        lay(image, np.ascontiguousarray(bitmap(board)[:, ::-1]), homography(rng), 0.35)
    blurred = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.4, 1.2))
    noisy = blurred * rng.uniform(0.4, 1.1) + rng.uniform(1, 4) * rng.standard_normal(blurred.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8), place, clutter


def run_batch(batch: Batch) -> list[ClutteredPicture]:
    """Draw pictures and find the board in them."""
    board = BOARDS[batch.kind]
    places = np.column_stack([board.in_board_m(board.ids)[:, :2], np.ones(len(board.ids))])
    told = []
    for k in range(BATCH):
        rng = np.random.default_rng([batch.seed, batch.number, k, *batch.kind.encode()])
        image, pixels_from_m, clutter = picture(rng, batch.kind)
        found = find_corners(board, image)
        count = len(found) if isinstance(found, Corners) else 0
        wrong, spoilt = count, 0
        if isinstance(found, Corners) and pixels_from_m is not None:
            carried = places @ pixels_from_m.T
            off = np.linalg.norm(found.pixels_px[:, None] - carried[:, :2] / carried[:, 2:], axis=2)
            wrong = int((board.ids[off.argmin(axis=1)] != found.ids).sum())
            spoilt = int((off[np.arange(count), found.ids] > SPOILT_PX).sum())
        told.append(ClutteredPicture(clutter, count, wrong, spoilt, pixels_from_m is not None))
    return told


def main() -> int:
    """Run the campaign and print its table."""
    args = options(__doc__, 2000, "pictures of each board, in fifties").parse_args()
    batches = [Batch(kind, n, args.seed) for kind in BOARDS for n in range(-(-args.cases // BATCH))]
    results = run_cases(args, "batches", run_batch, batches, lambda b: f"{b.kind} {b.number}")
    wrong = 0
    for kind in BOARDS:
        of_kind = [t for b, told in zip(batches, results, strict=True) if b.kind == kind for t in told]
        there = [t for t in of_kind if t.there]
        wrong += sum(t.wrong for t in of_kind)
        print(
            f"{kind}: {len(of_kind)} pictures, {len(there)} with the board; found in "
            f"{sum(t.found > 0 for t in there)}, {sum(t.found for t in there)} corners, of which "
            f"{sum(t.wrong for t in there)} wrong and {sum(t.spoilt for t in there)} spoilt; "
            f"without the board: {sum(t.wrong for t in of_kind if not t.there)} corners"
        )
        by_clutter = Counter(name for t in of_kind for name in t.clutter)
        lost = Counter(name for t in there if not t.found for name in t.clutter)
        bad = Counter(name for t in of_kind if t.wrong for name in t.clutter)
        for name in KINDS:
            print(
                f"    {name:11s} in {by_clutter[name]:4d}, board not found {lost[name]:3d}, "
                f"wrong {bad[name]:3d}"
            )
    return 1 if wrong else 0


if __name__ == "__main__":
    end(main)
