"""CAHV, CAHVOR and CAHVORE camera models: project, ray, Jacobians, motion.

Pixels are (x, y) = (column, row), 0-based; the centre of the top-left pixel is (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from calib.lens import Lens
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
    lens: Lens = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for letter in "CAHV":
            object.__setattr__(self, letter, frozen_array(getattr(self, letter), (3,)))
        for letter, default in (("O", self.A), ("R", np.zeros(3)), ("E", np.zeros(3))):
            given = getattr(self, letter)
            object.__setattr__(self, letter, frozen_array(default if given is None else given, (3,)))
        if self.cahvore_type in (1, 2):
            object.__setattr__(self, "linearity", 1.0 if self.cahvore_type == 1 else 0.0)
        lens = Lens(tuple(self.R.tolist()), tuple(self.E.tolist()), self.kind == "CAHVORE", self.linearity)
        object.__setattr__(self, "lens", lens)
        o = self.O
        e1 = np.cross(o, np.eye(3)[np.argmin(np.abs(o))])
        e1 /= np.linalg.norm(e1)
        basis = np.array([e1, np.cross(o, e1), o])
        object.__setattr__(self, "_basis", basis)
        object.__setattr__(self, "_k", np.array([self.H, self.V, self.A]) @ basis.T)
        object.__setattr__(self, "_k_inv", np.linalg.inv(self._k))

    @classmethod
    def normalised(cls, kind, size_px, C, A, H, V, O=None, R=None, E=None, cahvore_type=0, linearity=1.0):
        A = np.asarray(A, dtype=float)
        A = A / np.linalg.norm(A)
        if O is not None:
            O = np.asarray(O, dtype=float)
            O = O / np.linalg.norm(O)
        return cls(kind, size_px, C, A, H, V, O, R, E, cahvore_type, linearity), 0.0

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
        points = np.asarray(points_m, dtype=np.float64)
        with np.errstate(all="ignore"):
            a, b, w = np.moveaxis((points - self.C) @ self._basis.T, -1, 0)
            lens = self.lens
            r0, r1, r2 = lens.r
            if lens.curved:
                e0, e1, e2 = lens.e
                lam = np.maximum(np.sqrt(a * a + b * b), 1e-150)
                theta = np.arctan2(lam, w)
                for _ in range(30):
                    s, c, t2 = np.sin(theta), np.cos(theta), theta * theta
                    e = e0 + t2 * (e1 + t2 * e2)
                    slope = w * c + lam * s - (1 - c) * e - (theta - s) * theta * (2 * e1 + 4 * e2 * t2)
                    step = (w * s - lam * c - (theta - s) * e) / slope
                    theta = theta - step
                    if np.all(~(np.abs(step) > 1e-14)):
                        break
                line = lens.linearity
                if line > 0:
                    chi = np.tan(line * theta) / line
                elif line < 0:
                    chi = np.sin(line * theta) / line
                else:
                    chi = theta
                scale = chi / lam
                valid = (np.abs(step) < 1e-9) & (slope > 0) & (theta >= 0) & (theta < lens.theta_limit_rad)
            else:
                scale = 1 / w
                valid = w > 0
                chi = np.sqrt(a * a + b * b) * scale
            valid &= chi < lens.chi_limit
            chi2 = chi * chi
            scale = scale * (1 + r0 + chi2 * (r1 + chi2 * r2))
            x, y, z = np.moveaxis(np.stack([a * scale, b * scale, np.ones_like(a)], -1) @ self._k.T, -1, 0)
            pixels = np.stack([x / z, y / z], -1)
            valid &= (z > 0) & np.isfinite(pixels).all(-1)
            pixels[~valid] = np.nan
        return pixels, valid

    def ray(self, pixels_px: ArrayLike) -> Rays:
        """Return the rays through pixels (..., 2)."""
        pixels = np.asarray(pixels_px, dtype=np.float64)
        with np.errstate(all="ignore"):
            x, y = pixels[..., 0], pixels[..., 1]
            a, b, w = np.moveaxis(np.stack([x, y, np.ones_like(x)], -1) @ self._k_inv.T, -1, 0)
            lens = self.lens
            r0, r1, r2 = lens.r
            u, v = a / w, b / w
            target = np.maximum(np.sqrt(u * u + v * v), 1e-150)
            valid = (w > 0) & (target < lens.distorted_limit)
            chi = target / (1 + r0)
            for _ in range(50):
                c2 = chi * chi
                step = (chi * (1 + r0 + c2 * (r1 + c2 * r2)) - target) / (
                    1 + r0 + c2 * (3 * r1 + c2 * 5 * r2)
                )
                chi = chi - step
                if np.all(~(np.abs(step) > 1e-14)):
                    break
            valid &= (chi >= 0) & (chi < lens.chi_limit) & (np.abs(step) < 1e-9)
            shift = np.zeros_like(chi)
            if lens.curved:
                line = lens.linearity
                if line > 0:
                    theta = np.arctan(line * chi) / line
                elif line < 0:
                    theta = np.arcsin(line * chi) / line
                else:
                    theta = chi
                valid &= theta < lens.theta_limit_rad
                t2 = theta * theta
                s, c = np.sin(theta), np.cos(theta)
                shift = (theta / s - 1) * (lens.e[0] + t2 * (lens.e[1] + t2 * lens.e[2]))
            else:
                norm = np.sqrt(1 + chi * chi)
                s, c = chi / norm, 1 / norm
            local = np.stack([s * u / target, s * v / target, c], -1)
            directions = local @ self._basis
            origins = self.C + shift[..., None] * self.O
            valid &= np.isfinite(directions).all(-1) & np.isfinite(shift)
            directions[~valid] = np.nan
            origins[~valid] = np.nan
        return Rays(origins, directions, valid)

    def project_jacobian(self, points_m: ArrayLike) -> tuple[FloatArray, FloatArray, np.ndarray]:
        """Return pixels (..., 2), d pixel / d point (..., 2, 3) in px/m, and which are valid."""
        raise NotImplementedError

    def ray_jacobian(self, pixels_px: ArrayLike) -> tuple[Rays, FloatArray, FloatArray]:
        """Return the rays, d direction / d pixel (..., 3, 2) and d origin / d pixel (..., 3, 2)."""
        raise NotImplementedError
