"""Pictures of a scene through any camera model, by casting the model's own rays at the scene's own geometry.

The centre of the top-left pixel is (0, 0). A pixel's value is the mean of samples x samples rays spread
evenly over its square: offsets (i + 0.5) / samples - 0.5 in x and in y. Pictures are noise-free; noise, blur
by motion and exposure are the simulated camera's.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from drivers.errors import BadOptions
from drivers.sim.compiled import is_compiled, kernels
from drivers.sim.rays import BLOCK_PX, TILE_PX, RayTable, ray_table
from drivers.sim.scene import Scene, tiny_scene
from drivers.sim.sensor import Noise

__all__ = ["Renderer", "Stills", "compile_drawing", "compile_renderer", "is_compiled"]

Float32 = NDArray[np.float32]

TABLES_KEPT = 24  # of six cameras: their own, one for motion and one for metering
STILLS_KEPT = 12
MAX_SAMPLES = 8


class Renderer:
    """Draws one scene; may be called from several threads.

    Parameters
    ----------
    scene
        What ``build_scene`` returned.
    workers
        Threads that share the work of a picture; the machine's processors by default.
    """

    def __init__(self, scene: Scene, workers: int | None = None) -> None:
        self.scene = scene
        self._kernels = kernels()
        self._workers = workers or os.cpu_count() or 1
        self._pool = ThreadPoolExecutor(self._workers, thread_name_prefix="render")
        self._tables: OrderedDict[tuple[object, ...], RayTable] = OrderedDict()
        self._lock = threading.Lock()

    def image(
        self,
        camera: CameraModel,
        site_from_camera_frame: Rigid,
        samples: int = 2,
        rows: tuple[int, int] | None = None,
    ) -> Float32:
        """Return the picture that ``camera`` takes of the scene.

        Parameters
        ----------
        camera
            The model in the frame it is mounted in (head or rover). Its rays are computed once and kept, so
            give the same model with another transform for another pose, not a moved model.
        site_from_camera_frame
            Where that frame is. C must be above the ground, and within 32 m of the site's origin in x and y.
        samples
            Rays across a pixel, 1 to 8: each pixel is the mean of samples x samples rays.
        rows
            [first, last): what is wanted; of the other rows some are 0.

        Returns
        -------
        image : (h, w) float32
            Brightness, 0 to 255, noise-free. Pixels for which the model has no ray are 0, and so are those
            whose ray starts under the ground (in CAHVORE rays start the farther from C the more they bend).

        Raises
        ------
        BadOptions
            If ``samples`` is out of bounds, or the camera stands where it sees nothing.
        """
        if not 1 <= samples <= MAX_SAMPLES:
            raise BadOptions(f"{samples} samples across a pixel where 1 to {MAX_SAMPLES} are possible")
        centre_m = np.array(site_from_camera_frame.points(camera.C))
        if not self._kernels.over_ground(self.scene.world.inner, centre_m[0], centre_m[1], -centre_m[2]):
            place = ", ".join(f"{value:.3f}" for value in centre_m)
            raise BadOptions(
                f"a camera at ({place}) m in the site frame is under the ground or beyond its edge"
            )
        table = self._table(camera, samples)
        height, width = table.rays.shape[:2]
        image = np.zeros((height, width), dtype=np.float32)
        rotation = np.array(site_from_camera_frame.rotation, order="C")  # compiled for this order only
        across, (first, last) = table.tile_beams.shape[1], rows or (0, height)
        first, last = across * (first // TILE_PX), across * -(-last // TILE_PX)
        # short pieces, so that a worker with sky takes its share of ground too
        parts = 8 * self._workers if self._workers > 1 else 1
        edges = np.linspace(first, last, parts + 1).astype(int)

        def draw(k: int) -> None:
            self._kernels.render_tiles(
                self.scene.world,
                *table,
                TILE_PX,
                BLOCK_PX,
                int(edges[k]),
                int(edges[k + 1]),
                rotation,
                centre_m,
                np.empty((5, BLOCK_PX * BLOCK_PX * samples * samples)),
                image,
            )

        for done in [self._pool.submit(draw, k) for k in range(len(edges) - 1)]:
            done.result()
        return image

    def close(self) -> None:
        """Let the worker threads go."""
        self._pool.shutdown()

    def _table(self, camera: CameraModel, samples: int) -> RayTable:
        """The rays of a camera, from the few kept ones if its numbers are the same."""
        key = (*camera_key(camera), samples)
        with self._lock:
            if key not in self._tables:
                self._tables[key] = ray_table(camera, samples)
                while len(self._tables) > TABLES_KEPT:
                    self._tables.popitem(last=False)
            self._tables.move_to_end(key)
            return self._tables[key]


class DrawsPictures(Protocol):
    """What pictures are drawn with: a scene's `Renderer`, or one with more in it."""

    def image(
        self,
        camera: CameraModel,
        site_from_camera_frame: Rigid,
        samples: int = 2,
        rows: tuple[int, int] | None = None,
    ) -> Float32:
        """Return a picture."""

    def close(self) -> None:
        """Let go of what it has."""


class Stills:
    """Pictures of poses seen lately, so that a camera at rest before a scene that stands is drawn once.

    A picture without noise is a function of scene, camera, pose and samples alone. The scene never changes
    and the key holds every bit of the others, so nothing can be stale. Whatever else is to change what a
    camera sees (light, dust, exposure, temperature) comes after this, or joins the key. Safe from any thread.
    """

    def __init__(self, renderer: DrawsPictures) -> None:
        self._renderer = renderer
        self._lock = threading.Lock()
        self._images: OrderedDict[tuple[object, ...], Float32] = OrderedDict()

    def find(self, camera: CameraModel, site_from_camera_frame: Rigid, samples: int) -> Float32 | None:
        """Return a picture that was drawn before, read-only; None if it is to be drawn."""
        key = self._key(camera, site_from_camera_frame, samples)
        with self._lock:
            if key in self._images:
                self._images.move_to_end(key)
            return self._images.get(key)

    def image(self, camera: CameraModel, site_from_camera_frame: Rigid, samples: int) -> Float32:
        """Return what `Renderer.image` returns, read-only, and keep it. Raises what that raises."""
        image = self.find(camera, site_from_camera_frame, samples)
        if image is None:
            image = self._renderer.image(camera, site_from_camera_frame, samples)
            image.setflags(write=False)
            with self._lock:
                self._images[self._key(camera, site_from_camera_frame, samples)] = image
                while len(self._images) > STILLS_KEPT:
                    self._images.popitem(last=False)
        return image

    @staticmethod
    def _key(camera: CameraModel, pose: Rigid, samples: int) -> tuple[object, ...]:
        return (*camera_key(camera), samples, pose.rotation.tobytes(), pose.translation_m.tobytes())


def camera_key(camera: CameraModel) -> tuple[object, ...]:
    """Return all numbers of a camera model, to the last bit."""
    numbers = (getattr(camera, one.name) for one in fields(camera) if one.init)
    return tuple(n.tobytes() if isinstance(n, np.ndarray) else n for n in numbers)


def compile_drawing() -> None:
    """Compile what draws a picture, or load it: by far the largest part of what `compile_renderer` does."""
    beams = np.full((1, 1, 6), -1.0)
    kernels().render_tiles(
        tiny_scene(lit=False).world,
        np.empty((BLOCK_PX, BLOCK_PX, 1, 3), dtype=np.float32),
        np.empty((0, 0, 0, 3), dtype=np.float32),
        beams,
        beams,
        TILE_PX,
        BLOCK_PX,
        0,
        0,
        np.eye(3),
        np.zeros(3),
        np.empty((5, BLOCK_PX * BLOCK_PX)),
        np.empty((BLOCK_PX, BLOCK_PX), dtype=np.float32),
    )


def compile_renderer() -> None:
    """Compile what building a scene and drawing it need, or load it from the disk cache.

    Say before calling this what is being waited for, if ``is_compiled()`` is false: some twenty seconds.

    Raises
    ------
    BadOptions
        If numba is not installed.
    """
    scene = tiny_scene()
    camera = CameraModel(
        kind="CAHV",
        size_px=(8, 8),
        C=np.array([0.0, 0.0, -1.5]),
        A=np.array([1.0, 0.0, 0.0]),
        H=np.array([3.5, 8.0, 0.0]),
        V=np.array([3.5, 0.0, 8.0]),
    )
    renderer = Renderer(scene, workers=1)
    image = renderer.image(camera, Rigid.identity(), samples=1)
    renderer.close()
    Noise(1.0, 1.0, 0, "").levels(image, image, 0)
    scene.cast([0.0, 0.0, -1.5], [1.0, 0.0, 1.0])
