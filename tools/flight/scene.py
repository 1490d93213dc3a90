"""Correct Opportunity's mast by some pairs of its Navcam frames, and predict another pair.

    .venv/bin/python -m tools.flight.scene ../shared/data/mer_navcam [--joint-sigma-rad RAD]

Five frames of one rover pose; three pairs overlap. Features by `calib.scene.features`; what is told is what
no place of a feature explains, median in pixels: as the labels have it; corrected by all pairs together; and
each pair predicted by a correction that was made by the two others alone, its own rests as read.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from calib.errors import NoCorrection
from calib.pictures.warp import grey
from calib.scene.features import find_features
from calib.scene.fit import JOINT_SIGMA_RAD, fit_scene, left_px
from calib.scene.views import View
from drivers.recording import read_products
from mastctl.cli.output import positive_number
from tools.arguments import end
from tools.flight import mer


def main() -> int:
    """Fit, predict, print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--joint-sigma-rad", type=positive_number, default=JOINT_SIGMA_RAD)
    args = parser.parse_args()
    products = mer.labels(args.folder)
    rig = mer.rig(mer.fit(products), products)
    pointings = read_products(sorted(args.folder.glob(mer.PRODUCTS)), mer.CAMERA)
    views = [
        View(
            f"frame {at + 1}", mer.CAMERA, grey(one.frames[mer.CAMERA].image()), one.pan_rad, one.tilt_rad, at
        )
        for at, one in enumerate(pointings)
    ]
    features = find_features(rig, views)
    pairs = sorted({feature.views for feature in features})
    fit = fit_scene(rig, views, features, args.joint_sigma_rad)
    print(
        f"{len(features)} features, joints repeat to {1e3 * args.joint_sigma_rad:g} mrad, "
        f"corrected: {', '.join(fit.taken)}"
    )
    print(f"all pairs together: {fit.median_px[0]:.2f} px become {fit.median_px[1]:.2f} px in the median")
    for pair in pairs:
        mine = [feature for feature in features if feature.views == pair]
        others = [feature for feature in features if feature.views != pair]
        before = left_px(rig, views, mine)
        try:
            told = fit_scene(rig, views, others, args.joint_sigma_rad)
            after = left_px(told.rig, views, mine)
            words = f"{np.median(after):.2f} px predicted by the others ({', '.join(told.taken)})"
        except NoCorrection as why:
            words = str(why)
        print(
            f"frames {pair[0] + 1} and {pair[1] + 1}: {len(mine)} features, "
            f"{np.median(before):.2f} px, {words}"
        )
    return 0


if __name__ == "__main__":
    end(main)
