"""How far a new rig is from the former one, the motion that the difference implies taken out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.parameters import predict
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid, rigid_rates

GRID = (13, 10)
RANGES_M = (2.0, 20.0)
STEPS = 20


@dataclass(frozen=True, eq=False)
class Difference:
    """One camera against its former model, both in the frame that they are mounted on.

    Attributes
    ----------
    camera, size_px
        Which, and its picture's size.
    pixels_px
        (n, 2) where it is compared.
    lens_px
        (n, 2) new less former pixel of what the former saw there, far away, the motion taken out.
    turned_rad, shifted_m
        (3,) the motion that makes the former camera project as the new one does, as well as one can.
    """

    camera: str
    size_px: tuple[int, int]
    pixels_px: FloatArray
    lens_px: FloatArray
    turned_rad: FloatArray
    shifted_m: FloatArray

    @property
    def rms_px(self) -> float:
        """Rms length of what the lens differs by, where both see."""
        return float(np.sqrt(np.nanmean(np.sum(self.lens_px**2, axis=1))))

    @property
    def unseen(self) -> float:
        """Part of what the former saw that the new one does not."""
        return float(np.isnan(self.lens_px).any(axis=1).mean())

    @property
    def sentence(self) -> str:
        """The motion in words."""
        turn, shift = 1e3 * self.turned_rad, 1e3 * self.shifted_m
        return (
            f"{self.camera}: turned by {turn[0]:+.2f}, {turn[1]:+.2f}, {turn[2]:+.2f} mrad about x, y, z "
            f"and shifted by {shift[0]:+.1f}, {shift[1]:+.1f}, {shift[2]:+.1f} mm; "
            f"its lens differs by {self.rms_px:.2f} px rms"
            + (f"; {100 * self.unseen:.0f} % of what it saw has no pixel any more" if self.unseen else "")
        )


def rig_differences(new: Rig, former: Rig) -> Iterator[Difference]:
    """Yield the difference of each camera that both rigs have, of the same size and mount."""
    for name, camera in new.cameras.items():
        old = former.cameras.get(name)
        if old is not None and old.on == camera.on and old.model.size_px == camera.model.size_px:
            yield camera_difference(name, camera.model, old.model)


def camera_difference(name: str, new: CameraModel, former: CameraModel) -> Difference:
    """Return how far a camera is from its former model."""
    moved, _ = implied_motion([(new, former)])
    pixels, far = _what_it_saw(former, RANGES_M[-1:])
    seen, valid = new.project(moved.points(far))
    lens = np.where(valid[:, None], seen, np.nan) - pixels
    motion = moved.inverse  # points moved into the camera's place: the camera moved the other way
    return Difference(name, former.size_px, pixels, lens, -_rotvec(moved.rotation), motion.translation_m)


def implied_motion(pairs: Sequence[tuple[CameraModel, CameraModel]]) -> tuple[Rigid, float]:
    """Return the motion of points after which new cameras see them as the former ones saw them before.

    Parameters
    ----------
    pairs
        New and former models; all of the new ones in one frame, all of the former in another.

    Returns
    -------
    new_from_former
        The motion, least squares over all pictures.
    rms_px
        What is left of pixels, rms per axis.
    """
    new, former = pairs[0]
    axes, old = new.axes, former.axes
    moved = Rigid(axes @ old.T, new.C - axes @ old.T @ former.C)
    for _ in range(STEPS):
        rates, off = [], []
        for new, former in pairs:
            pixels, points = _what_it_saw(former, RANGES_M)
            here = moved.points(points)
            seen = predict(new, here)
            off.append((seen.pixels_px - pixels).ravel())
            rates.append(rigid_rates(seen.d_points, here, moved.translation_m).reshape(-1, 6))
        residual, jacobian = np.concatenate(off), np.concatenate(rates)
        good = np.isfinite(residual) & np.isfinite(jacobian).all(axis=1)
        step = -np.asarray(np.linalg.lstsq(jacobian[good], residual[good], rcond=None)[0], dtype=np.float64)
        moved = moved_rigid(moved, step)
        if np.linalg.norm(step) < 1e-12:
            break
    return moved, float(np.sqrt(np.mean(residual[good] ** 2)))


def _what_it_saw(camera: CameraModel, ranges_m: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """Pixels (n, 2) over a camera's picture, and points (n, 3) seen there, range after range."""
    width, height = camera.size_px
    x, y = np.meshgrid(
        (np.arange(GRID[0]) + 0.5) * width / GRID[0] - 0.5,
        (np.arange(GRID[1]) + 0.5) * height / GRID[1] - 0.5,
    )
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    rays = camera.ray(pixels)
    points = [rays.origins_m + range_m * rays.directions for range_m in ranges_m]
    return np.concatenate([pixels] * len(ranges_m)), np.concatenate(points)


def _rotvec(rotation: FloatArray) -> FloatArray:
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotation).as_rotvec())
