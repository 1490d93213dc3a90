"""Measure the sub-pixel error of rendered pictures: where patches land against where geometry puts them.

The head turns between two pictures as it does when pointing, or rolls by half a turn about the camera's axis:
a shift of all pixels hides from a turn, but not from a roll. Patches of the first picture are carried along
their range (``Scene.cast``) into the second (``CameraModel.project``) and found there by OpenCV's ECC with an
affine warp, which knows nothing of the renderer. The mean error
shows bias, the rms aliasing and poor texture.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast
from calib.geometry.rigid import FloatArray, Rigid, rot_y, rot_z
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene

MAST = Mast(np.array([0.3443, -0.0043, -1.4572]), np.array([-0.0088, -0.0181, 0.0027]))
HALF_PX = 20
SPREAD_PX = (np.arange(9) - 4) * (2 * HALF_PX + 1) / 9
GRID_PX = np.stack(np.meshgrid(SPREAD_PX, SPREAD_PX), axis=-1).reshape(-1, 2)
"""Middles of 9 x 9 parts of a patch: a sum over them weighs the patch as a sum over its pixels does."""
MARGIN_PX = 14
BLUR_PX = 0.7
LEAST_TEXTURE = 2.0
"""Patches with less than this many grey levels per pixel, in the poorer direction, are not matched."""
UNEVEN = 0.03
"""Patches whose inverse range departs from a plane by more than this part hold an edge that hides things."""


def mast_camera(focal_px: float, y_m: float, z_m: float, r2: float) -> CameraModel:
    """Return a head camera of 1024 x 768 pixels that looks along x, a little askew, with some distortion."""
    turn = rot_z(0.011) @ rot_y(-0.007)
    ahead, right, down = turn.T
    return CameraModel(
        kind="CAHVOR",
        size_px=(1024, 768),
        C=np.array([0.05, y_m, z_m]),
        A=ahead,
        H=focal_px * right + 514.2 * ahead,
        V=focal_px * 1.001 * down + 381.7 * ahead,
        O=ahead,
        R=np.array([0.0, r2, 0.0]),
    )


def fisheye_camera() -> CameraModel:
    """Return a body camera of 640 x 480 pixels, 120 degrees wide, whose rays do not start in one point."""
    ahead, right, down = (rot_z(0.004) @ rot_y(-0.62)).T
    return CameraModel(
        kind="CAHVORE",
        size_px=(640, 480),
        C=np.array([0.40, -0.05, -0.50]),
        A=ahead,
        H=309.0 * right + 321.3 * ahead,
        V=309.4 * down + 238.1 * ahead,
        O=ahead,
        R=np.array([0.0, -0.014, 0.0]),
        E=np.array([0.008, 0.0035, 0.0]),
        cahvore_type=2,
        linearity=0.0,
    )


NAVCAM = mast_camera(1290.0, -0.10, -0.02, -0.04)
PANCAM = mast_camera(3441.0, -0.15, -0.06, -0.11)
HAZCAM = fisheye_camera()


def head_pose(range_m: float, pan_rad: float, tilt_rad: float) -> Rigid:
    """Return site_from_head looking at the ground ``range_m`` ahead, turned further by pan and tilt."""
    return MAST.rover_from_head(pan_rad, tilt_rad - np.arctan2(1.5, range_m))


def measure(
    renderer: Renderer,
    camera: CameraModel,
    site_from_head: tuple[Rigid, Rigid],
    samples: int,
    patches: int,
    rng: np.random.Generator,
) -> FloatArray:
    """Return found minus true (n, 2) px of patches carried from the first pose to the second."""
    first, second = (renderer.image(camera, pose, samples) for pose in site_from_head)
    first, second = (cv2.GaussianBlur(image, (0, 0), BLUR_PX) for image in (first, second))  # type: ignore[assignment]
    texture = texture_of(first)
    width, height = camera.size_px
    edge = HALF_PX + MARGIN_PX
    errors: list[FloatArray] = []
    lost = 0
    for _ in range(40 * patches):
        if len(errors) + lost == patches:
            break
        pixel = np.array([rng.integers(edge, width - edge), rng.integers(edge, height - edge)])
        if texture[pixel[1], pixel[0]] < LEAST_TEXTURE:
            continue
        places = pixel + GRID_PX
        there = carried(renderer.scene, camera, site_from_head, places)
        if there is None:
            continue
        # an affine warp cannot bend: the truth for it is the best affine carrying of the whole patch
        best = best_affine(GRID_PX, there)
        truth = best[:, 2]
        if not ((truth > edge) & (truth < np.array([width, height]) - edge - 1)).all():
            continue
        found = match(first, second, pixel, best, rng)
        if found is None:
            lost += 1
        else:
            errors.append(found - truth)
    return np.array(errors).reshape(-1, 2)


def texture_of(image: np.ndarray) -> FloatArray:
    """Grey levels per pixel in each patch's poorer direction, (h, w)."""
    dy, dx = np.gradient(image)
    size = (2 * HALF_PX + 1, 2 * HALF_PX + 1)
    xx, xy, yy = (cv2.boxFilter(part, -1, size) for part in (dx * dx, dx * dy, dy * dy))
    least = 0.5 * (xx + yy) - np.sqrt(0.25 * (xx - yy) ** 2 + xy**2)
    return np.asarray(np.sqrt(np.maximum(least, 0.0)))


def carried(
    scene: Scene, camera: CameraModel, site_from_head: tuple[Rigid, Rigid], places_px: FloatArray
) -> FloatArray | None:
    """Pixels (n, 2) of the first picture in the second; None where a patch is not one smooth piece."""
    first, second = site_from_head
    rays = camera.ray(places_px)
    origins_m, directions = first.points(rays.origins_m), first.vectors(rays.directions)
    ranges_m = scene.cast(origins_m, directions)
    if not np.isfinite(ranges_m).all():
        return None
    plane = np.column_stack([places_px, np.ones(len(places_px))])
    inverse = 1.0 / ranges_m
    rest = inverse - plane @ np.linalg.lstsq(plane, inverse, rcond=None)[0]
    if np.abs(rest).max() > UNEVEN * inverse.mean():
        return None
    points = origins_m + ranges_m[:, None] * directions
    pixels, valid = camera.project(second.inverse.points(points))
    return pixels if valid.all() else None


def best_affine(offsets_px: FloatArray, there_px: FloatArray) -> FloatArray:
    """Least-squares affine warp (2, 3) from offsets about a patch to pixels of the second picture."""
    local = np.column_stack([offsets_px, np.ones(len(offsets_px))])
    return np.asarray(np.linalg.lstsq(local, there_px, rcond=None)[0].T)


def match(
    first: np.ndarray, second: np.ndarray, pixel: np.ndarray, best: FloatArray, rng: np.random.Generator
) -> FloatArray | None:
    """Where ECC finds the patch about ``pixel`` in the second picture; None at the border or if it fails."""
    x, y = pixel
    template = first[y - HALF_PX : y + HALF_PX + 1, x - HALF_PX : x + HALF_PX + 1]
    corner = np.rint(best[:, 2]).astype(int) - HALF_PX - MARGIN_PX
    size = 2 * (HALF_PX + MARGIN_PX) + 1
    if (corner < 0).any() or (corner + size > second.shape[::-1]).any():
        return None
    window = second[corner[1] : corner[1] + size, corner[0] : corner[0] + size]
    # start from the true stretch but up to half a pixel away, so that standing still is no success
    warp = best.copy()
    warp[:, 2] += rng.uniform(-0.5, 0.5, 2) - best[:, :2] @ [HALF_PX, HALF_PX] - corner
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 200, 1e-7)
    try:
        _, warp = cv2.findTransformECC(  # type: ignore[assignment]
            template, window, np.ascontiguousarray(warp, np.float32), cv2.MOTION_AFFINE, criteria, None, 1
        )
    except cv2.error as error:
        if error.code != cv2.Error.StsNoConv:
            raise
        return None
    found: FloatArray = warp.astype(np.float64) @ np.array([HALF_PX, HALF_PX, 1.0]) + corner
    return found


def turned_poses(camera: CameraModel, range_m: float, rng: np.random.Generator) -> tuple[Rigid, Rigid]:
    """Two head poses as a pointing makes them: the second up to a third of the picture away."""
    reach = 340.0 / float(np.linalg.norm(camera.H - camera.A * (camera.H @ camera.A)))
    pan, tilt = rng.uniform(-0.8, 0.8), rng.uniform(-0.02, 0.02)
    turn = rng.uniform(-1.0, 1.0, 2) * reach * np.array([1.0, 0.7])
    return head_pose(range_m, pan, tilt), head_pose(range_m, pan + turn[0], tilt + turn[1])


def rolled_poses(camera: CameraModel, range_m: float, rng: np.random.Generator) -> tuple[Rigid, Rigid]:
    """Two head poses half a turn about the camera's axis (and a little) apart: the camera stays in place."""
    first = head_pose(range_m, rng.uniform(-0.8, 0.8), rng.uniform(-0.02, 0.02))
    roll = Rotation.from_rotvec(camera.A * (np.pi + rng.uniform(-0.03, 0.03))).as_matrix()
    return first, first @ Rigid(roll, camera.C - roll @ camera.C)


def body_poses(camera: CameraModel, range_m: float, rng: np.random.Generator) -> tuple[Rigid, Rigid]:
    """Two rover poses: turned on the spot by up to 0.2 rad."""
    first, second = rng.uniform(-0.2, 0.2, 2)
    return Rigid(rot_z(first), np.zeros(3)), Rigid(rot_z(second), np.zeros(3))
