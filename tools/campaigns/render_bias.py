"""Measure the sub-pixel error of rendered pictures: where patches land against where geometry puts them.

The head turns between two pictures as it does when pointing, or rolls by half a turn about the camera's axis:
a shift of all pixels hides from a turn, but not from a roll. Patches of the first picture are carried along
their range (``Scene.cast``) into the second (``CameraModel.project``) and found there by OpenCV's ECC with an
affine warp, which knows nothing of the renderer. Mean error tells of bias, rms of aliasing and poor texture.

    .venv/bin/python -m tools.campaigns.render_bias --cases 12
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast
from calib.geometry.rigid import FloatArray, Rigid, rot_y, rot_z
from drivers.sim.render import Renderer
from drivers.sim.scene import Scene, SceneSettings, build_scene
from mastctl.cli.output import at_least, positive_number
from tools.command import end, options, run_cases

MAST = Mast(np.array([0.3443, -0.0043, -1.4572]), np.array([-0.0088, -0.0181, 0.0027]))
Poses = Callable[[CameraModel, float, np.random.Generator], tuple[Rigid, Rigid]]
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


@dataclass(frozen=True)
class BiasErrors:
    """What was measured: error_px (n, 2), found minus true, in x and y, and how many patches were lost."""

    error_px: FloatArray
    lost: int

    def line(self) -> str:
        """Number, mean and rms per axis, and the 95th percentile of the length."""
        if len(self.error_px) < 2:
            return f"n {len(self.error_px)} lost {self.lost}: too few"
        mean, rms = self.error_px.mean(axis=0), np.sqrt((self.error_px**2).mean(axis=0))
        spread = self.error_px.std(axis=0) / np.sqrt(len(self.error_px))
        length = np.percentile(np.hypot(*self.error_px.T), 95)
        return (
            f"n {len(self.error_px):4d} lost {self.lost:3d}  mean {mean[0]:+.4f} {mean[1]:+.4f} "
            f"(±{spread[0]:.4f} {spread[1]:.4f})  rms {rms[0]:.3f} {rms[1]:.3f}  p95 {length:.3f} px"
        )


def together(parts: list[BiasErrors]) -> BiasErrors:
    """All errors of several pairs of pictures."""
    return BiasErrors(np.concatenate([part.error_px for part in parts]), sum(part.lost for part in parts))


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
    believed: CameraModel | None = None,
) -> BiasErrors:
    """Return the errors of up to ``patches`` patches carried from the first pose to the second.

    ``believed`` is the camera that geometry is reckoned with, ``camera`` by default.
    """
    first, second = (renderer.image(camera, pose, samples) for pose in site_from_head)
    first, second = (cv2.GaussianBlur(image, (0, 0), BLUR_PX) for image in (first, second))
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
        there = carried(renderer.scene, believed or camera, site_from_head, places)
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
    return BiasErrors(np.array(errors).reshape(-1, 2), lost)


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
        _, warp = cv2.findTransformECC(
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


CAMERAS: dict[str, tuple[CameraModel, Poses]] = {
    "navcam turned": (NAVCAM, turned_poses),
    "navcam rolled": (NAVCAM, rolled_poses),
    "pancam turned": (PANCAM, turned_poses),
    "pancam rolled": (PANCAM, rolled_poses),
    "hazcam turned": (HAZCAM, body_poses),
}


@dataclass(frozen=True)
class BiasRow:
    """A scene, a camera and how it moves, a range, rays a pixel and side; so many pairs of pictures."""

    scene: str
    camera: str
    range_m: float
    samples: int
    pairs: int
    patches: int
    seed: int

    def __str__(self) -> str:
        return f"{self.scene:6s} {self.camera} {self.range_m:4.1f} m  {self.samples}x{self.samples}"


@cache
def scene_renderer(scene: str, seed: int) -> Renderer:
    """Return what draws a scene, ``flat`` or with ``relief`` and rocks."""
    flat = SceneSettings(seed=seed, relief_m=0.0, rocks=0)
    return Renderer(build_scene(flat if scene == "flat" else SceneSettings(seed=seed)), workers=1)


def run_row(row: BiasRow) -> BiasErrors:
    """Draw a row's pictures and measure them."""
    camera, poses = CAMERAS[row.camera]
    rng = np.random.default_rng([row.seed, int(row.range_m * 10), row.samples])
    renderer = scene_renderer(row.scene, row.seed)
    return together(
        [
            measure(renderer, camera, poses(camera, row.range_m, rng), row.samples, row.patches, rng)
            for _ in range(row.pairs)
        ]
    )


def main() -> int:
    """Print one row for each scene, camera, range and number of samples."""
    parser = options(__doc__, 6, "pairs of pictures a row")
    parser.add_argument("--patches", type=at_least(1), default=40, help="patches a pair")
    parser.add_argument("--samples", type=at_least(1), nargs="+", default=[1, 2, 3])
    parser.add_argument("--ranges", type=positive_number, nargs="+", default=[10.0, 6.0, 2.0])
    args = parser.parse_args()
    places = [(camera, range_m) for range_m in args.ranges for camera in CAMERAS if camera != "hazcam turned"]
    rows = [
        BiasRow(scene, camera, range_m, samples, args.cases, args.patches, args.seed)
        for scene in ("flat", "relief")
        for camera, range_m in [*places, ("hazcam turned", 2.0)]
        for samples in args.samples
    ]
    for row, errors in zip(rows, run_cases(args, "rows", run_row, rows), strict=True):
        print(f"{row}  {errors.line()}")
    return 0


if __name__ == "__main__":
    end(main)
