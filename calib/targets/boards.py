"""The kinds of boards: the print, and where its corners are in the board's frame.

Board frame: origin in the middle of the grid of corners, x to the right along a row, y down a column, z into
the board. Sizes are those of the print in hand, after a measured bar (`calib.targets.board_file`).

A board bends. ``bow_m`` = (across, down) is how far its middle stands out towards the viewer: against its
left and right edges, and against its upper and lower ones. mrcal calls it calobject_warp.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.geometry.rigid import FloatArray, IntArray

Grey8 = NDArray[np.uint8]
"""(h, w) grey levels of 8 bits; the centre of the top-left pixel is (0, 0)."""
Levels = Grey8 | NDArray[np.uint16]
"""The same of 8 or 16 bits."""

Bow = tuple[float, float]
FLAT: Bow = (0.0, 0.0)


@dataclass(frozen=True)
class _Grid(ABC):
    """Corners at crossings of lines; what a kind adds are the lines.

    ``columns`` and ``rows`` count squares, tags or dots. ``aspect`` is the length down over the length across
    of what is drawn equally long: a printer's two directions differ.
    """

    columns: int
    rows: int
    aspect: float = field(default=1.0, kw_only=True)

    @property
    @abstractmethod
    def lines_m(self) -> tuple[FloatArray, FloatArray]:
        """Where the corners' columns (x) and rows (y) are, metres in the board frame, ascending."""

    @property
    def ids(self) -> IntArray:
        """(n,) every corner that the board has."""
        across, down = self.lines_m
        return np.arange(len(across) * len(down))

    def cells(self, ids: ArrayLike) -> tuple[IntArray, IntArray]:
        """Return the rows and columns (n,) of corners, counted from the upper left one. Raises ValueError."""
        across, down = self.lines_m
        wanted = np.asarray(ids, dtype=np.int64)
        if wanted.size and not (wanted.min() >= 0 and wanted.max() < len(across) * len(down)):
            raise ValueError(
                f"ids {wanted.min()} to {wanted.max()} where 0 to {len(across) * len(down) - 1} are"
            )
        rows, columns = np.divmod(wanted, len(across))
        return rows, columns

    def in_board_m(self, ids: ArrayLike, bow_m: Bow = FLAT) -> FloatArray:
        """Return where corners (n,) are, (n, 3) metres in the board frame; linear in ``bow_m``.

        The middle of a bent board is at z = -(across + down), its four outermost corners at z = 0.
        """
        rows, columns = self.cells(ids)
        across, down = self.lines_m
        x, y = across[columns], down[rows]
        z = -bow_m[0] * (1.0 - (x / across[-1]) ** 2) - bow_m[1] * (1.0 - (y / down[-1]) ** 2)
        return np.stack([x, y, z], axis=-1)


@dataclass(frozen=True)
class _Squares(_Grid):
    """Black and white squares; corner = row * (columns - 1) + column, where four squares meet."""

    square_m: float

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the print without its white margin."""
        return self.columns * self.square_m, self.rows * self.square_m * self.aspect

    @property
    def lines_m(self) -> tuple[FloatArray, FloatArray]:
        """Where the corners' columns and rows are."""
        return (
            _even(self.columns - 1, self.square_m),
            _even(self.rows - 1, self.square_m * self.aspect),
        )


@dataclass(frozen=True)
class Checkerboard(_Squares):
    """A plain chessboard, the square in its upper left corner black.

    It has no markers, so it must be seen whole. If columns and rows are both even or both odd it looks the
    same upside down; then the side that is up in the image is its upper side.
    """

    kind: ClassVar[Literal["checkerboard"]] = "checkerboard"


@dataclass(frozen=True)
class Charuco(_Squares):
    """A ChArUco board of OpenCV: squares, the upper left one black, and a marker in each white square.

    ``marker_m`` is with the black border. Markers count row by row from ``first_id``. ``legacy``: OpenCV
    before 4.6 drew boards of an even number of rows with a white square in the upper left corner.
    """

    marker_m: float
    dictionary: str = "DICT_5X5_100"
    first_id: int = 0
    legacy: bool = False

    kind: ClassVar[Literal["charuco"]] = "charuco"

    @property
    def first_is_white(self) -> bool:
        """Whether the square in the upper left corner is white."""
        return self.legacy and self.rows % 2 == 0


@dataclass(frozen=True)
class AprilGrid(_Grid):
    """Tags in rows and columns with a black square between the corners of each four: Kalibr's AprilGrid.

    Tags count from the lower left one (``first_id``), to the right and then up. So do corners, row by row
    over all tags: corner 0 is the lower left corner of the first tag, corner 2 * columns the one over it.
    ``tag_m`` is with the black border, ``gap_m`` the white between two tags and the side of the black
    squares; Kalibr's ``tagSpacing`` is gap_m / tag_m. ``border`` is the width of the black border in a tag's
    cells; Kalibr draws 2, AprilTag's own pictures have 1.
    """

    tag_m: float
    gap_m: float
    family: str = "tag36h11"
    first_id: int = 0
    border: int = 2

    kind: ClassVar[Literal["aprilgrid"]] = "aprilgrid"

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the print without its white margin, the outer black squares included."""
        step = self.tag_m + self.gap_m
        return self.columns * step + self.gap_m, (self.rows * step + self.gap_m) * self.aspect

    @property
    def lines_m(self) -> tuple[FloatArray, FloatArray]:
        """Where the corners' columns and rows are."""
        return self._pairs(self.columns), self._pairs(self.rows) * self.aspect

    def cells(self, ids: ArrayLike) -> tuple[IntArray, IntArray]:
        """Return the rows and columns (n,) of corners, counted from the upper left one."""
        rows, columns = super().cells(ids)
        return 2 * self.rows - 1 - rows, columns

    def _pairs(self, count: int) -> FloatArray:
        middles = _even(count, self.tag_m + self.gap_m)
        return np.stack([middles - self.tag_m / 2, middles + self.tag_m / 2], axis=-1).ravel()


@dataclass(frozen=True)
class DotBoard(_Grid):
    """Dots in rows and columns; dot = row * columns + column."""

    spacing_m: float
    dot_diameter_m: float

    kind: ClassVar[Literal["dots"]] = "dots"

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of the print without its white margin."""
        across = (self.columns - 1) * self.spacing_m + self.dot_diameter_m
        down = (self.rows - 1) * self.spacing_m + self.dot_diameter_m
        return across, down * self.aspect

    @property
    def lines_m(self) -> tuple[FloatArray, FloatArray]:
        """Where the dots' columns and rows are."""
        return _even(self.columns, self.spacing_m), _even(self.rows, self.spacing_m * self.aspect)

    def dots_in_board_m(self, rows: ArrayLike, columns: ArrayLike) -> FloatArray:
        """Return the centres (n, 3), metres, of dots (rows (n,), columns (n,)), counted from 0."""
        across, down = self.lines_m
        x, y = across[np.asarray(columns)], down[np.asarray(rows)]
        return np.stack([x, y, np.zeros_like(x)], axis=-1)


@dataclass(frozen=True, eq=False)
class Board(DotBoard):
    """The dot board of a survey; ``tapes_in_board_m`` maps the name of a tape to its place (3,), metres."""

    tapes_in_board_m: Mapping[str, FloatArray] = field(default_factory=dict)


AnyBoard = Charuco | AprilGrid | DotBoard | Checkerboard


def _even(count: int, step_m: float) -> FloatArray:
    """So many lines, a step apart, about 0."""
    return np.asarray((np.arange(count) - (count - 1) / 2) * step_m, dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Corners:
    """Corners of one board in one image; arrays are read-only.

    ``ids`` (n,) as the board counts them, each once; ``pixels_px`` (n, 2), of a dot the image of its centre;
    ``sigma_px`` (n,) one standard deviation, each axis.
    """

    ids: IntArray
    pixels_px: FloatArray
    sigma_px: FloatArray

    def __post_init__(self) -> None:
        ids = np.array(self.ids, dtype=np.int64).reshape(-1)
        pixels = np.array(self.pixels_px, dtype=np.float64).reshape(-1, 2)
        sigma = np.array(self.sigma_px, dtype=np.float64).reshape(-1)
        if not len(ids) == len(pixels) == len(sigma):
            raise ValueError(
                f"{len(ids)} ids, {len(pixels)} pixels and {len(sigma)} sigmas do not go together"
            )
        for name, array in (("ids", ids), ("pixels_px", pixels), ("sigma_px", sigma)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def __len__(self) -> int:
        return len(self.ids)


class CornersNotFound(NamedTuple):
    """The reason, one plain sentence, why an image shows no corners or dots of a board."""

    reason: str


NO_BOARD = Board(0, 0, 0.0, 0.0)
"""The surveyed board of a bench: none."""


@dataclass(frozen=True, eq=False)
class Dots:
    """Dots found in one image.

    ``rows`` and ``columns`` (n,) from 0; ``pixels_px`` (n, 2) the images of the dots' centres; ``sigma_px``
    (n,) one standard deviation, each axis, None where it was not measured.
    """

    rows: IntArray
    columns: IntArray
    pixels_px: FloatArray
    sigma_px: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.rows)
