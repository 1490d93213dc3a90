"""How well `mastctl calibrate --refine` corrects Hazcams that are not where they are believed; no pictures.

The believed rig is the true one with its Hazcams moved by two disagreeing prism set-ups (5 mm, 5 mrad an
axis), or not at all. Navcam hands targets over; clicks and matches err. Errors are of geometric hand-offs of
other targets, 1.5 to 4 m away, with exact clicks:

    .venv/bin/python -m tools.campaigns.refine --rig configs/sim/rocky8.yaml --cases 100 --seed 1
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from calib.files.mast_file import load_rig
from calib.handoff.body_pose import PRIOR_SHIFT_M, PRIOR_TURN_RAD
from calib.handoff.by_image import RefinedPixel
from calib.handoff.corrected_rig import corrected_rig
from calib.handoff.fit_body_pose import fit_body_pose
from calib.handoff.geometric import Joints, hand_off
from calib.handoff.matched import MatchedHandoff, matched_handoff
from calib.mast.rig import Rig
from calib.rigid import FloatArray, Rigid, moved_rigid
from mastctl.calibration.landing import handoff_errors_px
from mastctl.cli.output import at_least, not_negative, positive_number
from tools.arguments import end

HEAD_HEIGHT_M, ASIDE_RAD = 1.45, 0.35
HELD_OUT, HELD_OUT_M = 60, (1.5, 4.0)


def targets(
    true: Rig, ranges_m: tuple[float, float], rng: np.random.Generator
) -> Iterator[tuple[FloatArray, Joints, FloatArray, FloatArray]]:
    """Targets (3,) on rough ground that all four cameras see, the joints, and the pixels of both pairs."""
    source, to = true.stereo["navcam"], true.stereo["hazcam"]
    while True:
        range_m, aside = rng.uniform(*ranges_m), rng.uniform(-ASIDE_RAD, ASIDE_RAD)
        along_m = math.sqrt(range_m**2 - HEAD_HEIGHT_M**2) if range_m > HEAD_HEIGHT_M else 0.1
        place = true.mast.translation_m
        point = np.array(
            [
                place[0] + along_m * math.cos(aside),
                place[1] + along_m * math.sin(aside),
                rng.uniform(-0.15, 0.05),
            ]
        )
        joints = Joints(aside, -math.atan2(HEAD_HEIGHT_M, along_m), 3e-5)
        seen = []
        for name in (*source, *to):
            pixel, valid = true.camera_in_rover(name, joints.pan_rad, joints.tilt_rad).project(point)
            width, height = true.cameras[name].model.size_px
            if valid and 0 <= pixel[0] <= width - 1 and 0 <= pixel[1] <= height - 1:
                seen.append(pixel)
        if len(seen) == 4:
            yield point, joints, np.array(seen[:2]), np.array(seen[2:])


def handed(
    believed: Rig,
    true: Rig,
    ranges_m: tuple[float, float],
    options: argparse.Namespace,
    rng: np.random.Generator,
) -> list[MatchedHandoff]:
    """Hand-offs of a case, with the errors of clicks and matches."""
    source, to = true.stereo["navcam"], true.stereo["hazcam"]
    made = []
    for _, (_, joints, clicks, found) in zip(
        range(options.handoffs), targets(true, ranges_m, rng), strict=False
    ):
        noisy = clicks + rng.normal(0.0, options.click_px, (2, 2))
        done = hand_off(believed, source, to, joints, noisy[0], noisy[1], sigma_px=options.click_px)
        off = rng.normal(0.0, options.match_px, (2, 2))
        refined = {
            name: RefinedPixel("accepted", "", pixel + e, 0.01 * np.eye(2), np.zeros(2))
            for name, pixel, e in zip(to, found, off, strict=True)
        }
        made.append(
            matched_handoff("campaign", source, joints, noisy, options.click_px, joints, done, refined)
        )
    return made


def errors_px(believed: Rig, true: Rig, rng: np.random.Generator) -> FloatArray:
    """Held-out geometric hand-offs with exact clicks: errors (n, 2)."""
    source, to = true.stereo["navcam"], true.stereo["hazcam"]
    found: list[FloatArray] = []
    for _, (point, joints, clicks, _) in zip(range(HELD_OUT), targets(true, HELD_OUT_M, rng), strict=False):
        told = handoff_errors_px(
            believed, true, source, to, joints.pan_rad, joints.tilt_rad, point, clicks[0], clicks[1]
        )
        found += told.values()
    return np.array(found)


def moved(true: Rig, step: FloatArray) -> tuple[Rig, FloatArray]:
    """The rig with its Hazcams moved back by a step about their middle; the step is then the correction."""
    names = true.stereo["hazcam"]
    middle = np.mean([true.cameras[name].model.C for name in names], axis=0)
    motion = (moved_rigid(Rigid(np.eye(3), middle), step) @ Rigid(np.eye(3), -middle)).inverse
    cameras = {n: replace(true.cameras[n], model=true.cameras[n].model.moved(motion)) for n in names}
    # The correction turns about the believed middle, which lies a little beside the true one.
    believed_middle = np.mean([cameras[name].model.C for name in names], axis=0)
    shift = motion.inverse.points(believed_middle) - believed_middle
    return replace(true, cameras={**true.cameras, **cameras}), np.concatenate([step[:3], shift])


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rig", required=True, type=Path, help="the true rig")
    parser.add_argument("--cases", type=at_least(1), default=100)
    parser.add_argument("--handoffs", type=at_least(1), default=20, help="of each case")
    parser.add_argument("--click-px", type=positive_number, default=0.2)
    parser.add_argument("--match-px", type=not_negative, default=0.4, help="what a match is wrong by")
    parser.add_argument("--seed", type=at_least(0), default=1)
    options = parser.parse_args()
    true = load_rig(options.rig).rig
    if lacking := [pair for pair in ("navcam", "hazcam") if pair not in true.stereo]:
        parser.error(f"--rig {options.rig} has no stereo pair '{lacking[0]}'")
    print("targets     moved  significant  told  chi2 of 6   before rms, worst px   after rms, worst px")
    for words, ranges_m in (("2 m", (2.0, 2.0)), ("1.5 to 4 m", (1.5, 4.0))):
        for size in (1.0, 0.0):
            rng = np.random.default_rng(options.seed)
            fits, chi2, before, after = [], [], [], []
            for _ in range(options.cases):
                shift_m, turn_rad = (rng.normal(0.0, size * s, 3) for s in (PRIOR_SHIFT_M, PRIOR_TURN_RAD))
                believed, step = moved(true, np.concatenate([turn_rad, shift_m]))
                fit = fit_body_pose(
                    believed, true.stereo["hazcam"], handed(believed, true, ranges_m, options, rng)
                )
                off = fit.step - step
                chi2.append(float(off @ np.linalg.solve(fit.covariance, off)))
                fits.append(fit)
                taken = corrected_rig(believed, fit) if fit.significant else believed
                held_out = rng.integers(1 << 31)
                before.append(errors_px(believed, true, np.random.default_rng(held_out)))
                after.append(errors_px(taken, true, np.random.default_rng(held_out)))
            told = [
                f"{np.sqrt(np.mean(e**2)):6.2f} {np.linalg.norm(e, axis=-1).max():6.2f}"
                for e in (np.concatenate(before), np.concatenate(after))
            ]
            significant = sum(fit.significant for fit in fits)
            seen = np.mean([fit.seen for fit in fits])
            print(
                f"{words:11s} {'yes' if size else 'no':5s}  {significant:4d} of {options.cases:<4d}  "
                f"{seen:4.1f}  {np.mean(chi2):9.2f}   {told[0]:>20s}  {told[1]:>20s}"
            )
    return 0


if __name__ == "__main__":
    end(main)
