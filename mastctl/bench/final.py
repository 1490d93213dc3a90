"""The end of a bench: pictures that are not fitted, and pointings at corners, beside what was promised."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.errors import CalibError, Unreachable
from calib.geometry.pointing import solve
from calib.geometry.rigid import FloatArray
from calib.geometry.solutions import Solution, choose
from calib.geometry.stereo import triangulate
from calib.plan.knowledge import BenchShot, Knowledge
from calib.plan.poses import Sought, candidates
from calib.targets.boards import AnyBoard
from mastctl.bench.eyes import Eyes, Look, NotThere, Seen

POINTINGS = 4


@dataclass(frozen=True)
class CornerPointing:
    """A first pointing at a corner that was clicked off the middle.

    ``residual_px`` is where the corner came to lie in the new picture, less where it was to lie;
    ``promised_px`` one sigma of either number.
    """

    corner: int
    range_m: float
    turned_deg: float
    residual_px: tuple[float, float]
    promised_px: float


@dataclass(frozen=True, eq=False)
class Checked:
    """What the end of a bench showed.

    Attributes
    ----------
    promised_px
        Camera to what the fit promised of corners in pictures that were not fitted, rms per axis.
    pointings
        First pointings at corners.
    """

    promised_px: Mapping[str, float]
    pointings: tuple[CornerPointing, ...]

    @property
    def pointing_rms_px(self) -> tuple[float, float] | None:
        """Rms (x, y) of the pointings."""
        if not self.pointings:
            return None
        x, y = np.sqrt(np.mean([np.square(one.residual_px) for one in self.pointings], axis=0))
        return float(x), float(y)

    @property
    def pointing_promised_px(self) -> float | None:
        """Rms of what was promised of them."""
        if not self.pointings:
            return None
        return float(np.sqrt(np.mean([one.promised_px**2 for one in self.pointings])))


def unvisited(
    known: Knowledge, sought: Sought, here: Sequence[BenchShot], placement: str, count: int
) -> Iterator[BenchShot]:
    """Yield attitudes that show the board, each as far as can be from all that were taken or yielded."""
    every = list(candidates(known, sought, here, placement))
    taken = [(shot.pan_rad, shot.tilt_rad) for shot in here]
    for _ in range(min(count, len(every))):
        far = [min((math.dist((s.pan_rad, s.tilt_rad), at) for at in taken), default=9.0) for s in every]
        shot = every.pop(int(np.argmax(far)))
        taken.append((shot.pan_rad, shot.tilt_rad))
        yield shot


def point_at_corners(
    eyes: Eyes,
    known: Knowledge,
    stands: tuple[str, AnyBoard],
    cameras: Sequence[str],
    clicked: Sequence[Look],
    promised_px: float,
    corner_px: float,
) -> Iterator[CornerPointing]:
    """Point once at corners that former looks show off the middle, and yield what was measured.

    Parameters
    ----------
    eyes, known
        The head, and the fitted rig with the boards' places.
    stands
        The placement, and the board that stands there.
    cameras
        The camera that points, and its partner if there is one.
    clicked
        Looks that were not fitted.
    promised_px, corner_px
        Rms per axis that calibration and counts leave, and sigma of a found corner.
    """
    rng = np.random.default_rng(len(clicked))
    done = 0
    for look in [*clicked, *clicked]:
        if done >= POINTINGS:
            return
        seen = {one.camera: one for one in look.found}
        if any(camera not in seen for camera in cameras):
            continue
        common = _common([seen[camera] for camera in cameras])
        rng.shuffle(common)
        for corner in common[:2]:
            told = _point(eyes, known, stands, cameras, look, seen, int(corner), promised_px, corner_px)
            if told is not None:
                done += 1
                yield told
                break


def _common(seen: Sequence[Seen]) -> FloatArray:
    ids = [set(one.corners.ids.tolist()) for one in seen if one.corners is not None]
    return np.array(sorted(set.intersection(*ids)))


def _point(
    eyes: Eyes,
    known: Knowledge,
    stands: tuple[str, AnyBoard],
    cameras: Sequence[str],
    look: Look,
    seen: Mapping[str, Seen],
    corner: int,
    promised_px: float,
    corner_px: float,
) -> CornerPointing | None:
    """Bring one corner to the middle of the first camera's picture; None where that cannot be tried."""
    rig, camera = known.rig, cameras[0]
    model, head = rig.cameras[camera].model, eyes.head
    pixels = [_pixel(seen[name], corner) for name in cameras]
    here = [_true(known, seen[name], look) for name in cameras]
    models = [rig.camera_in_rover(name, *at) for name, at in zip(cameras, here, strict=True)]

    def read_rad(angles: Solution) -> tuple[float, float]:
        return rig.joints.read_rad((angles.pan_rad, angles.tilt_rad))

    try:
        if len(cameras) > 1:
            point = triangulate(models[0], models[1], pixels[0], pixels[1]).position_m
        else:  # one eye is told the range: how far the corner is by the fit
            ray = models[0].ray(pixels[0])
            name, board = stands
            (there_m,) = known.boards[name].points(board.in_board_m(np.array([corner])))
            point = ray.origins_m + ray.directions * float(np.linalg.norm(there_m - ray.origins_m))
        found = solve(rig.mast, model, point, from_pan_rad=here[0][0], from_tilt_rad=here[0][1])
        angles = choose(found, head.pan_limits_rad, head.tilt_limits_rad, *here[0], read=read_rad)
    except (Unreachable, CalibError):
        return None
    sides = (0, 0)
    if not head.one_sided:
        sides = (1 if angles.pan_rad > here[0][0] else -1, 1 if angles.tilt_rad > here[0][1] else -1)
    try:
        landed = eyes.look(*rig.joints.read_rad((angles.pan_rad, angles.tilt_rad), sides), sides)
    except NotThere:
        return None
    seen_there = next((one for one in landed.found if one.camera == camera), None)
    if seen_there is None or seen_there.corners is None or corner not in seen_there.corners.ids:
        return None
    x, y = _pixel(seen_there, corner) - np.asarray(model.image_center_px)
    turned = math.hypot(angles.pan_rad - here[0][0], angles.tilt_rad - here[0][1])
    return CornerPointing(
        corner,
        float(np.linalg.norm(point - models[0].C)),
        math.degrees(turned),
        (float(x), float(y)),
        math.sqrt(promised_px**2 + 2.0 * corner_px**2),
    )


def _pixel(seen: Seen, corner: int) -> FloatArray:
    assert seen.corners is not None
    return np.asarray(seen.corners.pixels_px[int(np.flatnonzero(seen.corners.ids == corner)[0])])


def _true(known: Knowledge, seen: Seen, look: Look) -> tuple[float, float]:
    return known.rig.joints.true_rad((seen.pan_rad, seen.tilt_rad), (look.pan_approach, look.tilt_approach))
