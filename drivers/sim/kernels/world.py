"""What the compiled functions draw: heightfields, rocks, textures and the sun, as tuples of arrays.

Inside, heights are *elevations*, up positive (site z is down): e = -z. Lengths along a ray are metres because
directions are unit vectors. Geometry is float64.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, cast

import numpy as np
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from drivers.sim.kernels.compiling import part

Float64 = NDArray[np.float64]
Float32 = NDArray[np.float32]
Int64 = NDArray[np.int64]

FAR = 1e30
NOTHING = -1
ONE = 16384.0  # the texel value that means brightness 1
PAD = 32  # not one: rows a power of two apart would share one place in the cache
AMBIENT = 0.30


class Grid(NamedTuple):
    """A square heightfield of triangles: each cell is cut from its (0, 0) to its (1, 1) corner.

    elevation_m (n + 1, n + 1) indexed [y, x]; peaks_m holds the highest corner of every block of 2**level
    cells, level 1 first, each level starting at peak_start[level]; the corner of cell (0, 0) is (x0_m, y0_m).
    """

    elevation_m: Float32
    peaks_m: Float32
    peak_start: Int64
    cells: int
    levels: int
    cell_m: float
    x0_m: float
    y0_m: float
    lowest_m: float
    highest_m: float


class Rocks(NamedTuple):
    """Closed meshes of 1280 triangles each, in the order of a subdivided icosahedron.

    Four triangles in a row have one parent, sixteen one grandparent, sixty-four one of the 20 first faces;
    boxes_a (k, 20, 6), boxes_b (k, 80, 6), boxes_c (k, 320, 6) bound those, as (low xyz, high xyz).
    spheres (k, 4) is (centre, radius); corners_m (k, 1280, 3, 3); normals (k, 1280, 3, 3), at the corners;
    boards (k,) is the place of a board among ``Boards``, NOTHING for a stone or a brick.
    """

    spheres_m: Float64
    boxes_a: Float64
    boxes_b: Float64
    boxes_c: Float64
    corners_m: Float64
    normals: Float32
    tones: Float32
    boards: Int64


class Texture(NamedTuple):
    """A square, repeating picture with its halved versions behind one another, level 0 first.

    Texel (i, j) of level k covers [i, i + 1) x [j, j + 1) times 2**k texels of level 0, so its centre is at
    (i + 0.5) 2**k: levels lie exactly on each other. Behind each row and each level the first texels come
    again, ``PAD`` of them and one row. Values are relative brightness times ``ONE``.
    """

    texels: NDArray[np.uint16]
    start: Int64
    size: int
    levels: int
    texel_m: float


class Boards(NamedTuple):
    """Flat faces with pictures.

    faces_m (n, 4, 3): the corner where the picture begins, the directions of its x and of its y, and where
    the face looks to; picture (n,) says which. Pictures are as in ``Texture``, all behind one another in
    texels; start (p, levels) is counted from the first.
    """

    faces_m: Float64
    picture: Int64
    texels: NDArray[np.uint16]
    start: Int64
    size: Int64
    levels: Int64
    texel_m: Float64


class World(NamedTuple):
    """All that a ray can meet, and the light on it."""

    inner: Grid
    outer: Grid
    rocks: Rocks
    detail: Texture
    broad: Texture
    stone: Texture
    boards: Boards
    sun: Float64


def _borrowed(_context: Any, array: Any) -> Any:
    """Return the array without its owner, so that passing it on counts no references.

    The counts are atomic: with them a picture takes two to three times as long. The caller keeps the owner.
    """

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        proxy = numba_structs.create_struct_proxy(signature.return_type)(context, builder, value=arguments[0])
        proxy.meminfo = numba_structs.get_null_value(proxy.meminfo.type)
        return proxy._getvalue()

    return array(array), generate


numba_structs: Any = cgutils
borrowed = cast(Callable[[Any], Any], intrinsic(_borrowed))


@part
def borrowed_grid(grid: Grid) -> Grid:
    """The grid without owners."""
    return Grid(
        borrowed(grid.elevation_m),
        borrowed(grid.peaks_m),
        borrowed(grid.peak_start),
        grid.cells,
        grid.levels,
        grid.cell_m,
        grid.x0_m,
        grid.y0_m,
        grid.lowest_m,
        grid.highest_m,
    )


@part
def borrowed_rocks(rocks: Rocks) -> Rocks:
    """The rocks without owners."""
    return Rocks(
        borrowed(rocks.spheres_m),
        borrowed(rocks.boxes_a),
        borrowed(rocks.boxes_b),
        borrowed(rocks.boxes_c),
        borrowed(rocks.corners_m),
        borrowed(rocks.normals),
        borrowed(rocks.tones),
        borrowed(rocks.boards),
    )


@part
def borrowed_boards(boards: Boards) -> Boards:
    """The boards without owners."""
    return Boards(
        borrowed(boards.faces_m),
        borrowed(boards.picture),
        borrowed(boards.texels),
        borrowed(boards.start),
        borrowed(boards.size),
        borrowed(boards.levels),
        borrowed(boards.texel_m),
    )


@part
def borrowed_texture(texture: Texture) -> Texture:
    """The texture without owners."""
    return Texture(
        borrowed(texture.texels), borrowed(texture.start), texture.size, texture.levels, texture.texel_m
    )
