"""A scene from outside: an object that says what rays see, instead of the ground and stones made here."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from drivers.errors import BadOptions, DriverError
from drivers.outside import named_factory, one_line
from drivers.sim.render import MAX_SAMPLES, Float32, Renderer
from drivers.sim.scene import Scene, SceneSettings

Float64 = NDArray[np.float64]

RAYS_AT_ONCE = 200_000
LONG_S = 5.0
"""What takes longer at the start is named in the log, again and again."""

_log = logging.getLogger(__name__)


class SeenFromOutside(Protocol):
    """What a scene from outside is: the same rays see the same, at any time.

    It may have ``ground_z_m(x_m, y_m)`` too, the z of the ground there; without it the ground is z = 0.
    """

    def look(self, origins_m: Float64, directions: Float64, pitch_rad: float) -> tuple[ArrayLike, ArrayLike]:
        """Return how far rays go, and how bright what they meet is.

        Parameters
        ----------
        origins_m, directions
            (n, 3) each, site frame (x north, y east, z down), metres; directions have length 1.
        pitch_rad
            The angle between neighbouring rays: detail finer than range times this flickers if it is not
            smoothed. 0 if nobody will look at the brightness.

        Returns
        -------
        ranges_m, brightness
            (n,) each. Not-a-number as a range is the sky, which has a brightness; brightness is 0 to 255.
        """
        ...


class OutsideScene(Scene):
    """A scene from outside as the simulated rover takes it. Made by `outside_scene`."""

    def __init__(self, settings: SceneSettings, seen: SeenFromOutside) -> None:
        super().__init__(settings, None)
        self._seen = seen

    def look(self, origins_m: Float64, directions: Float64, pitch_rad: float) -> tuple[Float64, Float64]:
        """Return ranges and brightness, (n,) each, checked.

        Raises
        ------
        DriverError
            With the scene's name, if it fails or what it returns is none.
        """
        told = f"scene {self.settings.plugin!r}"
        try:
            found = self._seen.look(origins_m, directions, pitch_rad)
            ranges_m, brightness = (np.asarray(part, dtype=np.float64) for part in found)
        except DriverError:
            raise
        except Exception as error:  # a foreign scene may raise anything: one sentence tells it
            raise DriverError(f"{told} failed to look ({one_line(error)})") from error
        n = len(origins_m)
        if ranges_m.shape != (n,) or brightness.shape != (n,):
            raise DriverError(
                f"{told} returned ranges {ranges_m.shape} and brightness {brightness.shape} for {n} rays, "
                f"expected ({n},) twice"
            )
        if np.isnan(brightness).any():
            raise DriverError(f"{told} returned a brightness that is not a number, expected 0 to 255")
        if (ranges_m < 0.0).any():
            least_m = float(np.nanmin(ranges_m))
            raise DriverError(f"{told} returned the range {least_m:g} m, expected 0 or more, nan for sky")
        return ranges_m, brightness

    def cast(self, origins_m: ArrayLike, directions: ArrayLike) -> Float64:
        """Return how far rays go: see `Scene.cast`. Raises DriverError as `look`."""
        origins, wanted = np.broadcast_arrays(np.asarray(origins_m, float), np.asarray(directions, float))
        shape = origins.shape[:-1]
        origins, wanted = origins.reshape(-1, 3), wanted.reshape(-1, 3)
        with np.errstate(invalid="ignore", divide="ignore"):
            unit = wanted / np.linalg.norm(wanted, axis=-1, keepdims=True)
        fit = np.isfinite(unit).all(axis=-1) & np.isfinite(origins).all(axis=-1)
        ranges_m = np.full(len(origins), np.nan)
        if fit.any():
            found, _ = self.look(np.ascontiguousarray(origins[fit]), np.ascontiguousarray(unit[fit]), 0.0)
            ranges_m[fit] = np.where(found > 0.0, found, np.nan)
        ranges_m[~np.isfinite(ranges_m)] = np.nan
        return ranges_m.reshape(shape)

    def ground_z_m(self, x_m: float, y_m: float) -> float:
        """Return z of the ground: the scene's own ``ground_z_m``, or 0."""
        own: Any = getattr(self._seen, "ground_z_m", None)
        return 0.0 if own is None else float(own(x_m, y_m))


class OutsideRenderer(Renderer):
    """Draws a scene from outside, with the rays that the other renderer casts."""

    def __init__(self, scene: OutsideScene) -> None:
        super().__init__(scene)
        self._outside = scene

    def image(
        self,
        camera: CameraModel,
        site_from_camera_frame: Rigid,
        samples: int = 2,
        rows: tuple[int, int] | None = None,
    ) -> Float32:
        """Return the picture: see `Renderer.image`. Raises DriverError as `OutsideScene.look`."""
        if not 1 <= samples <= MAX_SAMPLES:
            raise BadOptions(f"{samples} samples across a pixel where 1 to {MAX_SAMPLES} are possible")
        table = self._table(camera, samples)
        height, width, q = table.rays.shape[:3]
        image = np.zeros((height, width), dtype=np.float32)
        turned = site_from_camera_frame.rotation.T
        centre_m = site_from_camera_frame.points(camera.C)
        pitch_rad = 1.0 / (samples * camera.focal_px[0])
        first, last = rows or (0, height)
        step = max(1, RAYS_AT_ONCE // (width * q))
        for top in range(first, last, step):
            part = slice(top, min(top + step, last))
            directions = table.rays[part].reshape(-1, 3).astype(np.float64) @ turned
            origins = np.broadcast_to(centre_m, directions.shape)
            if table.starts.size:
                origins = origins + table.starts[part].reshape(-1, 3).astype(np.float64) @ turned
            seen = np.isfinite(directions).all(axis=-1)
            light = np.zeros(len(directions))
            directions = directions[seen] / np.linalg.norm(directions[seen], axis=-1, keepdims=True)
            if len(directions):
                light[seen] = self._outside.look(np.ascontiguousarray(origins[seen]), directions, pitch_rad)[
                    1
                ]
            count = np.maximum(seen.reshape(-1, q).sum(axis=1), 1)
            mean = light.reshape(-1, q).sum(axis=1) / count
            image[part] = np.clip(mean, 0.0, 255.0).reshape(-1, width)
        return image


def outside_scene(settings: SceneSettings) -> OutsideScene:
    """Return the scene that ``settings.plugin`` names, made with seed and options, and looked at once.

    Raises
    ------
    BadOptions
        If there is no such factory, it refuses the options, or what it made cannot look.
    """
    name = settings.plugin
    factory = named_factory("scene", name)
    try:
        with _named_if_long(f"scene {name!r} to be made"):
            made = factory(seed=settings.seed, **settings.options)
    except DriverError:
        raise
    except (Exception, SystemExit) as error:  # a foreign factory may raise anything: one sentence tells it
        raise BadOptions(
            f"scene {name!r} refuses the options {settings.options!r} ({one_line(error)})"
        ) from error
    if not callable(getattr(made, "look", None)):
        raise BadOptions(f"scene {name!r} made a {type(made).__name__} without look")
    scene = OutsideScene(settings, made)
    ahead = np.array([[1.0, 0.0, 0.3], [1.0, 0.0, -0.3]])
    try:
        with _named_if_long(f"the first look of scene {name!r}, at two rays"):
            scene.look(np.array([[0.0, 0.0, -1.0]] * 2), ahead / np.linalg.norm(ahead, axis=1)[:, None], 1e-3)
    except DriverError as error:
        raise BadOptions(str(error)) from None
    return scene


@contextmanager
def _named_if_long(what: str) -> Iterator[None]:
    """Say what is waited for while it takes long: foreign code may hang, and nothing can end it."""
    over = threading.Event()

    def tell() -> None:
        waited_s = 0.0
        while not over.wait(LONG_S):
            waited_s += LONG_S
            _log.warning("still waiting for %s, after %.0f s", what, waited_s)

    threading.Thread(target=tell, name="scene from outside", daemon=True).start()
    try:
        yield
    finally:
        over.set()
