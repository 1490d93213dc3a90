"""Cameras on the body: where a board has to stand so that they see it too, and how sure they are by it.

A body camera is tied to the head by boards that both see. It does not move: however many pictures are taken,
each placement shows it the board once.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace

import numpy as np

from calib.bench.knowledge import Knowledge, Shot
from calib.bench.placements import BEARINGS_DEG, RANGES_M, TURNS_DEG, Advice, Placement, told_by
from calib.bench.poses import Sought, seen
from calib.camera.parameters import predict
from calib.fit.least_squares import covariance_of
from calib.rigid import FloatArray

HEIGHTS_DEG = (-60.0, -50.0, -40.0, -30.0, -15.0)
"""Body cameras mostly look down, at what is near."""

BELOW_M = 0.3
"""How far below a body camera the middle of a board is supposed to find room over the ground."""

RANGE_M = 2.0
GRID = 5
"""Where a body camera's pixels are judged: so far away, in so many rows and columns."""

FEWEST = 2
"""Placements that a body camera has to see: of one, focal length and distance trade for each other."""


def body_cameras(known: Knowledge) -> tuple[str, ...]:
    """Return the names of the cameras on the body."""
    return tuple(name for name, camera in known.rig.cameras.items() if camera.on == "rover")


def body_px(known: Knowledge, covariance: FloatArray, camera: str) -> float:
    """Return what a body camera's pixels of points 2 m away are off by, rms per axis.

    ``covariance`` is that of ``known.names``.
    """
    model = known.rig.cameras[camera].model
    width, height = model.size_px
    x, y = np.meshgrid(*((np.arange(GRID) + 0.5) / GRID * size for size in (width, height)))
    rays = model.ray(np.stack([x.ravel(), y.ravel()], axis=-1))
    points = rays.origins_m[rays.valid] + RANGE_M * rays.directions[rays.valid]
    rates = predict(model, points).d_step
    mine = [k for k, name in enumerate(known.names) if name.startswith(f"cameras.{camera}.")]
    squares = np.einsum("nip,pq,niq->ni", rates, covariance[np.ix_(mine, mine)], rates)
    return float(np.sqrt(np.mean(squares[np.isfinite(squares)])))


def advise_for_body(
    known: Knowledge, sought: Sought, shots: Collection[Shot], cameras: Collection[str]
) -> Advice | None:
    """Return the placement that tells most of some body cameras, or None if none shows them a board that the
    head can see; ``expected_px`` is then what their pixels are off by."""
    base = known.information(shots)
    best: tuple[int, float, Placement] | None = None
    for placement in _low_placements(known, sought):
        see = _sees(known, sought, placement) & set(cameras)
        told = told_by(known, sought, placement) if see else None
        if told is None:
            continue
        covariance = covariance_of(base + told)
        off_px = float(np.mean([body_px(known, covariance, name) for name in cameras]))
        if best is None or (-len(see), off_px) < best[:2]:
            best = -len(see), off_px, placement
    return None if best is None else Advice(best[2], best[1])


def _low_placements(known: Knowledge, sought: Sought) -> Iterator[Placement]:
    """Places around and below, where there should be room over the ground."""
    head = known.rig.mast.rover_from_head(0.0, 0.0)
    lowest_m = max(known.rig.cameras[name].model.C[2] for name in body_cameras(known)) + BELOW_M
    pan, tilt = np.degrees(sought.pan_limits_rad), np.degrees(sought.tilt_limits_rad)
    for range_m in RANGES_M:
        for bearing in BEARINGS_DEG:
            for height in HEIGHTS_DEG:
                if not (pan[0] <= bearing <= pan[1] and tilt[0] <= height <= tilt[1]):
                    continue
                for turned in TURNS_DEG:
                    placement = Placement(range_m, bearing, height, turned)
                    if placement.rover_from_board(head).translation_m[2] <= lowest_m:
                        yield placement


def _sees(known: Knowledge, sought: Sought, placement: Placement) -> set[str]:
    """Which body cameras see a board that stands so."""
    pose = placement.rover_from_board(known.rig.mast.rover_from_head(0.0, 0.0))
    fixed = {name: known.rig.cameras[name] for name in body_cameras(known)}
    on_body = Knowledge(replace(known.rig, cameras=fixed, stereo={}), {"": pose})
    shown = seen(on_body, sought, Shot("", 0.0, 0.0, ()))
    return set() if shown is None else {view.camera for view in shown.views}
