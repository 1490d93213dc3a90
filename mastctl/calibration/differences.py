"""How far a new rig is from the former one, the motion that the difference implies taken out."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.parameters import predict
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid

GRID = (13, 10)
RANGES_M = (2.0, 20.0)


@dataclass(frozen=True, eq=False)
class Difference:
    """One camera against its former model, both in the frame that they are mounted on.

    ``pixels_px`` (n, 2): where it is compared. ``lens_px`` (n, 2): new less former pixel of what the former
    saw there, far away, the motion taken out. ``turned_rad``, ``shifted_m`` (3,): the motion that makes the
    former camera project as the new one does, as well as one can.
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
        if old is None or old.on != camera.on or old.model.size_px != camera.model.size_px:
            continue
        moved, _ = implied_motion([(camera.model, old.model)])
        pixels, far = _what_it_saw(old.model, RANGES_M[-1:])
        seen, valid = camera.model.project(moved.points(far))
        lens = np.where(valid[:, None], seen, np.nan) - pixels
        motion = moved.inverse  # points moved into the camera's place: the camera moved the other way
        turned = -Rotation.from_matrix(moved.rotation).as_rotvec()
        yield Difference(name, old.model.size_px, pixels, lens, turned, motion.translation_m)


def implied_motion(pairs: Sequence[tuple[CameraModel, CameraModel]]) -> tuple[Rigid, float]:
    """Return the motion of points after which new cameras see them as the former ones saw them before.

    By least squares over all images, with the rms per axis that is left, px. ``pairs`` are new and former
    models; all of the new ones in one frame, all of the former in another.
    """
    new, former = pairs[0]
    turn = new.rotation.T @ former.rotation
    start = Rigid(turn, new.C - turn @ former.C)
    seen = [(one, *_what_it_saw(old, RANGES_M)) for one, old in pairs]

    def off_px(step: FloatArray) -> FloatArray:
        moved = moved_rigid(start, step)
        off = [predict(one, moved.points(points)).pixels_px - pixels for one, pixels, points in seen]
        return np.nan_to_num(np.concatenate(off).ravel(), posinf=0.0, neginf=0.0)

    found = least_squares(off_px, np.zeros(6), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    both = found.fun != 0.0  # where both see
    return moved_rigid(start, found.x), float(np.sqrt(np.mean(found.fun[both] ** 2))) if both.any() else 0.0


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
