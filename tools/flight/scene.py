"""What Opportunity's five Navcam frames tell of its mast: what is common to them, what is each frame's own.

    .venv/bin/python -m tools.flight.scene ../shared/data/mer_navcam

Five frames of one rover pose; three pairs overlap. Features by `calib.calibrate.scene.features`; what is told
is what no place of a feature explains, pixels. First all pairs together: as the labels have it, with each
rest's own two angles free, with the mast's numbers free, with both. Then each pair predicted by a correction
that the two others alone make (`calib.calibrate.scene.fit`, its own rule for which terms enter), its own
rests as read, for joints that are told to repeat to so much. Beside it what is to be expected of a left-out
pair: from its rests' scatter alone, were the correction exact, and from the correction's own sigmas too.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calib.calibrate.scene.features import Feature, find_features
from calib.calibrate.scene.fit import SceneFit, fit_scene, white_px
from calib.calibrate.scene.problem import SceneProblem
from calib.calibrate.scene.terms import SceneView, terms_of
from calib.errors import NoCorrection
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.warp import grey
from drivers.recordings.frames import read_products
from tools.command import end, options
from tools.flight import mer

TOLD_RAD = (5e-5, 2e-4, 1.3e-3)
"""What joints may repeat to: as labels print them; what is taken if nothing is told; as flown."""

LOOSE_RAD = 0.005
DRAWS = 200


def main() -> int:
    """Fit, predict, print."""
    parser = options(__doc__, seed=None, tasks=False)
    parser.add_argument("folder", type=Path)
    args = parser.parse_args()
    products = mer.labels(args.folder)
    rig = mer.rig(mer.fit(products), products)
    pointings = read_products(sorted(args.folder.glob(mer.PRODUCTS)), mer.CAMERA)
    views = [
        SceneView(
            f"frame {at + 1}", mer.CAMERA, grey(one.frames[mer.CAMERA].image()), one.pan_rad, one.tilt_rad, at
        )
        for at, one in enumerate(pointings)
    ]
    features = find_features(rig, views)
    print(f"{len(features)} features, rms and median px of what no place explains")
    for words, rests, terms in (
        ("as the labels have it", False, False),
        ("each rest's own pan and tilt free", True, False),
        ("the mast's and the camera's numbers free", False, True),
        ("both free", True, True),
    ):
        left = left_with(rig, views, features, rests, terms)
        print(f"  {words}: {np.sqrt(np.mean(left**2)):.2f}, {np.median(left):.2f}")
    for told in TOLD_RAD:
        print(f"joints told to repeat to {1e3 * told:g} mrad")
        for pair in sorted({feature.views for feature in features}):
            predict(rig, views, features, pair, told)
    return 0


def left_with(
    rig: Rig, views: list[SceneView], features: list[Feature], rests: bool, terms: bool
) -> FloatArray:
    """What no place explains, px, where the rests' angles, the rig's numbers or both take what they like."""
    names = tuple(name for term in terms_of(rig, views) for name in term.names) if terms else ()
    problem = SceneProblem(rig, views, features, names, LOOSE_RAD if rests else 1e-9)
    problem.free[:] = True
    state = problem.solved(problem.start())
    return np.abs(problem.rest(state.numbers, state.places)[0]) * white_px(features)


def predict(
    rig: Rig, views: list[SceneView], features: list[Feature], pair: tuple[int, ...], told_rad: float
) -> None:
    """Print how a pair is predicted by the others."""
    mine = [feature for feature in features if feature.views == pair]
    others = [feature for feature in features if feature.views != pair]
    begin = f"  frames {pair[0] + 1} and {pair[1] + 1}, {len(mine)} features"
    try:
        fit = fit_scene(rig, views, others, told_rad)
    except NoCorrection as why:
        print(f"{begin}: {why}")
        return
    problem = SceneProblem(rig, views, mine, fit.names, told_rad)
    places = problem.start().places
    rng = np.random.default_rng(1)

    def left(terms: FloatArray, rests: FloatArray) -> FloatArray:
        return problem.rest(np.concatenate([terms, rests]), places)[0] * white_px(features)

    still, scatter = np.zeros(2 * problem.rests), fit.joint_sigma_rad
    after = left(fit.values, still)
    alone, whole = [], []
    for _ in range(DRAWS):
        rests = rng.normal(0.0, scatter, 2 * problem.rests)
        terms = rng.multivariate_normal(fit.values, fit.covariance)
        alone.append(np.median(np.abs(left(fit.values, rests) - after)))
        whole.append(np.median(np.abs(left(terms, rests) - after)))
    before = np.median(np.abs(left(np.zeros(len(fit.names)), still)))
    expected = (
        f"{np.mean(alone):.2f} from rests alone ({1e3 * scatter:.2f} mrad), {np.mean(whole):.2f} in all"
    )
    print(
        f"{begin}: {before:.2f} px become {np.median(np.abs(after)):.2f}; expected {expected}; {_told(fit)}"
    )


def _told(fit: SceneFit) -> str:
    """The correction's numbers with their sigmas."""
    sigma = np.sqrt(np.diag(fit.covariance))
    return ", ".join(
        f"{name.removeprefix('cameras.' + mer.CAMERA + '.')} {1e3 * value:+.1f} ± {1e3 * one:.1f}"
        for name, value, one in zip(fit.names, fit.values, sigma, strict=True)
    )


if __name__ == "__main__":
    end(main)
