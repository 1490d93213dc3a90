"""What a mast file costs in pointing: where targets truly land when the mast file does the pointing."""

from __future__ import annotations

import numpy as np

from calib.errors import Unreachable
from calib.mast import Rig
from calib.pointing import choose, solve
from calib.stereo import triangulate
from drivers.clock import ManualClock
from drivers.sim.pan_tilt import HeadSettings, SimulatedPanTilt

PAN_LIMITS_RAD, TILT_LIMITS_RAD = (-2.6, 2.6), (-1.2, 0.5)


def pointing_error_px(
    truth: Rig,
    belief: Rig,
    head: HeadSettings,
    pair: str,
    distance_m: float,
    targets: int,
    seed: int,
    click_px: float = 0.0,
) -> np.ndarray:
    """Return (n, 2) pixels: where ground targets truly lie from the image centre after one pointing.

    With perfect clicks (``click_px`` 0, one sigma per axis in each eye) what is left is the mast file, the
    counts, backlash and sag. A target starts somewhere in the inner half of the left image.
    """
    rng = np.random.default_rng(seed)
    clock = ManualClock()
    device = SimulatedPanTilt(head, clock)
    left, right = truth.stereo[pair]
    believed = belief.cameras[left].model
    centre = np.array(believed.image_center_px)

    def go(pan_rad: float, tilt_rad: float) -> tuple[tuple[float, float], tuple[float, float]]:
        device.move(pan_rad, tilt_rad)
        while (reading := device.read()).moving:
            clock.sleep(0.05)
        return (reading.pan_rad, reading.tilt_rad), device.true_joints(reading.time_s)

    errors: list[np.ndarray] = []
    while len(errors) < targets:
        azimuth = rng.uniform(-1.0, 1.0)
        along = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]) * distance_m
        target = truth.mast.translation_m * np.array([1.0, 1.0, 0.0]) + along
        target[2] = rng.normal(0, 0.1)
        start_px = centre + rng.uniform(-0.25, 0.25, 2) * believed.size_px
        try:
            start = choose(solve(belief.mast, believed, target, start_px), PAN_LIMITS_RAD, TILT_LIMITS_RAD)
        except Unreachable:
            continue
        measured, true = go(start.pan_rad, start.tilt_rad)
        clicks, seen = zip(
            *(truth.camera_in_rover(n, *true).project(target[None]) for n in (left, right)), strict=True
        )
        if not (seen[0][0] and seen[1][0]):
            continue
        left_px, right_px = (click[0] + rng.normal(0, click_px, 2) for click in clicks)
        models = (belief.camera_in_rover(n, *measured) for n in (left, right))
        found = triangulate(*models, left_px, right_px)
        aim = choose(solve(belief.mast, believed, found.position_m), PAN_LIMITS_RAD, TILT_LIMITS_RAD)
        _, true = go(aim.pan_rad, aim.tilt_rad)
        landed, _ = truth.camera_in_rover(left, *true).project(target[None])
        errors.append(landed[0] - centre)
    return np.array(errors)
