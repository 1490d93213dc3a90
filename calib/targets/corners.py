"""Find the corners of a board in an image, or say in a sentence why there are none.

Markers give the place of each corner to a pixel or two (`calib.targets.markers`). Each corner is fitted to
its grey levels (`calib.targets.saddles`), and further corners are looked for beside those found. Corners that
do not fit the smooth map of the others are dropped. Dots are left to `calib.targets.dots`.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.targets.board_file import FAMILIES
from calib.targets.boards import (
    AnyBoard,
    AprilGrid,
    Charuco,
    Checkerboard,
    Corners,
    CornersNotFound,
    DotBoard,
    Grey8,
    Levels,
)
from calib.targets.dot_grid import fit_plane_map
from calib.targets.dots import find_dots, in_8_bits
from calib.targets.markers import (
    MarkerBoard,
    Markers,
    MeasuredCorners,
    PlacedMarkers,
    chessboard_corners,
    count_of,
    detect,
    placed_markers,
    predicted,
    search,
)
from calib.targets.pattern import Cells, pattern_of
from calib.targets.saddles import NO_SADDLES, Crossings, Saddles, fit_saddles

MOST_ELSEWHERE = 0.5
"""Of the markers found; if more do not stand as on the board, it is another."""

BLURRED_PX = 2.0
"""Standard deviation of a blur that is stated."""


def doubled(board: MarkerBoard, markers: Markers, placed: PlacedMarkers | None) -> str:
    """Say that two boards with the same markers are in view; '' if not."""
    ids = [int(number) for number in markers.ids if 0 <= number - board.first_id < count_of(board)]
    twice = sorted({number for number in ids if ids.count(number) > 1})
    if len(twice) < 2:
        return ""
    middles = [markers.corners_px[k].mean(axis=0) for k in np.flatnonzero(markers.ids == twice[0])[:2]]
    if placed is not None:
        # the same marker read twice at one place is one marker
        side = float(np.linalg.norm(placed.corners_px[0, 1] - placed.corners_px[0, 0]))
        if np.linalg.norm(middles[1] - middles[0]) < side:
            return ""
    places = " and ".join(f"({x:.0f}, {y:.0f})" for x, y in middles)
    return (
        f"two boards with the same markers are in view: {len(twice)} markers are there twice, "
        f"marker {twice[0]} at {places} px; one is to be covered"
    )


def why_not_this_board(board: MarkerBoard, markers: Markers, placed: PlacedMarkers | None) -> str:
    """Say that the markers in view are of a board drawn otherwise; '' if they are of this one."""
    found = len(markers.ids)
    placed_count = 0 if placed is None else len(placed.ids)
    last = board.first_id + count_of(board) - 1
    outside = [int(number) for number in markers.ids if not board.first_id <= number <= last]
    mine = found - len(outside)  # others may be of a second board, which is no harm
    if found < 4 or placed_count == mine > 0:
        return ""
    if isinstance(board, Charuco):
        flipped = placed_markers(markers, replace(board, legacy=not board.legacy))
        if flipped is not None and len(flipped.ids) > placed_count:
            drawn = "as OpenCV before 4.6 draws it (legacy: true)"
            if board.legacy:
                drawn = "as OpenCV draws it today (legacy: false)"
            return f"the markers in view stand as on another board: {drawn}; BOARD.yaml says otherwise"
    if mine and placed_count >= MOST_ELSEWHERE * mine:
        return ""
    if len(outside) > MOST_ELSEWHERE * found:
        wanted = f"{board.first_id} to {last} are expected"
        return f"another board is in view: its markers are {_some(outside)}, where {wanted}"
    cells = f"{board.columns} x {board.rows} {'tags' if isinstance(board, AprilGrid) else 'squares'}"
    return (
        f"another board is in view: its {found} markers do not stand as on one of {cells}; correct "
        "BOARD.yaml, or print its board with 'mastctl board make'"
    )


def why_nothing(board: AnyBoard, image: Grey8) -> str:
    """Say why no board is seen."""
    dark, bright = (float(value) for value in np.percentile(image, (1.0, 99.5)))
    if bright < 40:
        return f"the picture is too dark: all but the brightest 0.5 % of it is below {bright:.0f} of 255"
    if bright - dark < 20:
        return f"the picture shows next to nothing: its levels are between {dark:.0f} and {bright:.0f} of 255"
    if isinstance(board, Charuco | AprilGrid):
        reason = _mirrored(board, image) or _others(board, image)
        if reason:
            return reason
    return _blurred(image) or (
        "the board is not in the picture, or too far away, too slanted or too much covered to be read"
    )


def _mirrored(board: MarkerBoard, image: Grey8) -> str:
    flipped = detect(np.ascontiguousarray(image[:, ::-1]), board)
    if placed_markers(flipped, board) is None or len(flipped.ids) < 3:
        return ""
    return "the board is mirrored: it was printed or the picture was taken the wrong way round"


def _blurred(image: Grey8) -> str:
    """Say over how many pixels the sharpest edges of a picture are spread, if that is too much."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 1.0)
    range_dn = float(np.ptp(np.percentile(smooth, (1.0, 99.5))))
    widths = []
    for axis in (1, 0):
        steepest = float(np.percentile(np.abs(np.gradient(smooth, axis=axis)), 99.8))
        # an edge blurred by a normal distribution is steepest in its middle
        spread = range_dn / max(steepest, 1e-6) / np.sqrt(2 * np.pi)
        widths.append(float(np.sqrt(max(spread**2 - 1.0, 0.0))))
    across, down = widths
    if max(widths) > BLURRED_PX and max(widths) > 2.0 * min(widths):
        direction = "across" if across > down else "down"
        wide = f"its sharpest edges that way are spread over {2 * max(widths):.0f} px"
        return f"no board can be read; the picture moved {direction} during its exposure: {wide}"
    if min(widths) > BLURRED_PX:
        wide = f"its sharpest edges are spread over {2 * min(widths):.0f} px"
        return f"no board can be read; the picture is blurred: {wide}"
    return ""


def _others(board: MarkerBoard, image: Grey8) -> str:
    """Markers of another dictionary."""
    mine = board.dictionary if isinstance(board, Charuco) else FAMILIES[board.family]
    border = board.border if isinstance(board, AprilGrid) else 1
    others = [*(f"DICT_{n}X{n}_1000" for n in (4, 5, 6, 7)), "DICT_ARUCO_ORIGINAL", "DICT_APRILTAG_36h11"]
    for dictionary, width in [*((other, 1) for other in others), (others[-1], 2)]:
        if (dictionary.split("_")[:2], width) == (mine.split("_")[:2], border):
            continue
        found = search(image, dictionary, width)
        if len(found.ids) >= 6:  # one or two are read into anything
            other = f"{dictionary} with a border of {width}" if "APRIL" in dictionary else dictionary
            return f"another board is in view: its markers are of {other}, not of {mine}"
    return ""


def _some(numbers: list[int]) -> str:
    first = ", ".join(map(str, sorted(numbers)[:4]))
    return first + (f" and {len(numbers) - 4} more" if len(numbers) > 4 else "")


FEWEST = 4


def find_corners(board: AnyBoard, image: Levels) -> Corners | CornersNotFound:
    """Return the corners of a board that an image shows, or why there are none.

    Part of a board is enough where its markers show which part. Chessboards and dots must be seen whole,
    their upper side up in the image unless the print shows it.

    ``image`` is (h, w) or (h, w, 3) levels of 8 or 16 bits (else ValueError); the centre of the top-left
    pixel is (0, 0). A corner's sigma is from noise, blur and slant, by the residuals of its grey levels;
    errors that neighbours share, such as the print's, are not in it.
    """
    levels = _grey(image)
    eight = in_8_bits(levels)
    if isinstance(board, DotBoard):
        return _dots(board, levels)
    pattern = pattern_of(board)
    assert isinstance(pattern, Cells)
    if isinstance(board, Checkerboard):
        start = chessboard_corners(board, eight)
        if start is None:
            return CornersNotFound(why_nothing(board, eight))
    else:
        placed = _placed(board, eight)
        if isinstance(placed, CornersNotFound):
            return placed
        start = _beside(board, placed)
    found = _inside(_fitted(board, levels, pattern, start), levels.shape)
    if len(found.ids) < FEWEST:
        return CornersNotFound(
            "markers of the board are seen, but its corners are covered, blurred or too small"
        )
    return _agreeing(board, found)


def _placed(board: MarkerBoard, image: Grey8) -> PlacedMarkers | CornersNotFound:
    """The markers that stand as on the board, or what is wrong."""
    markers = detect(image, board)
    placed = placed_markers(markers, board)
    twice = doubled(board, markers, placed)
    if twice:
        return CornersNotFound(twice)
    another = why_not_this_board(board, markers, placed)
    if another:
        return CornersNotFound(another)
    if placed is None:
        return CornersNotFound(why_nothing(board, image))
    return placed


def _beside(board: MarkerBoard, placed: PlacedMarkers) -> MeasuredCorners:
    """The corners next to markers, predicted from these."""
    known = MeasuredCorners(placed.corners_m.reshape(-1, 2), placed.corners_px.reshape(-1, 2))
    ids = board.ids
    places = board.in_board_m(ids)[:, :2]
    away = np.linalg.norm(places[:, None] - known.points_m[None], axis=-1).min(axis=1)
    reach = 0.5 * (board.gap_m if isinstance(board, AprilGrid) else board.square_m)
    near = away < reach
    return predicted(known, ids[near], places[near])


def _fitted(
    board: Charuco | AprilGrid | Checkerboard, levels: Levels, pattern: Cells, start: MeasuredCorners
) -> Saddles:
    """The corners that the start names, and those that lie beside what was found."""
    places = board.in_board_m(board.ids)[:, :2]
    inset_m = np.full(2, np.inf)  # markers begin in the white squares of a ChArUco board alone
    if isinstance(board, Charuco):
        inset_m = (board.square_m - board.marker_m) / 2 * np.array([1.0, board.aspect])
    printed = Crossings(pattern, board.ids, places, inset_m)
    step_m = 1.3 * max(float(np.diff(line).max()) for line in board.lines_m)  # to a corner's neighbours
    found, tried = NO_SADDLES, np.zeros(len(places), dtype=bool)
    while len(start.ids):
        tried[start.ids] = True
        crossings = printed.some(start.ids)
        more = fit_saddles(levels, crossings, start.pixels_px, start.jacobians, farthest_px=4.0)
        found = Saddles._make(map(np.concatenate, zip(found, more, strict=True)))
        found = found.some(_good(found))
        if len(found.ids) < FEWEST or tried.all():
            break
        known, ids = MeasuredCorners(places[found.ids], found.pixels_px), board.ids[~tried]
        away_m = np.linalg.norm(places[ids][:, None] - known.points_m[None], axis=-1).min(axis=1)
        ids = ids[away_m < step_m]
        tried[ids] = True
        # less where the corners found lie too badly to say where the next one is
        start = predicted(known, ids, places[ids])
    return found


def _inside(found: Saddles, shape: tuple[int, ...]) -> Saddles:
    """Leave out what is nearer to the image's rim than two standard deviations of the blur, or beside it."""
    rim = 2.0 * found.wide_px.max(axis=1, initial=0.0) - 0.5
    x, y = found.pixels_px.T
    return found.some((x > rim) & (y > rim) & (x < shape[1] - 1 - rim) & (y < shape[0] - 1 - rim))


def _good(saddles: Saddles) -> NDArray[np.bool_]:
    """Which corners look like the others.

    One that is half covered is less sure, or has less contrast; what lies across an edge makes it wider.
    """
    fitted = np.isfinite(saddles.sigma_px)
    if not fitted.any():
        return fitted
    with np.errstate(invalid="ignore", divide="ignore"):
        left_over = saddles.noise / saddles.contrast
        good = fitted & (saddles.sigma_px < min(0.3, 6.0 * float(np.nanmedian(saddles.sigma_px))))
        good &= saddles.contrast > 0.35 * np.nanmedian(saddles.contrast)
        good &= (saddles.wide_px < 1.7 * np.nanmedian(saddles.wide_px, axis=0)).all(axis=1)
        return np.asarray(good & (left_over < max(0.12, 3.0 * float(np.nanmedian(left_over)))))


def _agreeing(board: AnyBoard, found: Saddles) -> Corners | CornersNotFound:
    """The corners that fit a smooth map of all."""
    points = board.in_board_m(found.ids)[:, :2]
    pixels = found.pixels_px
    sigma = np.hypot(found.sigma_px, 0.001)  # the best that aliasing and whole grey levels allow
    good = np.ones(len(points), dtype=bool)
    for _ in range(6):
        plane_map = fit_plane_map(points[good], pixels[good])
        if plane_map is None or 2 * int(good.sum()) - plane_map.parameters < 6:
            break
        # what the map has no room for, a lens near by or a bent board, is in all of them
        least = np.maximum(sigma, float(np.median(sigma[good])))
        off = np.linalg.norm(plane_map.pixels(points) - pixels, axis=-1) / least
        # by the median: a corner far off does not excuse itself
        usual = float(np.median(off[good])) / 1.177
        far = good & (off > 6.0 * max(1.0, usual))
        if not far.any() or good.sum() - far.sum() < FEWEST:
            break
        good &= ~far
    order = np.argsort(found.ids[good])
    return Corners(found.ids[good][order], pixels[good][order], sigma[good][order])


def _dots(board: DotBoard, levels: Levels) -> Corners | CornersNotFound:
    """The dots, rows to the right in the image."""
    found = find_dots(levels, board)
    if isinstance(found, CornersNotFound):
        return found
    assert found.sigma_px is not None
    return Corners(found.rows * board.columns + found.columns, found.pixels_px, found.sigma_px)


def _grey(image: Levels) -> Levels:
    if (
        image.dtype not in (np.uint8, np.uint16)
        or image.ndim not in (2, 3)
        or (image.ndim == 3 and image.shape[2] != 3)
    ):
        raise ValueError(
            f"an image of {image.shape} {image.dtype} where (h, w) or (h, w, 3) uint8 or uint16 is expected"
        )
    if image.ndim == 2:
        return image
    grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    return grey.astype(np.uint8) if image.dtype == np.uint8 else grey.astype(np.uint16)
