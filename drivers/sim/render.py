"""Pictures of a scene through any camera model, by casting the model's own rays at the scene's own geometry.

The centre of the top-left pixel is (0, 0). A pixel's value is the mean of samples x samples rays spread
evenly over its square: offsets (i + 0.5) / samples - 0.5 in x and in y. Pictures are noise-free; noise, blur
by motion and exposure are the simulated camera's.

A camera's rays are made once: from the model itself, between its exact rays where it is smooth.
"""

from __future__ import annotations

import logging
import os
import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from calib.geometry.cahvor import CameraModel
from calib.geometry.rigid import Rigid
from drivers.errors import BadOptions
from drivers.sim import kernels
from drivers.sim.placed import SceneSettings
from drivers.sim.scene import Scene, build_scene
from drivers.sim.sensor import FrameExposure, Readout

log = logging.getLogger(__name__)

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Draw = Callable[..., Float32]
"""Takes what `Renderer.image` takes and returns a picture."""

TILE_PX = 16  # squares for which rocks and the distance to the ground are bounded first...
BLOCK_PX = 4  # ...and then more closely
NODES = 24
CHECKS = 41
MOST_APART = 1e-9  # a thousandth of float32's rounding of a direction

TABLES_KEPT = 24  # of six cameras: their own, one for motion and one for metering
STILLS_KEPT = 12
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
    """Return the rays through every sample of every pixel of ``camera``, as the model gives them."""
    width, height = camera.size_px
    x_px, y_px = ((np.arange(count * samples) + 0.5) / samples - 0.5 for count in (width, height))
    found = interpolated(camera, x_px, y_px) or exact(camera, x_px, y_px)
    rays, starts = (in_pixels(part, samples) for part in found)
    beams = [np.empty((-(-height // size), -(-width // size), 6)) for size in (TILE_PX, BLOCK_PX)]
    for table, size in zip(beams, (TILE_PX, BLOCK_PX), strict=True):
        kernels.hold_rays(rays, starts, samples, size, table)
    return RayTable(rays, starts, *beams)


def exact(camera: CameraModel, x_px: Float64, y_px: Float64) -> tuple[Float32, Float32]:
    """Directions and starts (rows, columns, 3) of the rays at every (x, y), from the model itself."""
    rays = np.empty((len(y_px), len(x_px), 3), dtype=np.float32)
    starts = np.zeros_like(rays)
    for row in range(0, len(y_px), 64):
        part = slice(row, row + 64)
        origins_m, directions, valid = camera.ray(np.stack(np.meshgrid(x_px, y_px[part]), axis=-1))
        rays[part] = np.where(valid[..., None], directions, np.nan)
        starts[part] = np.where(valid[..., None], origins_m - camera.C, 0.0)
    return rays, starts if starts.any() else starts[:0, :0]


def interpolated(camera: CameraModel, x_px: Float64, y_px: Float64) -> tuple[Float32, Float32] | None:
    """As `exact`, by polynomials through the model's rays at Chebyshev's nodes; None if that is not exact.

    A lens is a smooth function over the whole picture. Whether it is for this camera is tried at places
    between the nodes; a model without a ray somewhere is left to `exact`.
    """
    spans = [(places[0], places[-1]) for places in (x_px, y_px)]
    nodes = chebyshev.chebpts1(NODES)
    between = np.linspace(-1.0, 1.0, CHECKS)
    at_nodes, at_checks = (rays_at(camera, spans, places) for places in (nodes, between))
    if at_nodes is None or at_checks is None:
        return None
    to_series = np.linalg.inv(chebyshev.chebvander(nodes, NODES - 1))
    series = np.einsum("iy,jx,yxk->kij", to_series, to_series, at_nodes, optimize=True)
    check = chebyshev.chebvander(between, NODES - 1)
    if np.abs(check @ series @ check.T - at_checks.transpose(2, 0, 1)).max() > MOST_APART:
        return None
    in_x, in_y = (
        chebyshev.chebvander(2.0 * (places - low) / (high - low) - 1.0, NODES - 1)
        for places, (low, high) in zip((x_px, y_px), spans, strict=True)
    )
    used = 6 if at_nodes[..., 3:].any() else 3
    out = np.empty((len(y_px), len(x_px), used), dtype=np.float32)
    for k in range(used):
        out[..., k] = (in_y @ series[k]) @ in_x.T
    return out[..., :3], out[..., 3:] if used == 6 else np.empty((0, 0, 3), dtype=np.float32)


def rays_at(camera: CameraModel, spans: list[tuple[float, float]], places: Float64) -> Float64 | None:
    """Directions and starts (n, n, 6) at places (n,) from -1 to 1 across the picture, if all have a ray."""
    x_px, y_px = (low + (places + 1.0) * 0.5 * (high - low) for low, high in spans)
    origins_m, directions, valid = camera.ray(np.stack(np.meshgrid(x_px, y_px), axis=-1))
    if not valid.all():
        return None
    return np.concatenate([directions, origins_m - camera.C], axis=-1)


def in_pixels(values: Float32, samples: int) -> Float32:
    """(rows, columns, 3) of samples as (h, w, samples ** 2, 3)."""
    rows, columns = values.shape[:2]
    if rows == 0:
        return np.empty((0, 0, 0, 3), dtype=np.float32)
    cut = values.reshape(rows // samples, samples, columns // samples, samples, 3).transpose(0, 2, 1, 3, 4)
    return np.ascontiguousarray(cut).reshape(rows // samples, columns // samples, samples**2, 3)


class Renderer:
    """Draws one scene, by so many ``workers``: the machine's processors by default. Safe from any thread."""

    def __init__(self, scene: Scene, workers: int | None = None) -> None:
        self.scene = scene
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
        """Return the picture (h, w) that ``camera`` takes of the scene: brightness 0 to 255, noise-free.

        The model is in the frame it is mounted in (head or rover). Its rays are computed once and kept, so
        give the same model with another transform for another pose, not a moved model. Of rows outside
        [first, last) some are 0. So are pixels for which the model has no ray, or whose ray starts under the
        ground (in CAHVORE rays start the farther from C the more they bend).

        Raises BadOptions for other than 1 to 8 ``samples``, or if C is not above the ground and within 32 m
        of the site's origin in x and y.
        """
        if not 1 <= samples <= MAX_SAMPLES:
            raise BadOptions(f"{samples} samples across a pixel where 1 to {MAX_SAMPLES} are possible")
        centre_m = np.array(site_from_camera_frame.points(camera.C))
        if not kernels.over_ground(self.scene.world.inner, centre_m[0], centre_m[1], -centre_m[2]):
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
            kernels.render_tiles(
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


class Stills:
    """Pictures of poses seen lately, so that a camera at rest before a scene that stands is drawn once.

    A picture without noise is a function of scene, camera, pose and samples alone; the key has every bit of
    these. What else changes a picture (light, dust, exposure) comes after this. Safe from any thread.
    """

    def __init__(self, draw: Draw) -> None:
        self._draw = draw
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
            image = self._draw(camera, site_from_camera_frame, samples)
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


def compile_renderer(scene: Scene | None = None) -> None:
    """Compile what drawing a scene needs, or load it from the disk cache; building one does so too.

    Compiling takes some twenty seconds, and is logged.
    """
    folder = cast(Any, kernels.render_tiles).stats.cache_path
    if folder is None or not any(Path(folder).glob("kernels.render_tiles-*.nbi")):
        log.info("the simulated rover's renderer is compiled, once: 20 s, longer on a busy machine")
    scene = scene or build_scene(SceneSettings(rocks=1))
    x, y, z = np.eye(3)
    camera = CameraModel("CAHV", (8, 8), C=-1.5 * z, A=x, H=3.5 * x + 8.0 * y, V=3.5 * x + 8.0 * z)
    renderer = Renderer(scene, workers=1)
    image = renderer.image(camera, Rigid.identity(), samples=1)
    renderer.close()
    Readout(1.0, 1.0, 0, "").picture(image, 0, FrameExposure(1.0))
    scene.cast([0.0, 0.0, -1.5], [1.0, 0.0, 1.0])
