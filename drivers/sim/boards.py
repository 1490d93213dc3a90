"""Boards in the scene: thin boxes with a picture on the side that looks at the camera."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.geometry.rigid import Rigid
from drivers.errors import BadOptions
from drivers.sim import ground, rocks
from drivers.sim.kept import kernels
from drivers.sim.placed import (
    BOARD_M,
    DICTIONARIES,
    MOST_TEXELS,
    PlacedBoard,
    PlacedCharuco,
    PlacedDots,
    PlacedPicture,
    read_picture,
)
from drivers.sim.rocks import Brick

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

FINEST_M = 0.0005
"""Texels of drawn pictures are no smaller, unless the smallest feature asks for it."""

TEXELS_A_FEATURE = 16
WHITE, BLACK = 1.6, 0.12
"""Of paper and ink, where gravel is 1 on the mean."""


@dataclass(frozen=True, eq=False)
class SceneBoard:
    """A board where it stands.

    Attributes
    ----------
    site_from_board
        Board frame: origin in the middle of the face, x to the right, y down, z into the board.
    size_m
        Width and height.
    face
        What is on it.
    """

    site_from_board: Rigid
    size_m: tuple[float, float]
    face: PlacedDots | PlacedCharuco | PlacedPicture


def standing(placed: PlacedBoard, ground_z_m: Callable[[float, float], float]) -> SceneBoard:
    """Return the board on the ground."""
    heading, lean = placed.heading_rad, placed.lean_rad
    looks = np.array(
        [math.cos(heading) * math.cos(lean), math.sin(heading) * math.cos(lean), -math.sin(lean)]
    )
    right = np.array([math.sin(heading), -math.cos(heading), 0.0])
    down = np.cross(-looks, right)
    height_m = placed.face.size_m[1]
    foot = np.array([placed.x_m, placed.y_m, ground_z_m(placed.x_m, placed.y_m) - placed.raised_m])
    rotation = np.column_stack([right, down, -looks])
    return SceneBoard(Rigid(rotation, foot - 0.5 * height_m * down), placed.face.size_m, placed.face)


def meshes(boards: Sequence[SceneBoard]) -> Any:
    """Return the ``kernels.Rocks`` of boards: boxes whose upper side is the face."""
    boxes = []
    for board in boards:
        width_m, height_m = board.size_m
        flat = 0.5 * np.array([[width_m, height_m], [width_m, -height_m], [-width_m, -height_m],
                               [-width_m, height_m]])  # fmt: skip
        corners = np.concatenate([np.column_stack([flat, np.full(4, z_m)]) for z_m in (0.0, BOARD_M)])
        boxes.append(Brick(board.site_from_board.points(corners)))
    return rocks.meshes(boxes)._replace(boards=np.arange(len(boards)))


def faces(boards: Sequence[SceneBoard]) -> Any:
    """Return the ``kernels.Boards``: where the faces are, and each different picture once."""
    module = kernels()
    different = list(dict.fromkeys(board.face for board in boards))
    pictures = [ground.pyramid(*picture_of(face)) for face in different]
    most = max((len(one.start) for one in pictures), default=1)
    begins = np.cumsum([0, *(one.texels.size for one in pictures)])
    start = np.zeros((len(pictures), most), dtype=np.int64)
    for k, one in enumerate(pictures):
        start[k, : len(one.start)] = one.start + begins[k]
    where = np.empty((len(boards), 4, 3))
    for k, board in enumerate(boards):
        corner = board.site_from_board.points(np.array([-board.size_m[0] / 2, -board.size_m[1] / 2, 0.0]))
        axes = board.site_from_board.rotation.T
        where[k] = corner, axes[0], axes[1], -axes[2]
    return module.Boards(
        where,
        np.array([different.index(board.face) for board in boards], dtype=np.int64),
        np.concatenate([np.empty(0, np.uint16), *(one.texels for one in pictures)]),
        start,
        np.array([one.size for one in pictures], dtype=np.int64),
        np.array([one.levels for one in pictures], dtype=np.int64),
        np.array([one.texel_m for one in pictures], dtype=np.float64),
    )


def picture_of(face: PlacedDots | PlacedCharuco | PlacedPicture) -> tuple[Float32, float]:
    """Return tones (n, n), n a power of two, from the board's corner on, and how wide a texel is, metres."""
    if isinstance(face, PlacedDots):
        grey, texel_m = _dots(face)
    elif isinstance(face, PlacedCharuco):
        grey, texel_m = _charuco(face)
    else:
        image, digest, path = read_picture(face.picture, "simulation.scene.boards.picture", Path())
        if digest != face.digest:
            raise BadOptions(f"{path} changed while the scene was built")
        grey, texel_m = image.astype(np.float32) / 255.0, face.width_m / image.shape[1]
    side = 1 << max(3, math.ceil(math.log2(max(grey.shape))))
    grey = np.pad(grey, [(0, side - grey.shape[0]), (0, side - grey.shape[1])], mode="edge")
    return np.asarray(BLACK + (WHITE - BLACK) * grey, dtype=np.float32), texel_m


def _texel_m(feature_m: float, size_m: tuple[float, float]) -> float:
    """How wide the texels of a drawn picture are."""
    return max(min(FINEST_M, feature_m / TEXELS_A_FEATURE), max(size_m) / MOST_TEXELS)


def _dots(face: PlacedDots) -> tuple[Float32, float]:
    """Black dots, each texel by how far the edge is from its middle, so that no dot is off its place."""
    texel_m = _texel_m(face.dot_diameter_m, face.size_m)
    shape = [math.ceil(side_m / texel_m) for side_m in reversed(face.size_m)]
    y_m, x_m = ((np.arange(count) + 0.5) * texel_m - face.margin_m for count in shape)
    row = np.clip(np.rint(y_m / face.spacing_m), 0, face.rows - 1) * face.spacing_m
    column = np.clip(np.rint(x_m / face.spacing_m), 0, face.columns - 1) * face.spacing_m
    outside_m = np.hypot((y_m - row)[:, None], (x_m - column)[None, :]) - face.dot_diameter_m / 2
    return np.clip(0.5 + outside_m / texel_m, 0.0, 1.0).astype(np.float32), texel_m


def _charuco(face: PlacedCharuco) -> tuple[Float32, float]:
    """OpenCV's own drawing, a whole number of texels a square."""
    count = math.ceil(face.square_m / _texel_m(face.marker_m / 2, face.size_m))
    count = min(count, int(MOST_TEXELS * face.square_m / max(face.size_m)))
    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARIES[face.dictionary])
    board = cv2.aruco.CharucoBoard((face.columns, face.rows), face.square_m, face.marker_m, dictionary)
    drawn = board.generateImage((face.columns * count, face.rows * count), marginSize=0, borderBits=1)
    texel_m = face.square_m / count
    # the margin is a whole number of texels too: the face's corner is moved, not the squares
    margin = math.ceil(face.margin_m / texel_m)
    grey = np.pad(drawn.astype(np.float32) / 255.0, margin, constant_values=1.0)
    aside = margin * texel_m - face.margin_m
    if aside > 0.0:
        back = np.array([[1.0, 0.0, -aside / texel_m], [0.0, 1.0, -aside / texel_m]])
        grey = cv2.warpAffine(
            grey, back, (grey.shape[1], grey.shape[0]), flags=cv2.INTER_LINEAR, borderValue=1.0
        )
    return np.asarray(grey, dtype=np.float32), texel_m
