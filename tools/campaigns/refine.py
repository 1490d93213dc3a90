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
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calib.calibrate.body import PRIOR_SHIFT_M, PRIOR_TURN_RAD, corrected_rig, fit_body_pose
from calib.files.mast_file import load_rig
from calib.geometry.handoff import Joints, hand_off
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid
from calib.matching.handoff import MatchedHandoff, RefinedPixel, matched_handoff
from mastctl.calibration.landing import handoff_errors_px
from mastctl.cli.experiment import results_of
from mastctl.cli.options import at_least, not_negative, positive_number
from tools.command import end, options, rms, show

HEAD_HEIGHT_M, ASIDE_RAD = 1.45, 0.35
HELD_OUT, HELD_OUT_M = 60, (1.5, 4.0)
BLOCK = 10
ROWS = [
    (words, ranges_m, size)
    for words, ranges_m in (("2 m", (2.0, 2.0)), ("1.5 to 4 m", (1.5, 4.0)))
    for size in (1.0, 0.0)
]
"""Targets of the record in words and metres, and how far the Hazcams are moved, sigmas."""


@dataclass(frozen=True)
class RefineBlock:
    """Cases of one row from ``first`` on, up to ``BLOCK``, with a draw of their own."""

    true: Rig
    ranges_m: tuple[float, float]
    size: float
    first: int
    count: int
    handoffs: int
    click_px: float
    match_px: float
    seed: int


@dataclass(frozen=True)
class RefinedCase:
    """One fit: significant or not, directions determined, chi-square of six, held-out errors (n, 2) px."""

    significant: bool
    seen: int
    chi2: float
    before_px: FloatArray
    after_px: FloatArray


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
    block: RefineBlock,
    rng: np.random.Generator,
) -> list[MatchedHandoff]:
    """Hand-offs of a case, with the errors of clicks and matches."""
    source, to = true.stereo["navcam"], true.stereo["hazcam"]
    made = []
    for _, (_, joints, clicks, found) in zip(
        range(block.handoffs), targets(true, block.ranges_m, rng), strict=False
    ):
        noisy = clicks + rng.normal(0.0, block.click_px, (2, 2))
        done = hand_off(believed, source, to, joints, noisy[0], noisy[1], sigma_px=block.click_px)
        off = rng.normal(0.0, block.match_px, (2, 2))
        refined = {
            name: RefinedPixel("accepted", "", pixel + e, 0.01 * np.eye(2), np.zeros(2))
            for name, pixel, e in zip(to, found, off, strict=True)
        }
        made.append(matched_handoff("campaign", source, joints, noisy, block.click_px, joints, done, refined))
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


def run_block(block: RefineBlock) -> list[RefinedCase]:
    """Return what the fits of a block come to; the cases of all rows have the same draws."""
    true, rng = block.true, np.random.default_rng([block.seed, block.first])
    cases = []
    for _ in range(block.count):
        shift_m, turn_rad = (rng.normal(0.0, block.size * s, 3) for s in (PRIOR_SHIFT_M, PRIOR_TURN_RAD))
        believed, step = moved(true, np.concatenate([turn_rad, shift_m]))
        fit = fit_body_pose(believed, true.stereo["hazcam"], handed(believed, true, block, rng))
        off = fit.step - step
        taken = corrected_rig(believed, fit) if fit.significant else believed
        held_out = rng.integers(1 << 31)
        before, after = (errors_px(rig, true, np.random.default_rng(held_out)) for rig in (believed, taken))
        chi2 = float(off @ np.linalg.solve(fit.covariance, off))
        cases.append(RefinedCase(fit.significant, fit.seen, chi2, before, after))
    return cases


def blocks_of(true: Rig, options: argparse.Namespace) -> list[RefineBlock]:
    """The tasks, row by row."""
    return [
        RefineBlock(
            true, ranges_m, size, first, min(BLOCK, options.cases - first),
            options.handoffs, options.click_px, options.match_px, options.seed,
        )
        for _, ranges_m, size in ROWS
        for first in range(0, options.cases, BLOCK)
    ]  # fmt: skip


COLUMNS = {
    "targets": "{targets}", "moved": "{moved}", "significant": "{significant} of {of}",
    "directions": "{directions:.1f}", "chi2 of 6": "{chi2:.2f}",
    "before rms, worst px": "{before_px[0]:.2f}, {before_px[1]:.2f}",
    "after rms, worst px": "{after_px[0]:.2f}, {after_px[1]:.2f}",
}  # fmt: skip


def main() -> int:
    """Print the table."""
    parser = options(__doc__, 100, as_json=True)
    parser.add_argument("--rig", required=True, type=Path, help="the true rig")
    parser.add_argument("--handoffs", type=at_least(1), default=20, help="of each case")
    parser.add_argument("--click-px", type=positive_number, default=0.2)
    parser.add_argument("--match-px", type=not_negative, default=0.4, help="what a match is wrong by")
    args = parser.parse_args()
    true = load_rig(args.rig).rig
    if lacking := [pair for pair in ("navcam", "hazcam") if pair not in true.stereo]:
        parser.error(f"--rig {args.rig} has no stereo pair '{lacking[0]}'")
    blocks = blocks_of(true, args)
    found = results_of(args, "tens of cases", run_block, blocks, label)
    rows = []
    for name, ranges_m, size in ROWS:
        row = [
            case
            for block, cases in zip(blocks, found, strict=True)
            if (block.ranges_m, block.size) == (ranges_m, size)
            for case in cases
        ]
        before, after = (
            np.concatenate([getattr(one, key) for one in row]) for key in ("before_px", "after_px")
        )
        rows.append(
            {
                "targets": name,
                "moved": "yes" if size else "no",
                "significant": sum(case.significant for case in row),
                "of": args.cases,
                "directions": float(np.mean([case.seen for case in row])),
                "chi2": float(np.mean([case.chi2 for case in row])),
                "before_px": [rms(before), float(np.linalg.norm(before, axis=-1).max())],
                "after_px": [rms(after), float(np.linalg.norm(after, axis=-1).max())],
            }
        )
    show(args, rows, COLUMNS)
    return 0


def label(block: RefineBlock) -> str:
    """The description of a task."""
    targets = next(words for words, ranges_m, _ in ROWS if ranges_m == block.ranges_m)
    return f"{targets}, {'moved' if block.size else 'not moved'}, cases from {block.first}"


if __name__ == "__main__":
    end(main)
