"""A simulated rover that drives up to a target and looks at every stop: truth and belief apart.

No daemon and no clock: a stop is a pose, a look is two pictures. What errs is what errs on a rover: the mast
file against the true rig, the joints' readings and counts, the reported motion, grey noise, gain, the sun.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid, rot_x, rot_y, rot_z
from calib.matching.warp import Grey, PosedImage
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene


@dataclass(frozen=True)
class WorldErrors:
    """What errs, one sigma each.

    Attributes
    ----------
    odometry
        Of the reported motion, as a part of the way driven.
    heading_rad
        Of the reported turn of a step, each axis.
    joint_rad
        Of a joint reading.
    count_rad
        Counts to which goals are rounded.
    gain
        Of each picture's brightness.
    noise_dn
        Of each pixel.
    """

    odometry: float = 0.02
    heading_rad: float = math.radians(0.5)
    joint_rad: float = 1.5e-5
    count_rad: float = 11.57 / 3600 * math.pi / 180
    gain: float = 0.05
    noise_dn: float = 1.5


WINDOW_PX = (704, 384)
"""What is read out of a mast camera's picture while driving: its middle, where the head puts the target.

Wide enough for the other eye: at 6 m the Pancams see a target 170 px apart."""


ROCKS_WITHIN_RAD, RAYS = 1.3, 6000
"""To either side of the first heading rocks are sought, by so many rays: 10 m away one each 4 cm."""


def windowed(rig: Rig, size_px: tuple[int, int]) -> Rig:
    """Return the rig with its mast cameras' pictures cut to their middle; what they see stays where it is."""
    cameras = dict(rig.cameras)
    for name, camera in cameras.items():
        model = camera.model
        x, y = ((whole - part) // 2 for whole, part in zip(model.size_px, size_px, strict=True))
        if camera.on == "head" and min(x, y) > 0:
            cut = replace(model, size_px=size_px, H=model.H - x * model.A, V=model.V - y * model.A)
            cameras[name] = replace(camera, model=cut)
    return replace(rig, cameras=cameras)


class ApproachWorld:
    """The rover in its scene.

    Parameters
    ----------
    scene
        What is seen; it may be exchanged while driving (the sun moves).
    true, believed
        The rig that takes the pictures, and the mast file's.
    rng
        Of everything random.
    """

    def __init__(
        self, scene: Scene, true: Rig, believed: Rig, errors: WorldErrors, rng: np.random.Generator
    ) -> None:
        self.true = true
        self.believed = believed
        self.errors = errors
        self._rng = rng
        self._renderer = Renderer(scene)
        self.site_from_rover = self._standing(0.0, 0.0, 0.0)

    def close(self) -> None:
        """Let go of the renderer's threads."""
        self._renderer.close()

    def read_windows(self) -> None:
        """From now on, take only the middle of the mast cameras' pictures."""
        self.true, self.believed = windowed(self.true, WINDOW_PX), windowed(self.believed, WINDOW_PX)

    def relight(self, scene: Scene) -> None:
        """Put the same ground under another sun."""
        self._renderer.close()
        self._renderer = Renderer(scene)

    def _standing(self, x_m: float, y_m: float, heading_rad: float) -> Rigid:
        """A pose on the ground, tilted as by stones under the wheels."""
        pitch, roll = self._rng.normal(0.0, math.radians(1.5), 2)
        return self._renderer.scene.standing(x_m, y_m, heading_rad, pitch, roll)

    def height_m(self, point_in_site_m: FloatArray) -> float:
        """How far a point (3,) of the site lies above the ground under it, metres: more than 0 on a rock."""
        x, y, z = point_in_site_m.tolist()
        return float(self._renderer.scene.ground_z_m(x, y) - z)

    def turn_to_rock(self, range_m: float, least_m: float) -> FloatArray | None:
        """Turn the rover where it stands towards a rock some ``range_m`` away.

        Returns
        -------
        point_m
            (3,) of the site, on the side that the mast sees, at least ``least_m`` above the ground; larger
            rocks are likelier. None, and no turn, if there is none.
        """
        scene, rng = self._renderer.scene, self._rng
        origin = self.site_from_rover.points(self.true.mast.translation_m)
        azimuth = rng.uniform(-ROCKS_WITHIN_RAD, ROCKS_WITHIN_RAD, RAYS)
        away = rng.uniform(0.85, 1.15, RAYS) * range_m
        aims = np.stack([away * np.cos(azimuth), away * np.sin(azimuth), np.full(RAYS, -origin[2])], axis=1)
        reach = scene.cast(origin, aims)
        points = origin + reach[:, None] * aims / np.linalg.norm(aims, axis=1, keepdims=True)
        points = points[np.abs(reach - range_m) < 0.15 * range_m]
        fit = [point for point in points if self.height_m(point) > least_m]
        if not fit:
            return None
        chosen: FloatArray = fit[rng.integers(len(fit))]
        here = self.site_from_rover.translation_m
        heading = math.atan2(chosen[1] - here[1], chosen[0] - here[0]) + rng.uniform(-0.4, 0.4)
        self.site_from_rover = self._standing(float(here[0]), float(here[1]), heading)
        return chosen

    def drive(self, x_m: float, y_m: float, heading_rad: float) -> tuple[Rigid, FloatArray]:
        """Drive to a place of the site; return the motion as reported (now_from_then) and its covariance."""
        before = self.site_from_rover
        self.site_from_rover = self._standing(x_m, y_m, heading_rad)
        true = self.site_from_rover.inverse @ before
        way_m = float(np.linalg.norm(true.translation_m))
        sigma = np.array([self.errors.heading_rad] * 3 + [self.errors.odometry * way_m] * 3)
        off = self._rng.normal(0.0, sigma)
        wrong = Rigid(rot_x(off[0]) @ rot_y(off[1]) @ rot_z(off[2]), off[3:])
        # The motion's error moves what was ahead, not the whole rover frame: it is of the displacement.
        return wrong.inverse @ true, np.diag(sigma**2)

    def look(self, pair: Sequence[str], pan_rad: float, tilt_rad: float) -> dict[str, PosedImage]:
        """Point the head and take both pictures; the cameras are where the mast file says they are."""
        at = self._turned(pan_rad, tilt_rad)
        read = at + self._rng.normal(0.0, self.errors.joint_rad, 2)
        eyes = {}
        for name in pair:
            camera = self.true.cameras[name]
            frame = self.site_from_rover
            if camera.on == "head":
                frame = frame @ self.true.mast.rover_from_head(float(at[0]), float(at[1]))
            image = self._exposed(camera.model, frame)
            eyes[name] = PosedImage(
                image, self.believed.camera_in_rover(name, float(read[0]), float(read[1]))
            )
        return eyes

    def _turned(self, pan_rad: float, tilt_rad: float) -> FloatArray:
        """Where the head comes to stand: goals (2,), radians, rounded to counts."""
        count = self.errors.count_rad
        return np.array([round(pan_rad / count), round(tilt_rad / count)]) * count

    def true_camera(self, name: str, pan_rad: float, tilt_rad: float) -> CameraModel:
        """A camera in the rover frame where it truly is with these goals."""
        return self.true.camera_in_rover(name, *self._turned(pan_rad, tilt_rad).tolist())

    def true_pixel(
        self, name: str, pan_rad: float, tilt_rad: float, target_in_site_m: FloatArray
    ) -> FloatArray:
        """Where a point of the site truly is in a camera; not-a-number if it cannot be seen."""
        model = self.true_camera(name, pan_rad, tilt_rad)
        return np.asarray(model.project(self.site_from_rover.inverse.points(target_in_site_m))[0])

    def point_at(self, name: str, pan_rad: float, tilt_rad: float, pixel_px: FloatArray) -> FloatArray | None:
        """The point of the site, (3,) metres, that a pixel truly shows; None for the sky."""
        rays = self.true_camera(name, pan_rad, tilt_rad).ray(pixel_px)
        origin = self.site_from_rover.points(rays.origins_m)
        along = self.site_from_rover.vectors(rays.directions)
        range_m = float(self._renderer.scene.cast(origin, along))
        return np.asarray(origin + range_m * along) if math.isfinite(range_m) else None

    def _exposed(self, model: CameraModel, site_from_frame: Rigid) -> Grey:
        image = self._renderer.image(model, site_from_frame, 2)
        gain = 1.0 + self._rng.normal(0.0, self.errors.gain)
        noisy = gain * image + self._rng.normal(0.0, self.errors.noise_dn, image.shape)
        return np.clip(np.rint(noisy), 0, 255).astype(np.float32)
