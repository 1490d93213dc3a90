"""From a panorama's pictures to its mosaic, its seams, and the picture behind each of its pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np

from calib.errors import BadFile
from calib.geometry.cahvor import CameraModel
from calib.geometry.mosaic import Canvas, MosaicSurface, Projection, border, canvas_of
from calib.geometry.rigid import FloatArray, Rigid
from calib.matching.mosaic import Picture, composed, frames_of, gains_of, seams_of, slip_of
from mastctl.answers import PanoramaDrawn
from mastctl.errors import BadRequest
from mastctl.panorama.folder import MOSAIC, PREVIEW, PREVIEW_PX, Folder, MosaicRecord, write_whole
from mastctl.report.pictures import encoded

GROUND = MosaicSurface("ground", 0.0)


@dataclass(frozen=True)
class Composition:
    """How a mosaic is wanted; without ``px_per_rad`` at the lens' resolution in its middle."""

    projection: Projection = "equirectangular"
    frame: Literal["mast", "rover"] = "mast"
    surface: MosaicSurface = GROUND
    px_per_rad: float | None = None
    raw: bool = False


SO_FAR = Composition(px_per_rad=300.0)


def canvas_for(folder: Folder, wanted: Composition) -> Canvas:
    """Return the canvas of the views that were taken. Raises CalibError."""
    origin = folder.mast.rig.mast.rover_from_mast
    if wanted.frame == "rover":
        origin = Rigid(np.eye(3), origin.translation_m)
    return canvas_of(folder.cameras(), origin, wanted.surface, wanted.projection, wanted.px_per_rad)


def compose(folder: Folder, wanted: Composition, between: Callable[[], None] = lambda: None) -> None:
    """Write the mosaic, the preview and the seams' errors into a folder. Raises BadFile, CalibError.

    ``between`` is called between its parts, and may end it with an error of its own.
    """
    index = folder.index
    if not index.taken():
        raise BadFile(folder.path, "views", "none was taken, so there is no mosaic")
    cameras, pictures, canvas = folder.cameras(), folder.pictures(), canvas_for(folder, wanted)
    owners, places = frames_of(canvas, cameras)
    between()
    gains = None if wanted.raw else gains_of(canvas, cameras, pictures)
    between()
    mosaic = composed(pictures, owners, places, gains)
    del owners, places
    between()
    seams = seams_of(canvas, cameras, pictures)
    between()
    slip = slip_of(folder.mast.rig, index.cameras[0], folder.angles_rad(), canvas, seams.patches)
    between()
    write_whole(folder.path / MOSAIC, encoded(mosaic, "png"))
    write_whole(folder.path / PREVIEW, preview(mosaic))
    numbers = [number for number, _ in index.taken()]
    numbered = [replace(one, views=tuple(numbers[at] for at in one.views)) for one in seams.by_views]
    found = {
        "mosaic": MosaicRecord.of(canvas, wanted.frame, gains),
        "seams": numbered,
        "whole": seams.whole,
        "slip": None if slip is None else slip.numbered(numbers[slip.from_view]),
    }
    folder.save(index.model_copy(update=found))


def so_far(folder: Folder) -> bytes:
    """Return what was taken so far as a JPEG of a preview's size, composed for the default surface."""
    cameras, canvas = folder.cameras(), canvas_for(folder, SO_FAR)
    owners, places = frames_of(canvas, cameras)
    return preview(composed(folder.pictures(), owners, places))


def preview(mosaic: Picture) -> bytes:
    """Return a mosaic as JPEG, at most 2048 pixels wide."""
    part = min(1.0, PREVIEW_PX / mosaic.shape[1])
    return encoded(cv2.resize(mosaic, None, fx=part, fy=part, interpolation=cv2.INTER_AREA), "jpeg", 85)


@dataclass(frozen=True, eq=False)
class Seen:
    """A pixel (2,) of a view's picture, and how far from its camera the mosaic's surface lies there."""

    view: int
    pixel_px: FloatArray
    range_m: float


def picture_at(folder: Folder, pixel_px: tuple[float, float], view: int | None = None) -> Seen:
    """Return which picture a mosaic's pixel is of, and where: by the map that drew it.

    ``view``: the pixel is one of that view's picture. Raises BadRequest ``no_mosaic``, ``outside_panorama``.
    """
    index, record, pixel = folder.index, folder.index.mosaic, np.array(pixel_px)
    if record is None and view is None:
        raise BadRequest("no_mosaic", f"panorama {index.id} is not composed yet")
    canvas = canvas_for(folder, SO_FAR) if record is None else record.canvas
    best: tuple[float, int, FloatArray, CameraModel] | None = None
    for (number, _), camera in zip(index.taken(), folder.cameras(), strict=True):
        place, seen = (pixel, number == view) if view is not None else canvas.in_camera(camera, pixel)
        if bool(seen) and camera.holds(place):
            far = float(np.linalg.norm(place - np.array(camera.image_center_px)))
            if best is None or far < best[0]:
                best = far, number, np.asarray(place), camera
    if best is None:
        width, height = canvas.size_px
        image = f"the mosaic of {width}x{height} px" if view is None else f"view {view}"
        at = f"({pixel_px[0]:g}, {pixel_px[1]:g})"
        raise BadRequest("outside_panorama", f"pixel {at} of {image} of panorama {index.id} shows no view")
    _, number, found, camera = best
    point = canvas.points(canvas.of_camera(camera, found))
    return Seen(number, found, float(np.linalg.norm(point - camera.ray(found).origins_m)))


def drawn(folder: Folder, now: CameraModel | None, points_m: Mapping[str, FloatArray]) -> PanoramaDrawn:
    """Return where a panorama has the border of a camera and some points (3,), both in the rover frame.

    A point lies where the view shows it that has it nearest its middle. Raises CalibError.
    """
    record = folder.index.mosaic if folder.index.state == "done" else None
    canvas, view = canvas_for(folder, SO_FAR) if record is None else record.canvas, None
    if now is not None:
        pixels = canvas.of_camera(now, np.vstack([border(now), now.image_center_px]))
        turn = 2.0 * math.pi * canvas.px_per_rad  # in one piece about its middle:
        pixels[:, 0] -= turn * np.round((pixels[:, 0] - pixels[-1, 0]) / turn)
        view = np.round(pixels[:-1][np.isfinite(pixels[:-1]).all(axis=1)], 1).tolist()
    targets: dict[str, list[float]] = {}
    for name, point in points_m.items():
        seen = [(one, place) for one in folder.cameras() if one.holds(place := one.project(point)[0])]
        if seen:
            camera, place = min(seen, key=lambda one: float(np.linalg.norm(one[1] - one[0].image_center_px)))
            at = canvas.of_camera(camera, place)
            if np.isfinite(at).all():
                targets[name] = at.tolist()
    return {"size_px": list(canvas.size_px), "view_px": view, "targets_px": targets}
