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
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib.camera.cahvor import CameraModel
from calib.rigid import Rigid
from drivers.errors import BadOptions
from drivers.sim.compiled import is_compiled, kernels
from drivers.sim.scene import Scene, tiny_scene

__all__ = ["RayTable", "Renderer", "compile_renderer", "is_compiled", "ray_table"]

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

TILE_PX = 16  # squares for which rocks and the distance to the ground are bounded first...
BLOCK_PX = 4  # ...and then more closely
TABLES_KEPT = 12
MAX_SAMPLES = 8


class RayTable(NamedTuple):
    """All rays of one camera model in the model's own frame, and beams that hold them, tile by tile.

    rays (h, w, q, 3) unit directions, q = samples ** 2 in rows, not-a-number where the model has none; starts
    (h, w, q, 3) where each ray begins relative to C, metres, or (0, 0, 0, 3) if all begin at C; beams of
    tiles and of blocks (rows, columns, 6) as ``kernels.render_tiles`` wants them.

    Directions are float32: in a frame whose x axis is near the optical axis, as mast files have it, the
    rounding is below 1e-4 px at a focal length of 3441 px.
    """

    rays: Float32
    starts: Float32
    tile_beams: Float64
    block_beams: Float64


def ray_table(camera: CameraModel, samples: int) -> RayTable:
    """Return the rays through every sample of every pixel of ``camera``, exactly as the model gives them."""
    width, height = camera.size_px
    q = samples * samples
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    rays = np.empty((height, width, q, 3), dtype=np.float32)
    starts = np.empty((height, width, q, 3), dtype=np.float32)
    y_px, x_px = np.mgrid[0:height, 0:width].astype(np.float64)
    for i in range(q):
        pixels = np.stack([x_px + offsets[i % samples], y_px + offsets[i // samples]], axis=-1)
        origins_m, directions, valid = camera.ray(pixels)
        rays[:, :, i] = np.where(valid[..., None], directions, np.nan)
        starts[:, :, i] = np.where(valid[..., None], origins_m - camera.C, 0.0)
    if not starts.any():
        starts = np.empty((0, 0, 0, 3), dtype=np.float32)
    return RayTable(rays, starts, *(beams(rays, starts, samples, size) for size in (TILE_PX, BLOCK_PX)))


def beams(rays: Float32, starts: Float32, samples: int, size_px: int) -> Float64:
    """Return (rows, columns, 6): the mean direction of each square of pixels, and how far its rays spread."""
    blocks = in_squares(rays, size_px, np.nan)
    valid = np.isfinite(blocks[..., 0])
    table = np.zeros((*blocks.shape[:2], 6))
    axis = np.where(valid[..., None], blocks, 0.0).sum(axis=(2, 3), dtype=np.float64)
    length = np.linalg.norm(axis, axis=-1, keepdims=True)
    table[..., :3] = axis / np.where(length > 0, length, 1.0)
    apart = np.linalg.norm(blocks - table[:, :, None, None, :3].astype(np.float32), axis=-1)
    table[..., 3] = np.where(valid, apart, -1.0).max(axis=(2, 3)) + 1e-6
    table[..., 3][~valid.any(axis=(2, 3))] = np.nan
    if len(starts):
        table[..., 4] = np.linalg.norm(in_squares(starts, size_px, 0.0), axis=-1).max(axis=(2, 3)) + 1e-6
    pitch = np.ones(table.shape[:2])
    for across in (0, 1):
        steps = np.linalg.norm(np.diff(rays[:, :, :1], axis=across), axis=-1)
        steps = np.pad(steps, [(0, int(k == across)) for k in (0, 1)] + [(0, 0)], mode="edge")[..., None]
        squares = in_squares(steps, size_px, np.nan)
        known = np.isfinite(squares)
        total = np.where(known, squares, 0.0).sum(axis=(2, 3, 4))
        pitch *= total / np.maximum(known.sum(axis=(2, 3, 4)), 1)
    table[..., 5] = np.sqrt(pitch) / samples
    return table


def in_squares(values: Float32, size_px: int, filler: float) -> Float32:
    """(h, w, q, n) cut into squares: (rows, columns, pixels, q, n), filled up at the right and below."""
    height, width, q, n = values.shape
    padding = [(0, -height % size_px), (0, -width % size_px), (0, 0), (0, 0)]
    padded = np.pad(values, padding, constant_values=filler)
    rows, columns = padded.shape[0] // size_px, padded.shape[1] // size_px
    cut = padded.reshape(rows, size_px, columns, size_px, q, n).transpose(0, 2, 1, 3, 4, 5)
    return np.asarray(cut.reshape(rows, columns, size_px * size_px, q, n))


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

    def image(self, camera: CameraModel, site_from_camera_frame: Rigid, samples: int = 2) -> Float32:
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
        rotation = np.array(site_from_camera_frame.rotation)
        tiles = table.tile_beams.shape[0] * table.tile_beams.shape[1]
        # short pieces, so that a worker with sky takes its share of ground too
        edges = np.linspace(0, tiles, 8 * self._workers + 1).astype(int) if self._workers > 1 else [0, tiles]

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
        numbers = (getattr(camera, one.name) for one in fields(camera) if one.init)
        key = (samples, *(n.tobytes() if isinstance(n, np.ndarray) else n for n in numbers))
        with self._lock:
            if key not in self._tables:
                self._tables[key] = ray_table(camera, samples)
                while len(self._tables) > TABLES_KEPT:
                    self._tables.popitem(last=False)
            self._tables.move_to_end(key)
            return self._tables[key]


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
    renderer.image(camera, Rigid.identity(), samples=1)
    renderer.close()
    scene.cast([0.0, 0.0, -1.5], [1.0, 0.0, 1.0])
