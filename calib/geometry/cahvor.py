"""Camera models: project, ray, Jacobians, motion. CAHV, CAHVOR, CAHVORE, and OpenCV's lenses behind a CAHV.

Pixels are (x, y) = (column, row), 0-based; the centre of the top-left pixel is (0, 0). H and V need not be at
right angles, and mirrored images are as good as others.

A camera of OpenCV's families is a CAHV with a lens in front. Its z is A, its y is the part of V across A, and
its x is at right angles to both. H, V and A in those axes are the camera matrix, with its skew in H.

Sources: Yakimovsky and Cunningham 1978 (CAHV); Gennery 2001, 2006 (CAHVOR, CAHVORE); JPL's camera-model
library as published with VICAR (``cmod_cahv*.c``).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from math import inf, isfinite, sqrt
from numbers import Integral
from typing import TYPE_CHECKING, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from calib.geometry.lenses import Lens, Projection
from calib.geometry.lenses.opencv import OpencvLens
from calib.geometry.lenses.round import RoundLens
from calib.geometry.rigid import FloatArray, ReadOnlyArrays, Rigid, frozen_array, tangents

Kind = Literal[
    "CAHV",
    "CAHVOR",
    "CAHVORE",
    "OPENCV4",
    "OPENCV5",
    "OPENCV8",
    "OPENCV12",
    "OPENCV14",
    "OPENCV_FISHEYE",
]

KINDS: tuple[Kind, ...] = get_args(Kind)

COEFFICIENTS: dict[str, int] = {f"OPENCV{n}": n for n in (4, 5, 8, 12, 14)} | {"OPENCV_FISHEYE": 4}
"""How many coefficients each of OpenCV's families has."""

FREE: tuple[str, ...] = tuple(COEFFICIENTS)
"""Kinds that are a camera matrix with a lens in front."""

_UNIT = 1e-9
"""How far the length of A and O may be from 1."""


class Rays(NamedTuple):
    """Rays through pixels, in the model's frame; rows that do not exist are not-a-number.

    origins_m (..., 3), directions (..., 3) unit length pointing into the scene, valid (...,) bool.
    """

    origins_m: FloatArray
    directions: FloatArray
    valid: np.ndarray


WIDE: tuple[str, ...] = ("CAHVORE", "OPENCV_FISHEYE")
"""Kinds whose slope follows the angle: a fit of one begins as an even fisheye."""


def letters_of(kind: str) -> str:
    """Return the letters of what a kind has numbers for; D stands for OpenCV's coefficients."""
    return "CAHVD" if kind in COEFFICIENTS else kind


@dataclass(frozen=True, eq=False)
class CameraModel(ReadOnlyArrays):
    """One camera, ``size_px`` (width, height) large. The letters are (3,) each, read-only.

    C in metres; A and O unit vectors; H and V in pixels; R and E as published. CAHV ignores O, R and E,
    CAHVOR ignores E, OpenCV's families all three: they are kept as O = A, R = 0, E = 0. ``cahvore_type`` is 1
    (perspective, linearity 1), 2 (fisheye, linearity 0) or 3 (``linearity`` as given); else 0. ``distortion``
    (n,) are OpenCV's coefficients in its order, 4 to 14 as the kind says; none of the CAHV family. ValueError
    names the letter if the parameters do not define a camera.

    A point has a pixel if the lens reaches it. For CAHV and CAHVOR it is then in front of C along
    A and along O. For CAHVORE its ray is within the angle that the linearity allows (a right angle over
    ``linearity``, at most half a turn), and for both it is nearer to O than where the polynomial of R first
    folds. Points so near a CAHVORE lens that two rays of the image pass through them have none. A lens of
    OpenCV's reaches what is nearer to A than where it first folds (``limit_reason``). Everything else comes
    out as not-a-number and False. A point outside the image keeps its numbers.

    Examples
    --------
    >>> H, V = [500, 0, 319.5], [0, 500, 239.5]
    >>> camera = CameraModel("CAHV", (640, 480), C=[0, 0, 0], A=[0, 0, 1], H=H, V=V)
    >>> pixel, valid = camera.project([0.1, 0.0, 1.0])
    >>> pixel.tolist(), bool(valid)
    ([369.5, 239.5], True)
    """

    kind: Kind
    size_px: tuple[int, int]
    C: FloatArray
    A: FloatArray
    H: FloatArray
    V: FloatArray
    O: FloatArray = None  # type: ignore[assignment]  # noqa: E741  the model's own letter; A if not given
    R: FloatArray = None  # type: ignore[assignment]  # 0 if not given
    E: FloatArray = None  # type: ignore[assignment]  # 0 if not given
    cahvore_type: int = 0
    linearity: float = 1.0
    distortion: FloatArray = None  # type: ignore[assignment]  # 0 if not given
    _rows: FloatArray = field(init=False, repr=False)  # C, H, V, A, and the lens frame's x, y, z = O
    projection: Projection = field(init=False, repr=False)  # what stays when the camera moves

    if TYPE_CHECKING:  # vectors may be given as lists

        def __init__(
            self,
            kind: Kind,
            size_px: tuple[int, int],
            C: ArrayLike,
            A: ArrayLike,
            H: ArrayLike,
            V: ArrayLike,
            O: ArrayLike | None = None,  # noqa: E741
            R: ArrayLike | None = None,
            E: ArrayLike | None = None,
            cahvore_type: int = 0,
            linearity: float = 1.0,
            distortion: ArrayLike | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        self._check_kind()
        for letter in "CAHV":
            self._set(letter, _vector(letter, getattr(self, letter)))
        for letter, default in (("O", self.A), ("R", np.zeros(3)), ("E", np.zeros(3))):
            given = getattr(self, letter) if letter in self.letters else None
            self._set(letter, _vector(letter, default if given is None else given))
        for letter, axis in (("A", self.A), ("O", self.O)):
            if not abs(sqrt(float(axis @ axis)) - 1.0) <= _UNIT:
                raise ValueError(f"{letter} is {axis.tolist()} where a vector of length 1 is expected")
        if not self.A @ self.O > 0.0:
            raise ValueError(
                f"O is {self.O.tolist()}, which is not within 90 degrees of A, {self.A.tolist()}"
            )
        if not 1.0 + self.R[0] > 0.0:
            raise ValueError(f"R begins with {self.R[0]:g} where a number above -1 is expected")
        hva = np.array([self.H, self.V, self.A])
        lengths = np.linalg.norm(hva, axis=1)
        # Relative volume of H, V, A below which they lie in one plane.
        if not lengths.all() or not abs(np.linalg.det(hva / lengths[:, None])) > 1e-12:
            raise ValueError("H, V and A lie in one plane where three directions are expected")
        axes = _axes_of(self.A, self.V) if self.kind in FREE else np.array([*tangents(self.O), self.O])
        self._set("_rows", np.array([self.C, *hva, *axes]))
        self._rows.setflags(write=False)
        plane = hva @ axes.T
        if self.kind in FREE:
            plane = np.triu(np.vstack([plane[:2], [0.0, 0.0, 1.0]]))
        self._set_projection(plane)

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _check_kind(self) -> None:
        """Check and settle what is not a vector: kind, size, type and linearity."""
        if self.kind not in KINDS:
            raise ValueError(f"the kind is {self.kind!r} where one of {', '.join(KINDS)} is expected")
        try:
            sizes = [n if isinstance(n, Integral) and not isinstance(n, bool) else 0 for n in self.size_px]
        except TypeError:
            sizes = []
        if len(sizes) != 2 or min(sizes) <= 0:
            raise ValueError(f"the size is {self.size_px!r} where two whole numbers above 0 are expected")
        self._set("size_px", (int(sizes[0]), int(sizes[1])))
        types = (1, 2, 3) if self.kind == "CAHVORE" else (0,)
        if self.cahvore_type not in types:
            expected = "1, 2 or 3" if len(types) == 3 else "0"
            raise ValueError(
                f"the type is {self.cahvore_type!r} where {expected} is expected for {self.kind}"
            )
        linearity = float(self.linearity) if self.cahvore_type == 3 else 1.0 if self.cahvore_type < 2 else 0.0
        if not isfinite(linearity):
            raise ValueError(f"the linearity is {linearity} where a finite number is expected")
        self._set("linearity", linearity)
        count = COEFFICIENTS.get(self.kind, 0)
        given = np.zeros(count) if self.distortion is None else self.distortion
        self._set("distortion", _vector("distortion", given, count))

    def _set_projection(self, pixel_from_slope: FloatArray) -> None:
        """Set what stays when the camera moves."""
        slope_from_pixel = np.asarray(np.linalg.inv(pixel_from_slope), dtype=np.float64)
        for matrix in (pixel_from_slope, slope_from_pixel):
            matrix.setflags(write=False)
        numbers = tuple(self.distortion.tolist())
        slope = _largest_slope(self.size_px, slope_from_pixel)
        lens: Lens
        if self.kind == "OPENCV_FISHEYE":
            lens = RoundLens((0.0, *numbers), curved=True, linearity=0.0, image_slope=slope)
        elif self.kind in FREE:
            lens = OpencvLens(numbers)
        else:
            r, e = tuple(self.R.tolist()), tuple(self.E.tolist())
            lens = RoundLens(r, e, self.kind == "CAHVORE", self.linearity, slope)
        self._set("projection", Projection(lens, pixel_from_slope, slope_from_pixel))

    @classmethod
    def of_matrix(
        cls,
        kind: Kind,
        size_px: tuple[int, int],
        camera_matrix: ArrayLike,
        distortion: ArrayLike,
        rotation: ArrayLike,
        C: ArrayLike,
    ) -> CameraModel:
        """Return a camera of OpenCV's families, or a CAHV, by its numbers; they come back to the last bit.

        ``camera_matrix`` is (3, 3) [[fx, skew, cx], [0, fy, cy], [0, 0, 1]]; a negative fx mirrors the image.
        ``rotation`` (3, 3) is OpenCV's R: its rows are the camera's x right, y down and z ahead in the frame
        of C (3,), where the camera is, metres: -R^T t of OpenCV's t. ValueError as the class, and if the
        rotation or the matrix is none.
        """
        matrix, axes = _vector("camera_matrix", camera_matrix, (3, 3)), _vector("rotation", rotation, (3, 3))
        if (
            matrix[1, 0]
            or matrix[2].tolist() != [0.0, 0.0, 1.0]
            or not matrix[0, 0]
            or not matrix[1, 1] > 0.0
        ):
            raise ValueError(
                f"the camera matrix is {matrix.tolist()} where [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] with "
                "fy above 0 is expected"
            )
        if not np.abs(axes @ axes.T - np.eye(3)).max() <= _UNIT or not np.linalg.det(axes) > 0.0:
            raise ValueError(f"{axes.tolist()} is no rotation")
        h, v = matrix[:2] @ axes
        if kind == "CAHV":
            return cls(kind, size_px, _vector("C", C), axes[2], h, v)
        numbers = _vector("distortion", distortion, -1)
        model = cls(kind, size_px, _vector("C", C), axes[2], h, v, distortion=numbers)
        rows = model._rows.copy()
        rows[4:] = axes
        rows.setflags(write=False)
        model._set("_rows", rows)
        model._set_projection(matrix.copy())
        return model

    @property
    def letters(self) -> str:
        """Letters of what this kind has numbers for (``letters_of``)."""
        return letters_of(self.kind)

    @property
    def lens(self) -> Lens:
        """The lens: what stays, with the plane of the image behind it, when the camera moves."""
        return self.projection.lens

    @property
    def moving(self) -> bool:
        """Whether rays begin elsewhere the more they bend: only a CAHVORE's do."""
        return self.lens.moving

    @property
    def limit_reason(self) -> str:
        """Where the lens ends, as a sentence's end; empty if it has no end but that of its family."""
        return self.lens.limit_reason

    @property
    def why_no_ray(self) -> str:
        """``limit_reason`` as what follows "has no ray in this camera"; empty if it has one."""
        return f": {self.limit_reason}" if self.limit_reason else ""

    @property
    def camera_matrix(self) -> FloatArray:
        """(3, 3) [[fx, skew, cx], [0, fy, cy], [0, 0, 1]] of a CAHV camera or one of OpenCV's families."""
        if self.kind in FREE:
            return self.projection.pixel_from_slope
        inner = np.stack([self.H, self.V]) @ self.rotation.T
        return np.triu(np.vstack([inner, [0.0, 0.0, 1.0]]))

    @property
    def rotation(self) -> FloatArray:
        """(3, 3) OpenCV's R: rows are x right, y down (as V says) and z along A, in the model's frame."""
        return self.lens_axes if self.kind in FREE else _axes_of(self.A, self.V)

    @property
    def image_center_px(self) -> tuple[float, float]:
        """((w-1)/2, (h-1)/2): the middle of the image in pixel-centre coordinates."""
        return ((self.size_px[0] - 1) / 2, (self.size_px[1] - 1) / 2)

    def holds(self, pixel_px: ArrayLike, margin_px: float = 0.0) -> bool:
        """Return whether a pixel (2,) lies in the image, at least ``margin_px`` inside its outer border.

        That runs half a pixel outside the outer pixels' centres. Not-a-number lies outside.
        """
        x, y = np.asarray(pixel_px, dtype=np.float64)
        low, (width, height) = margin_px - 0.5, self.size_px
        return bool(low <= x <= width - 1 - low and low <= y <= height - 1 - low)

    def moved(self, b_from_a: Rigid) -> CameraModel:
        """Return the same camera with its vectors in frame b instead of a: C moves, A H V O turn."""
        rows = self._rows @ b_from_a.rotation.T
        rows[0] += b_from_a.translation_m
        rows.setflags(write=False)
        model = object.__new__(CameraModel)
        letters = {"C": rows[0], "H": rows[1], "V": rows[2], "A": rows[3], "O": rows[6]}
        model.__dict__.update(self.__dict__, _rows=rows, **letters)
        return model

    @property
    def focal_px(self) -> tuple[float, float]:
        """Focal lengths across and down, pixels: ``|A x H|`` and ``|A x V|``."""
        across, down = (float(np.linalg.norm(np.cross(self.A, letter))) for letter in (self.H, self.V))
        return across, down

    @property
    def pose(self) -> Rigid:
        """frame_from_camera: x right, y down (as V says) and z along A, at C."""
        return Rigid(self.rotation.T, self.C)

    def project(self, points_m: ArrayLike) -> tuple[FloatArray, np.ndarray]:
        """Return pixels (..., 2) of points (..., 3), metres in the model's frame, and which are valid (...).

        Points that have no pixel (see the class) come out as not-a-number.
        """
        points = _as_rows(points_m, 3, "points")
        pixels, _, valid = self.projection.project(points.reshape(-1, 3), self.C, self.lens_axes, False)
        return pixels.reshape(*points.shape[:-1], 2), valid.reshape(points.shape[:-1])

    def project_jacobian(self, points_m: ArrayLike) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """As ``project``, with d pixel / d point (..., 2, 3) in px/m between the two."""
        points = _as_rows(points_m, 3, "points")
        shape = points.shape[:-1]
        pixels, rates, valid = self.projection.project(points.reshape(-1, 3), self.C, self.lens_axes, True)
        return pixels.reshape(*shape, 2), rates.reshape(*shape, 2, 3), valid.reshape(shape)

    def ray(self, pixels_px: ArrayLike) -> Rays:
        """Return the rays through pixels (..., 2); a CAHVORE ray begins at the moved entrance point.

        Pixels that no ray of the lens lands on come out as not-a-number.
        """
        return self._rays(pixels_px, False)[0]

    def ray_jacobian(self, pixels_px: ArrayLike) -> tuple[Rays, FloatArray, FloatArray]:
        """As ``ray``, with d direction / d pixel and d origin / d pixel (..., 3, 2), per px and m/px."""
        rays, d_directions, d_origins = self._rays(pixels_px, True)
        shape = rays.valid.shape
        return rays, d_directions.reshape(*shape, 3, 2), d_origins.reshape(*shape, 3, 2)

    def _rays(self, pixels_px: ArrayLike, derivatives: bool) -> tuple[Rays, FloatArray, FloatArray]:
        pixels = _as_rows(pixels_px, 2, "pixels")
        shape = pixels.shape[:-1]
        origins, directions, valid, d_directions, d_origins = self.projection.rays(
            pixels.reshape(-1, 2), self.C, self.lens_axes, derivatives
        )
        rays = Rays(origins.reshape(*shape, 3), directions.reshape(*shape, 3), valid.reshape(shape))
        return rays, d_directions, d_origins

    @property
    def lens_axes(self) -> FloatArray:
        """(3, 3): the lens frame's x, y and z as rows; z is O, or A of OpenCV's families."""
        return self._rows[4:]


def _vector(letter: str, given: ArrayLike, shape: int | tuple[int, ...] = 3) -> FloatArray:
    """Return some of the model's numbers, read-only, or say which are wrong; a count of -1 is any."""
    try:
        if shape == -1:
            shape = len(np.atleast_1d(np.asarray(given)))
        return frozen_array(given, (shape,) if isinstance(shape, int) else shape)
    except (ValueError, TypeError) as error:
        raise ValueError(f"{letter}: {error}") from None


def _axes_of(a: FloatArray, v: FloatArray) -> FloatArray:
    """(3, 3): rows x, y, z with z = A and y the part of V across it."""
    y = v - (v @ a) * a
    y = y / np.linalg.norm(y)
    return np.array([np.cross(y, a), y, a])


def _as_rows(values: ArrayLike, width: int, what: str) -> FloatArray:
    """Return ``values`` as floats (..., width)."""
    array = np.asarray(values, dtype=np.float64)
    if array.ndim == 0 or array.shape[-1] != width:
        raise ValueError(f"{what} of shape {array.shape} where (..., {width}) is expected")
    return array


def _largest_slope(size_px: tuple[int, int], slope_from_pixel: FloatArray) -> float:
    """Return the largest distorted slope inside the image, which is at one of its four corners."""
    x, y = size_px[0] - 0.5, size_px[1] - 0.5
    corners = np.array([[-0.5, -0.5, 1.0], [x, -0.5, 1.0], [-0.5, y, 1.0], [x, y, 1.0]])
    u, v, w = slope_from_pixel @ corners.T
    return float((np.hypot(u, v) / w).max()) if (w > 0.0).all() else inf
