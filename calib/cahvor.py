"""CAHV, CAHVOR and CAHVORE camera models: project, ray, Jacobians, motion.

Pixels are (x, y) = (column, row), 0-based; the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from calib.rigid import FloatArray, Rigid, frozen_array

Kind = Literal["CAHV", "CAHVOR", "CAHVORE"]


class Rays(NamedTuple):
    """Rays through pixels, in the model's frame; rows that do not exist are not-a-number.

    origins_m (..., 3), directions (..., 3) unit length pointing into the scene, valid (...,) bool.
    """

    origins_m: FloatArray
    directions: FloatArray
    valid: np.ndarray


@dataclass(frozen=True, eq=False)
class CameraModel:
    """One camera of the CAHV family; A and O are unit vectors (see ``normalised``).

    ``kind`` says which letters count: CAHV ignores O, R, E; CAHVOR ignores E. ``cahvore_type`` is 1
    (perspective, linearity 1), 2 (fisheye, linearity 0) or 3 (``linearity`` as given); 0 otherwise.
    ``size_px`` is (width, height).
    """

    kind: Kind
    size_px: tuple[int, int]
    C: FloatArray
    A: FloatArray
    H: FloatArray
    V: FloatArray
    O: FloatArray | None = None  # noqa: E741  the model's own letter
    R: FloatArray | None = None
    E: FloatArray | None = None
    cahvore_type: int = 0
    linearity: float = 1.0

    def __post_init__(self) -> None:
        for letter in "CAHV":
            object.__setattr__(self, letter, frozen_array(getattr(self, letter), (3,)))
        for letter, default in (("O", self.A), ("R", np.zeros(3)), ("E", np.zeros(3))):
            given = getattr(self, letter)
            object.__setattr__(self, letter, frozen_array(default if given is None else given, (3,)))

    @property
    def image_center_px(self) -> tuple[float, float]:
        """((w-1)/2, (h-1)/2): the middle of the image in pixel-centre coordinates."""
        return ((self.size_px[0] - 1) / 2, (self.size_px[1] - 1) / 2)

    def moved(self, b_from_a: Rigid) -> CameraModel:
        """Return the same camera with its vectors in frame b instead of a: C moves, A H V O turn."""
        return replace(
            self,
            C=b_from_a.points(self.C),
            A=b_from_a.vectors(self.A),
            H=b_from_a.vectors(self.H),
            V=b_from_a.vectors(self.V),
            O=b_from_a.vectors(self.O),
        )

    def project(self, points_m: ArrayLike) -> tuple[FloatArray, np.ndarray]:
        """Return pixels (..., 2) of points (..., 3) in metres in the model's frame, and which are valid."""
        raise NotImplementedError

    def project_jacobian(self, points_m: ArrayLike) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return pixels (..., 2), d pixel / d point (..., 2, 3) in px/m, and which are valid."""
        raise NotImplementedError

    def ray(self, pixels_px: ArrayLike) -> Rays:
        """Return the rays through pixels (..., 2)."""
        raise NotImplementedError

    def ray_jacobian(self, pixels_px: ArrayLike) -> tuple[Rays, FloatArray, FloatArray]:
        """Return the rays, d direction / d pixel (..., 3, 2) and d origin / d pixel (..., 3, 2)."""
        raise NotImplementedError
