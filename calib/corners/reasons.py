"""What is wrong with a picture that shows no board, or another one: one plain sentence."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from calib.boards import AnyBoard, AprilGrid, Charuco
from calib.boards.board_file import FAMILIES
from calib.corners.markers import Image, MarkerBoard, Markers, Standing, count_of, detect, search, standing

DARK_DN = 40
"""Where next to no pixel is brighter, there is no light."""

FLAT_DN = 20
"""Between the darkest and the brightest pixels: less is no picture."""

MOST_ELSEWHERE = 0.5
"""Of the markers found; if more do not stand as on the board, it is another."""

OTHERS = (
    ("DICT_4X4_1000", 1), ("DICT_5X5_1000", 1), ("DICT_6X6_1000", 1), ("DICT_7X7_1000", 1),
    ("DICT_ARUCO_ORIGINAL", 1), ("DICT_APRILTAG_36h11", 1), ("DICT_APRILTAG_36h11", 2),
)  # fmt: skip
BLURRED_PX, SMEARED, SMOOTH_PX = 2.0, 2.0, 1.0
"""Standard deviation of a blur that is told; of one direction against the other; of what takes noise off."""

FEWEST_OTHERS = 6
FEWEST_MIRRORED = 3


def doubled(board: MarkerBoard, markers: Markers, stands: Standing | None) -> str:
    """Say that two boards with the same markers are in view; '' if not."""
    ids = [int(number) for number in markers.ids if 0 <= number - board.first_id < count_of(board)]
    twice = sorted({number for number in ids if ids.count(number) > 1})
    if len(twice) < 2:
        return ""
    middles = [markers.corners_px[k].mean(axis=0) for k in np.flatnonzero(markers.ids == twice[0])[:2]]
    if stands is not None:
        # the same marker read twice at one place is one marker
        side = float(np.linalg.norm(stands.corners_px[0, 1] - stands.corners_px[0, 0]))
        if np.linalg.norm(middles[1] - middles[0]) < side:
            return ""
    places = " and ".join(f"({x:.0f}, {y:.0f})" for x, y in middles)
    return (
        f"two boards with the same markers are in view: {len(twice)} markers are there twice, "
        f"marker {twice[0]} at {places} px; one is to be covered"
    )


def why_not_this_board(board: MarkerBoard, markers: Markers, stands: Standing | None) -> str:
    """Say that the markers in view are of a board drawn otherwise; '' if they are of this one."""
    found = len(markers.ids)
    standing_count = 0 if stands is None else len(stands.ids)
    last = board.first_id + count_of(board) - 1
    outside = [int(number) for number in markers.ids if not board.first_id <= number <= last]
    mine = found - len(outside)  # others may be of a second board, which is no harm
    if found < 4 or standing_count == mine > 0:
        return ""
    if isinstance(board, Charuco):
        flipped = standing(markers, replace(board, legacy=not board.legacy))
        if flipped is not None and len(flipped.ids) > standing_count:
            today, before = (
                "as OpenCV draws it today (legacy: false)",
                "as OpenCV before 4.6 draws it (legacy: true)",
            )
            drawn = today if board.legacy else before
            return f"the markers in view stand as on another board: {drawn}; BOARD.yaml says otherwise"
    if mine and standing_count >= MOST_ELSEWHERE * mine:
        return ""
    for other, what in _relatives(board):
        others = standing(markers, other)
        if others is not None and len(others.ids) > max(0.8 * found, standing_count):
            return f"the markers in view stand as on another board: {what}, where {_drawn(board)} is expected"
    if len(outside) > MOST_ELSEWHERE * found:
        wanted = f"{board.first_id} to {last} are expected"
        return f"another board is in view: its markers are {_some(outside)}, where {wanted}"
    return f"another board is in view: its {found} markers do not stand as on one of {_drawn(board)}"


def why_nothing(board: AnyBoard, image: Image) -> str:
    """Say why no board is seen."""
    dark, bright = (float(value) for value in np.percentile(image, (1.0, 99.5)))
    if bright < DARK_DN:
        return f"the picture is too dark: all but the brightest 0.5 % of it is below {bright:.0f} of 255"
    if bright - dark < FLAT_DN:
        return f"the picture shows next to nothing: its levels are between {dark:.0f} and {bright:.0f} of 255"
    if isinstance(board, Charuco | AprilGrid):
        told = _mirrored(board, image) or _others(board, image)
        if told:
            return told
    return _blurred(image) or (
        "the board is not in the picture, or too far away, too slanted or too much covered to be read"
    )


def _mirrored(board: MarkerBoard, image: Image) -> str:
    flipped = detect(np.ascontiguousarray(image[:, ::-1]), board)
    if standing(flipped, board) is None or len(flipped.ids) < FEWEST_MIRRORED:
        return ""
    return "the board is mirrored: it was printed or the picture was taken the wrong way round"


def _blurred(image: Image) -> str:
    """Say over how many pixels the sharpest edges of a picture are spread, if that is too much."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), SMOOTH_PX)
    range_dn = float(np.ptp(np.percentile(smooth, (1.0, 99.5))))
    widths = []
    for axis in (1, 0):
        steepest = float(np.percentile(np.abs(np.gradient(smooth, axis=axis)), 99.8))
        # an edge blurred by a normal distribution is steepest in its middle
        spread = range_dn / max(steepest, 1e-6) / np.sqrt(2 * np.pi)
        widths.append(float(np.sqrt(max(spread**2 - SMOOTH_PX**2, 0.0))))
    across, down = widths
    if max(widths) > BLURRED_PX and max(widths) > SMEARED * min(widths):
        way = "across" if across > down else "down"
        wide = f"its sharpest edges that way are spread over {2 * max(widths):.0f} px"
        return f"no board can be read; the picture moved {way} during its exposure: {wide}"
    if min(widths) > BLURRED_PX:
        wide = f"its sharpest edges are spread over {2 * min(widths):.0f} px"
        return f"no board can be read; the picture is blurred: {wide}"
    return ""


def _others(board: MarkerBoard, image: Image) -> str:
    """Markers of another dictionary."""
    mine = board.dictionary if isinstance(board, Charuco) else FAMILIES[board.family]
    border = board.border if isinstance(board, AprilGrid) else 1
    for dictionary, width in OTHERS:
        if (dictionary.split("_")[:2], width) == (mine.split("_")[:2], border):
            continue
        found = search(image, dictionary, width)
        if len(found.ids) >= FEWEST_OTHERS:
            other = f"{dictionary} with a border of {width}" if "APRIL" in dictionary else dictionary
            return f"another board is in view: its markers are of {other}, not of {mine}"
    return ""


def _relatives(board: MarkerBoard) -> list[tuple[MarkerBoard, str]]:
    """Boards that are easily taken for this one, and how they differ."""
    return [
        (replace(board, columns=columns, rows=rows), f"{columns} columns")
        for columns in range(3 if isinstance(board, Charuco) else 2, 31)
        for rows in [max(3, 2 * count_of(board) // columns + 2)]
        if columns != board.columns
    ]


def _drawn(board: MarkerBoard) -> str:
    what = "tags" if isinstance(board, AprilGrid) else "squares"
    return f"{board.columns} x {board.rows} {what}"


def _some(numbers: list[int]) -> str:
    told = ", ".join(map(str, sorted(numbers)[:4]))
    return told + (f" and {len(numbers) - 4} more" if len(numbers) > 4 else "")
