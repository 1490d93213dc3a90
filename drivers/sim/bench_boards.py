"""Boards before the simulated rover: placed by its configuration, or moved while it runs, and bent.

They are drawn over the picture of the scene, by where each pixel's ray meets the board, and hide what is
behind them; nothing of the scene hides them and they throw no shadow.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid, rot_x, rot_y, rot_z
from calib.targets.boards import FLAT, AnyBoard, Bow
from calib.targets.pattern import pattern_of
from drivers.errors import BadOptions
from drivers.sim.placed import REACH_M, PlacedBoard
from drivers.sim.render import Draw, camera_key, ray_table

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

PAPER_DN, INK_DN = 205.0, 35.0
RAYS = 144
WITHIN = np.stack([np.arange(RAYS) / RAYS, np.arange(RAYS) * 89 / RAYS % 1.0], axis=-1) - 0.5 + 0.5 / RAYS
"""Places of rays in a pixel that sees an edge: Fibonacci's lattice, even across edges of any slant. So many,
since of 34 some slants see but a few lines, and whole edges stand aside: corners by up to 0.05 px, against
0.015 px."""

RIM = np.array([[0.0, 0.0], [-0.5, 0.0], [0.0, -0.5], [-0.5, -0.5]])
"""Those that tell whether it does: middle, sides and corners, the others being the next pixels'."""

OUTLINE_POINTS = 33
RAYS_AT_ONCE = 60_000
BENT_STEPS = 5
TABLES_KEPT = 8


MOST_BOARDS = 8
MOST_BOW_M = 0.05


@dataclass(frozen=True, eq=False)
class BenchBoard:
    """A board where it is: origin in its middle, x right, y down, z into the board.

    By ``bow_m`` its middle stands out, across and down (`calib.targets.boards`).
    """

    board: AnyBoard
    site_from_board: Rigid
    bow_m: Bow = FLAT
    margin_m: float = 0.01

    def hits(self, origins_m: Float64, directions: Float64) -> tuple[Float64, Float64]:
        """Return where rays (n, 3) of the board's frame meet its surface, (n, 2) metres, and how far on (n,).

        Not-a-number for rays that never do; the surface goes on beyond the paper.
        """
        reach = [line[-1] for line in self.board.lines_m]
        with np.errstate(divide="ignore", invalid="ignore"):
            along = -origins_m[:, 2] / directions[:, 2]
            for _ in range(BENT_STEPS if self.bow_m != FLAT else 0):
                x, y = (origins_m + along[:, None] * directions)[:, :2].T / np.array(reach)[:, None]
                z_m = -self.bow_m[0] * (1.0 - x**2) - self.bow_m[1] * (1.0 - y**2)
                along = (z_m - origins_m[:, 2]) / directions[:, 2]
            along[~(along > 0.0)] = np.nan
            return (origins_m + along[:, None] * directions)[:, :2], along

    @property
    def half_size_m(self) -> Float64:
        """How far the paper reaches from the origin, (2,)."""
        return np.asarray(np.array(self.board.size_m) / 2 + self.margin_m)


def placed_board(placed: PlacedBoard, ground_z_m: Callable[[float, float], float]) -> BenchBoard:
    """Return a board of the configuration as it stands on the ground, whose z is ``ground_z_m(x_m, y_m)``."""
    heading, lean = placed.heading_rad, placed.lean_rad
    ahead = np.array(
        [math.cos(heading) * math.cos(lean), math.sin(heading) * math.cos(lean), -math.sin(lean)]
    )
    right = np.array([math.sin(heading), -math.cos(heading), 0.0])
    down = np.cross(-ahead, right)
    foot = np.array([placed.x_m, placed.y_m, ground_z_m(placed.x_m, placed.y_m) - placed.raised_m])
    stands = Rigid(np.column_stack([right, down, -ahead]), foot - 0.5 * placed.size_m[1] * down)
    return BenchBoard(placed.board, stands, margin_m=placed.paper_m)


class BenchBoards:
    """Boards over the pictures of a scene; they come and go while it runs. Safe from any thread.

    ``image`` draws the scene; ``placed`` are boards that stay.
    """

    def __init__(self, image: Draw, placed: Sequence[BenchBoard] = ()) -> None:
        self._scene_image = image
        self._placed = tuple(placed)
        self._lock = threading.Lock()
        self._boards: Mapping[str, BenchBoard] = MappingProxyType({})
        self._rays: dict[tuple[object, ...], tuple[Float64, Float64]] = {}

    @property
    def boards(self) -> Mapping[str, BenchBoard]:
        """The boards by name, as they are now."""
        return self._boards

    def put(self, name: str, board: BenchBoard | None) -> None:
        """Have a board stand somewhere from the next picture on; None takes it away."""
        with self._lock:
            others = {key: one for key, one in self._boards.items() if key != name}
            self._boards = MappingProxyType(others if board is None else {**others, name: board})

    def image(
        self,
        camera: CameraModel,
        site_from_camera_frame: Rigid,
        samples: int = 2,
        rows: tuple[int, int] | None = None,
    ) -> Float32:
        """Return the picture of the scene with the boards over it, as `drivers.sim.render.Renderer.image`."""
        boards = (*self._placed, *self._boards.values())
        image = self._scene_image(camera, site_from_camera_frame, samples, rows)
        if not boards:
            return image
        camera_m = site_from_camera_frame.points(camera.C)
        far_first = sorted(
            boards, key=lambda one: -float(np.linalg.norm(one.site_from_board.translation_m - camera_m))
        )
        for board in far_first:
            board_from_frame = board.site_from_board.inverse @ site_from_camera_frame
            self._draw(image, camera, board_from_frame, board, rows or (0, image.shape[0]))
        return image

    def cast(self, origins_m: ArrayLike, directions: ArrayLike, ranges_m: Float64) -> Float64:
        """Return how far rays of the site frame go, (..., 3) both, with the boards in their way.

        ``ranges_m`` (...,) is how far they go without.
        """
        origins, wanted = np.broadcast_arrays(
            np.asarray(origins_m, dtype=np.float64), np.asarray(directions, dtype=np.float64)
        )
        found = ranges_m.reshape(-1)
        for board in (*self._placed, *self._boards.values()):
            to_board = board.site_from_board.inverse
            unit = wanted.reshape(-1, 3)
            unit = unit / np.linalg.norm(unit, axis=-1, keepdims=True)
            hits, along = board.hits(to_board.points(origins.reshape(-1, 3)), to_board.vectors(unit))
            along = np.where((np.abs(hits) <= board.half_size_m).all(axis=-1), along, np.nan)
            found = np.fmin(found, along)
        return np.asarray(found.reshape(ranges_m.shape))

    def _draw(
        self, image: Float32, camera: CameraModel, to_board: Rigid, board: BenchBoard, rows: tuple[int, int]
    ) -> None:
        """Draw one board into rows [first, last) of a picture."""
        left, top, right, bottom = _box_px(camera, to_board.inverse, board)
        top, bottom = max(top, rows[0]), min(bottom, rows[1] - 1)
        if right - left < 1 or bottom - top < 1:
            return
        rays, starts = self._table(camera)
        box = slice(top, bottom + 1), slice(left, right + 1)
        shape = rays[box].shape[:2]
        origins = to_board.points(camera.C + starts[box].reshape(-1, 3))
        directions = to_board.vectors(rays[box].reshape(-1, 3))
        hits, _ = board.hits(np.broadcast_to(origins, directions.shape), directions)
        grid = hits.reshape(*shape, 2)
        # within a pixel the way from image to board is straight to a millionth of the board's cells
        by_row, by_column = (np.gradient(grid, axis=axis).reshape(-1, 2) for axis in (0, 1))
        front = directions[:, 2] > 0.0
        few = self._sampled(board, hits, by_column, by_row, front, RIM)
        seen = few[0] + 1000.0 * few[1]
        busy = np.flatnonzero(_uneven(seen.reshape(*shape, len(RIM))))
        value, covered = few[..., 0].copy()
        for k in range(0, len(busy), RAYS_AT_ONCE // RAYS):
            some = busy[k : k + RAYS_AT_ONCE // RAYS]
            many = self._sampled(board, hits[some], by_column[some], by_row[some], front[some], WITHIN)
            value[some], covered[some] = many.mean(axis=-1)
        under = image[box]
        under[...] = under * (1.0 - covered.reshape(shape)) + value.reshape(shape)

    @staticmethod
    def _sampled(
        board: BenchBoard,
        hits: Float64,
        by_column: Float64,
        by_row: Float64,
        front: NDArray[np.bool_],
        offsets: Float64,
    ) -> Float64:
        """Light and cover (2, n, k) of places in pixels, ``offsets`` (k, 2) from their middles."""
        x, y = (
            hits[:, k, None]
            + np.outer(by_column[:, k], offsets[:, 0])
            + np.outer(by_row[:, k], offsets[:, 1])
            for k in (0, 1)
        )
        most_x, most_y = board.half_size_m
        with np.errstate(invalid="ignore"):
            paper = (np.abs(x) <= most_x) & (np.abs(y) <= most_y)
        black = pattern_of(board.board).is_black(x, y) & front[:, None]
        return np.stack([paper * np.where(black, INK_DN, PAPER_DN), paper])

    def _table(self, camera: CameraModel) -> tuple[Float64, Float64]:
        """Directions (h, w, 3) of a camera's rays, and where they begin relative to C, (h, w, 3)."""
        key = camera_key(camera)
        with self._lock:
            if key not in self._rays:
                table = ray_table(camera, 1)
                rays = table.rays[:, :, 0].astype(np.float64)
                starts = table.starts[:, :, 0] if table.starts.size else np.zeros_like(rays)
                self._rays[key] = rays, np.asarray(starts, dtype=np.float64)
                while len(self._rays) > TABLES_KEPT:
                    del self._rays[next(iter(self._rays))]
            return self._rays[key]


def facing(camera_m: ArrayLike, position_m: ArrayLike, turned_rad: ArrayLike = (0.0, 0.0, 0.0)) -> Rigid:
    """Return frame_from_board of a board at a place, upright and square to a camera, then turned about
    itself.

    Both places are (3,) metres in a frame whose z is down. It is turned about its own x (its upper edge comes
    nearer), y (its right edge comes nearer) and z (it turns to the right, as seen from the camera), z first.

    Raises BadOptions if the board would be right over or under the camera, where nothing is upright.
    """
    away = np.asarray(position_m, dtype=np.float64) - np.asarray(camera_m, dtype=np.float64)
    right = np.cross([0.0, 0.0, 1.0], away)
    if float(np.linalg.norm(right)) < 1e-3:
        place = ", ".join(f"{value:.3f}" for value in np.asarray(position_m, dtype=np.float64))
        raise BadOptions(f"a board at ({place}) m is right over or under the camera, expected one beside it")
    x, z = right / np.linalg.norm(right), away / np.linalg.norm(away)
    about_x, about_y, about_z = (float(angle) for angle in np.asarray(turned_rad, dtype=np.float64))
    square = np.column_stack([x, np.cross(z, x), z])
    return Rigid(
        square @ rot_x(about_x) @ rot_y(about_y) @ rot_z(about_z), np.asarray(position_m, dtype=np.float64)
    )


def checked(name: str, board: BenchBoard, others: Collection[str]) -> BenchBoard:
    """Return a board that may stand there. Raises BadOptions with what is wrong."""
    place = board.site_from_board.translation_m
    if not (np.isfinite(place).all() and float(np.abs(place).max()) <= REACH_M):
        raise BadOptions(
            f"board {name} at {place.tolist()} m, expected within {REACH_M:g} m of the site's origin"
        )
    if not max(abs(one) for one in board.bow_m) <= MOST_BOW_M:
        raise BadOptions(f"board {name}: bow_m is {list(board.bow_m)}, expected {MOST_BOW_M:g} m at most")
    if name not in others and len(others) >= MOST_BOARDS:
        raise BadOptions(f"board {name} would be one more than {MOST_BOARDS}; take another away first")
    return board


def _uneven(seen: Float64) -> NDArray[np.bool_]:
    """Which pixels (h, w) see more than one colour at their middles, sides and corners (h, w, 4)."""
    height, width = seen.shape[:2]
    fine = np.empty((2 * height + 1, 2 * width + 1))
    for k, (dx, dy) in enumerate(RIM):
        fine[int(2 * dy) + 1 : -1 : 2, int(2 * dx) + 1 : -1 : 2] = seen[..., k]
    fine[-1], fine[:, -1] = fine[-2], fine[:, -2]
    from scipy import ndimage  # loaded in 0.2 s, and only where a board is drawn

    least = ndimage.minimum_filter(fine, size=3)
    return np.asarray((ndimage.maximum_filter(fine, size=3) != least)[1::2, 1::2])


def _box_px(camera: CameraModel, frame_from_board: Rigid, board: BenchBoard) -> tuple[int, int, int, int]:
    """The pixels that may see the paper: left, top, right, bottom, all inclusive, inside the image."""
    x_m, y_m = board.half_size_m
    t = np.linspace(-1.0, 1.0, OUTLINE_POINTS)
    one = np.ones_like(t)
    out_m = [0.0, -board.bow_m[0] - board.bow_m[1]]
    sides = [(t, one), (t, -one), (one, t), (-one, t)]
    outline = [np.stack([x_m * x, y_m * y, z + 0 * x], axis=-1) for x, y in sides for z in out_m]
    pixels, valid = camera.project(frame_from_board.points(np.concatenate(outline)))
    width, height = camera.size_px
    if not valid.any():
        return 0, 0, -1, -1
    if not valid.all():
        return 0, 0, width - 1, height - 1
    low = np.maximum(np.floor(pixels.min(axis=0)) - 3, 0).astype(int)
    high = np.minimum(np.ceil(pixels.max(axis=0)) + 3, [width - 1, height - 1]).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
