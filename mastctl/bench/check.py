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
from calib.targets.boards import Corners
from mastctl.bench.known import BenchKnowledge
from mastctl.bench.mast import BenchLook, BenchMast, NotThere
from mastctl.report.pages import Table

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
        squares = [one.promised_px**2 for one in self.pointings]
        return math.sqrt(np.mean(squares)) if squares else None

    def table(self) -> Table | None:
        """Return the pointings for a page."""
        rows = [
            [
                f"{one.corner}",
                f"{one.range_m:.2f}",
                f"{one.turned_deg:.0f}",
                *(f"{part:+.3f}" for part in one.residual_px),
                f"{one.promised_px:.3f}",
            ]
            for one in self.pointings
        ]
        headings = ("corner", "range m", "turned deg", "residual x px", "y px", "promised sigma px")
        return Table(headings, rows) if rows else None


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
    done = 0
    for look in [*clicked, *clicked]:
        seen = {one.camera: one.corners for one in look.found if one.corners is not None}
        if not set(known.workspace.cameras) <= set(seen):
            continue
        ids = [set(seen[name].ids.tolist()) for name in known.workspace.cameras]
        common = np.array(sorted(set.intersection(*ids)))
        rng.shuffle(common)
        pointings = (_pointing(mast, known, placement, look, seen, int(corner)) for corner in common[:2])
        pointing = next((one for one in pointings if one is not None), None)
        if pointing is not None:
            yield pointing
            done += 1
            if done == POINTINGS:
                return


def _pointing(
    mast: BenchMast,
    known: BenchKnowledge,
    placement: str,
    look: BenchLook,
    seen: Mapping[str, Corners],
    corner: int,
) -> CornerPointing | None:
    """Bring one corner to the middle of the first camera's image; None where that cannot be tried."""
    rig, cameras, head = known.now.rig, known.workspace.cameras, mast.head
    now_rad = rig.joints.true_rad((look.pan_rad, look.tilt_rad), (look.pan_approach, look.tilt_approach))
    models = [rig.camera_in_rover(name, *now_rad) for name in cameras]
    pixels = [_pixel(seen[name], corner) for name in cameras]
    model = rig.cameras[cameras[0]].model
    try:
        if len(cameras) > 1:
            point = triangulate(models[0], models[1], pixels[0], pixels[1]).position_m
        else:  # one camera gets the range: how far the corner is by the fit
            ray = models[0].ray(pixels[0])
            (by_fit_m,) = known.now.boards[placement].points(known.board.in_board_m(np.array([corner])))
            point = ray.origins_m + ray.directions * float(np.linalg.norm(by_fit_m - ray.origins_m))
        found = solve(rig.mast, model, point, from_pan_rad=now_rad[0], from_tilt_rad=now_rad[1])
        angles = choose(
            found, head.pan_limits_rad, head.tilt_limits_rad, look.pan_rad, look.tilt_rad,
            read=lambda one: rig.joints.read_rad((one.pan_rad, one.tilt_rad)),
        )  # fmt: skip
        turn_rad = angles.pan_rad - now_rad[0], angles.tilt_rad - now_rad[1]
        sides = (0, 0) if head.one_sided else (1 if turn_rad[0] > 0 else -1, 1 if turn_rad[1] > 0 else -1)
        landed = mast.look(*rig.joints.read_rad((angles.pan_rad, angles.tilt_rad), sides), sides)
    except (Unreachable, CalibError, NotThere):
        return None
    again = next((one.corners for one in landed.found if one.camera == cameras[0]), None)
    if again is None or corner not in again.ids:
        return None
    x, y = _pixel(again, corner) - np.asarray(model.image_center_px)
    promised_px = math.hypot(known.predicted_px(), known.counts_px, math.sqrt(2.0) * known.sought.sigma_px)
    range_m = float(np.linalg.norm(point - models[0].C))
    turned_deg = math.degrees(math.hypot(*turn_rad))
    return CornerPointing(corner, range_m, turned_deg, (float(x), float(y)), promised_px)


def _pixel(corners: Corners, corner: int) -> FloatArray:
    return np.asarray(corners.pixels_px[int(np.flatnonzero(corners.ids == corner)[0])])
