"""The check at the end of a bench: images that are not fitted, and pointings at corners of the board."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.errors import CalibError, Unreachable
from calib.geometry.pointing import choose, solve
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import triangulate
from calib.plan.knowledge import BenchShot
from calib.plan.poses import candidates
from mastctl.bench.known import BenchKnowledge
from mastctl.bench.mast import BenchLook, BenchMast, NotThere, SeenBoard

POINTINGS = 4


@dataclass(frozen=True)
class CornerPointing:
    """A first pointing at a corner that was clicked off the middle.

    ``residual_px`` is where the corner came to lie in the new image, less where it was to lie;
    ``promised_px`` one sigma of either number.
    """

    corner: int
    range_m: float
    turned_deg: float
    residual_px: tuple[float, float]
    promised_px: float

    def sentence(self) -> str:
        """Return it as a line for a terminal."""
        x, y = self.residual_px
        return (
            f"pointed at corner {self.corner}, {self.turned_deg:.0f} degrees off: residual {x:+.2f}, "
            f"{y:+.2f} px (promised {self.promised_px:.2f})"
        )


@dataclass(frozen=True, eq=False)
class Checked:
    """The result of a check.

    ``promised_px``: camera to what the fit promised of corners in images that were not fitted, rms per axis.
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
        return (
            float(np.sqrt(np.mean([one.promised_px**2 for one in self.pointings])))
            if self.pointings
            else None
        )


def unvisited(known: BenchKnowledge, placement: str, count: int) -> Iterator[BenchShot]:
    """Yield attitudes that show the board, each as far as can be from all that were taken or yielded."""
    mine = [shot for shot in known.shots if shot.placement == placement]
    every = list(candidates(known.now, known.sought, mine, placement))
    taken = [(shot.pan_rad, shot.tilt_rad) for shot in mine]
    for _ in range(min(count, len(every))):
        far = [min((math.dist((s.pan_rad, s.tilt_rad), at) for at in taken), default=9.0) for s in every]
        shot = every.pop(int(np.argmax(far)))
        taken.append((shot.pan_rad, shot.tilt_rad))
        yield shot


def point_at_corners(
    mast: BenchMast, known: BenchKnowledge, placement: str, clicked: Sequence[BenchLook]
) -> Iterator[CornerPointing]:
    """Point once at corners that former looks show off the middle, and yield what was measured."""
    rng = np.random.default_rng(len(clicked))
    cameras = known.workspace.cameras
    done = 0
    for look in [*clicked, *clicked]:
        if done >= POINTINGS:
            return
        seen = {one.camera: one for one in look.found}
        if any(camera not in seen for camera in cameras):
            continue
        ids = [set(one.corners.ids.tolist()) for name in cameras if (one := seen[name]).corners is not None]
        common = np.array(sorted(set.intersection(*ids)))
        rng.shuffle(common)
        for corner in common[:2]:
            pointing = _point(mast, known, placement, look, seen, int(corner))
            if pointing is not None:
                done += 1
                yield pointing
                break


def _point(
    mast: BenchMast,
    known: BenchKnowledge,
    placement: str,
    look: BenchLook,
    seen: Mapping[str, SeenBoard],
    corner: int,
) -> CornerPointing | None:
    """Bring one corner to the middle of the first camera's image; None where that cannot be tried."""
    rig, cameras, head = known.now.rig, known.workspace.cameras, mast.head
    sides = look.pan_approach, look.tilt_approach
    pan_rad, tilt_rad = rig.joints.true_rad((look.pan_rad, look.tilt_rad), sides)
    models = [rig.camera_in_rover(name, pan_rad, tilt_rad) for name in cameras]
    pixels = [_pixel(seen[name], corner) for name in cameras]
    model = rig.cameras[cameras[0]].model
    try:
        if len(cameras) > 1:
            point = triangulate(models[0], models[1], pixels[0], pixels[1]).position_m
        else:  # one camera gets the range: how far the corner is by the fit
            ray = models[0].ray(pixels[0])
            (by_fit_m,) = known.now.boards[placement].points(known.board.in_board_m(np.array([corner])))
            point = ray.origins_m + ray.directions * float(np.linalg.norm(by_fit_m - ray.origins_m))
        found = solve(rig.mast, model, point, from_pan_rad=pan_rad, from_tilt_rad=tilt_rad)
        angles = choose(
            found, head.pan_limits_rad, head.tilt_limits_rad, look.pan_rad, look.tilt_rad,
            read=lambda one: rig.joints.read_rad((one.pan_rad, one.tilt_rad)),
        )  # fmt: skip
    except (Unreachable, CalibError):
        return None
    sides = (0, 0)
    if not head.one_sided:
        sides = (1 if angles.pan_rad > pan_rad else -1, 1 if angles.tilt_rad > tilt_rad else -1)
    try:
        landed = mast.look(*rig.joints.read_rad((angles.pan_rad, angles.tilt_rad), sides), sides)
    except NotThere:
        return None
    again = next((one for one in landed.found if one.camera == cameras[0]), None)
    if again is None or again.corners is None or corner not in again.corners.ids:
        return None
    x, y = _pixel(again, corner) - np.asarray(model.image_center_px)
    turned_rad = math.hypot(angles.pan_rad - pan_rad, angles.tilt_rad - tilt_rad)
    promised_px = math.hypot(known.predicted_px(), known.counts_px, math.sqrt(2.0) * known.sought.sigma_px)
    range_m = float(np.linalg.norm(point - models[0].C))
    return CornerPointing(corner, range_m, math.degrees(turned_rad), (float(x), float(y)), promised_px)


def _pixel(seen: SeenBoard, corner: int) -> FloatArray:
    assert seen.corners is not None
    return np.asarray(seen.corners.pixels_px[int(np.flatnonzero(seen.corners.ids == corner)[0])])
