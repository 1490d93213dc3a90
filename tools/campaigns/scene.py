"""Correct masts by still scenes and hold what is stated against the truth; leave right ones alone.

    .venv/bin/python -m tools.campaigns.scene --cases 40 --seed 1
    .venv/bin/python -m tools.campaigns.scene --cases 40 --seed 1 --right [--repeat-rad 0.001]
    .venv/bin/python -m tools.campaigns.scene --cases 5 --seed 1 --pictures

A scene, at the level of features: two eyes look all round at two tilts, 22 rests, features of 0.1 px on rough
ground; the head's rests err by ``--repeat-rad``, while ``--told-rad`` is what the fit is told. One thing is
wrong with the rig, by turns: an eye turned (2 mrad), an eye refocused (0.2 %), the tilt axis leaning (2
mrad), a pan encoder off its centre (2 mrad), or two of these. ``--right``: nothing is. ``--pictures``: the
same with rendered pictures of the packaged Navcams (nothing of `calib.scene` has a part in them), 20 of 10
rests.

Told are how often the 95 % interval holds the truth, of the corrected numbers and of pixels: points at 2, 5
and 15 m, near the middle and a corner of one rest's picture, are predicted for another rest's from where the
first one shows them, by rigs as believed and corrected; what the rests err by is no part of it. Behind ±
stands a pooled rate's standard error, from the scatter of whole scenes.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from calib.calibrate.scene.features import Feature, find_features
from calib.calibrate.scene.fit import SceneFit, fit_scene
from calib.calibrate.scene.terms import SceneView, corrected
from calib.errors import NoCorrection
from calib.files.mast_file import load_rig
from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Mast, Rig, RigCamera
from calib.geometry.rigid import FloatArray, Rigid
from drivers.sim.optics.readout import Noise
from drivers.sim.render import Renderer
from drivers.sim.scene import SceneSettings, build_scene
from mastctl.cli.output import positive_number
from tools.command import end, options, rms, run_cases

RIG = Path(__file__).resolve().parents[1] / "configs" / "sim" / "rocky8.yaml"
NAVCAMS = ("navcam_left", "navcam_right")

Rest = tuple[float, float]
TrueAngles = Callable[[int, Rest], Rest]
"""Where the joints truly stand, by the rest's number and what they read."""


def navcams() -> Rig:
    """The packaged rover's mast with its two Navcams alone."""
    rig = load_rig(RIG).rig
    cameras = {name: rig.cameras[name] for name in NAVCAMS}
    return Rig("navcams", rig.mast, cameras, {"navcam": NAVCAMS})


def rests(rows: int, columns: int, span_rad: float) -> list[Rest]:
    """Where the head looks: rows of tilts from -0.15 rad down, pans to either side, there and back again."""
    tilts = -0.15 - 0.3 * np.arange(rows)
    pans = np.linspace(-span_rad / 2, span_rad / 2, columns)
    return [
        (float(pan), float(tilt))
        for row, tilt in enumerate(tilts)
        for pan in (pans if row % 2 == 0 else pans[::-1])
    ]


def pictures(
    true: Rig,
    looked: list[Rest],
    angles: TrueAngles,
    seed: int,
    noise_dn: float = 1.5,
    moved: Callable[[int], Rigid] = lambda _: Rigid.identity(),
) -> Iterator[SceneView]:
    """Yield what the head cameras of a true rig see, with the angles that the joints read.

    ``moved`` says where the rover stands at a rest, in its first place's frame.
    """
    renderer = _renderer(seed)
    for pose, rest in enumerate(looked):
        site_from_head = moved(pose) @ true.mast.rover_from_head(*angles(pose, rest))
        for name, camera in true.cameras.items():
            light = renderer.image(camera.model, site_from_head, 2)
            noise = Noise(noise_dn, noise_dn, seed, name)
            image: FloatArray = noise.levels(light, noise.sigma_dn(light), pose).astype(np.float32)
            yield SceneView(f"{name} {pose}", name, image, *rest, pose)


@cache
def _renderer(seed: int) -> Renderer:
    return Renderer(build_scene(SceneSettings(seed=seed)), workers=1)


Z = 1.959964
SIZE, FOCAL_PX, NOISE_PX = (1024, 768), 1280.0, 0.1
MAST_M = np.array([0.2, 0.0, -1.1])
POINTS = 400
FROM_TO = (((0.0, -0.2), (0.3, -0.35)), ((-1.2, -0.4), (-0.9, -0.2)))
"""Rests of which one's picture foretells the other's."""
PLACES, RANGES_M = ((0.4, 0.55), (0.75, 0.3)), (2.0, 5.0, 15.0)
LEAST_PX = 1e-6
KINDS = ("turn", "focus", "lean", "encoder", "turn+encoder", "focus+lean")


class SceneTask(NamedTuple):
    """One scene: its seed, what is wrong, what rests err by and what is told of that, whether it is drawn."""

    seed: int
    kind: str
    repeat_rad: float
    told_rad: float
    drawn: bool


class SceneScore(NamedTuple):
    """What a scene told: terms; errors over sigmas of numbers and of pixels; rms pixels before and after."""

    kind: str
    taken: tuple[str, ...]
    numbers: dict[str, float]
    pixels: FloatArray
    before_px: float
    after_px: float
    joint_sigma_rad: float
    scale: float
    seconds: float


def eyes() -> Rig:
    """Two ideal eyes, 0.2 m apart, on an upright mast."""
    cx, cy = (SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2
    cameras = {
        f"eye_{side}": RigCamera(
            "head",
            CameraModel("CAHV", SIZE, [0.06, y, -0.08], [1, 0, 0], [cx, FOCAL_PX, 0], [cy, 0, FOCAL_PX]),
        )
        for side, y in (("left", -0.1), ("right", 0.1))
    }
    return Rig("eyes", Mast(MAST_M, np.zeros(3)), cameras, {"eye": ("eye_left", "eye_right")})


def wrong(kind: str, camera: str, rng: np.random.Generator) -> dict[str, float]:
    """What is wrong with the rig: numbers by name."""
    found: dict[str, float] = {}
    for part in kind.split("+"):
        if part == "turn":
            found |= {
                f"cameras.{camera}.turn.{axis}": v
                for axis, v in zip("xyz", rng.normal(0, 2e-3, 3), strict=True)
            }
        elif part == "focus":
            found[f"cameras.{camera}.scale"] = rng.normal(0, 2e-3)
        elif part == "lean":
            found["mast.axis_twist_rad"] = rng.normal(0, 2e-3)
        elif part == "encoder":
            phase = rng.uniform(0, 2 * np.pi)
            found |= {"joints.pan.c1": 2e-3 * np.cos(phase), "joints.pan.s1": 2e-3 * np.sin(phase)}
    return found


def features_of(
    true: Rig, looked: list[tuple[float, float]], errs: FloatArray, rng: np.random.Generator
) -> tuple[list[SceneView], list[Feature]]:
    """Features on rough ground where a true rig shows them, six sights at most each."""
    nothing = np.zeros((2, 2), np.float32)
    views = [
        SceneView(f"{name} {pose}", name, nothing, *rest, pose)
        for pose, rest in enumerate(looked)
        for name in true.cameras
    ]
    bearing, far = rng.uniform(-np.pi, np.pi, POINTS), rng.uniform(1.8, 15.0, POINTS)
    points = np.stack([far * np.cos(bearing), far * np.sin(bearing), rng.normal(0, 0.15, POINTS)], axis=1)
    shown = []
    for view in views:
        at = np.array(true.joints.true_rad((view.pan_rad, view.tilt_rad))) + errs[view.pose]
        pixels, valid = true.camera_in_rover(view.camera, *at).project(points)
        inside = valid & (np.abs(pixels - np.array([511.5, 383.5])) < [490, 365]).all(axis=1)
        shown.append(np.where(inside[:, None], pixels, np.nan))
    features = []
    for point in range(POINTS):
        seen = [number for number, pixels in enumerate(shown) if np.isfinite(pixels[point]).all()][:6]
        if len(seen) > 1:
            pixels = np.array([shown[number][point] for number in seen])
            pixels[1:] += rng.normal(0, NOISE_PX, pixels[1:].shape)
            sigma = [0.02] + [NOISE_PX] * (len(seen) - 1)
            features.append(Feature(tuple(seen), pixels, np.array([s**2 * np.eye(2) for s in sigma])))
    return views, features


def score(task: SceneTask) -> SceneScore | str:
    """Return how far one scene's correction is from the truth, or why there is none."""
    rng = np.random.default_rng([task.seed, 3])
    believed = navcams() if task.drawn else eyes()
    names = wrong(task.kind, sorted(believed.cameras)[0], rng)
    true = corrected(believed, list(names), np.array(list(names.values())))
    looked = rests(2, 5, 2.4) if task.drawn else rests(2, 11, 2 * np.pi * 10 / 11)
    errs = rng.normal(0, task.repeat_rad, (len(looked), 2))
    if task.drawn:

        def stands(pose: int, rest: tuple[float, float]) -> tuple[float, float]:
            pan, tilt = np.array(true.joints.true_rad(rest)) + errs[pose]
            return float(pan), float(tilt)

        views = list(pictures(true, looked, stands, task.seed))
        features = find_features(believed, views)
    else:
        views, features = features_of(true, looked, errs, rng)
    began = time.process_time()
    try:
        fit = fit_scene(believed, views, features, task.told_rad)
    except NoCorrection as why:
        return f"seed {task.seed}, {task.kind or 'right'}: {why.code}: {why}"
    seconds = time.process_time() - began
    if not fit.predicted_px[1] < fit.predicted_px[0]:
        return f"seed {task.seed}, {task.kind or 'right'}: not_predictive: {', '.join(fit.taken)}"
    sigma = np.sqrt(np.diag(fit.covariance))
    off = {n: (v - names.get(n, 0.0)) / s for n, v, s in zip(fit.names, fit.values, sigma, strict=True)}
    before, after, spread = foretold(believed, true, fit)
    moved = spread > LEAST_PX  # what goes by an eye that was not corrected is as it was
    pixels = after[moved] / spread[moved]
    return SceneScore(
        task.kind, fit.taken, off, pixels, rms(before), rms(after), fit.joint_sigma_rad, fit.scale, seconds
    )


def foretold(believed: Rig, true: Rig, fit: SceneFit) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Errors (n,) of one rest's picture foretold for another's, before, after, and stated sigmas; pixels."""
    bit = 1e-5
    moved = [corrected(believed, fit.names, fit.values + bit * one) for one in np.eye(len(fit.names))]
    rigs = [believed, fit.rig, *moved]
    errors: list[list[FloatArray]] = [[] for _ in rigs]
    for begin, goal in FROM_TO:
        for name, camera in true.cameras.items():
            pixels = np.array(PLACES) * camera.model.size_px
            for other in true.cameras:
                truth = carried(true, name, other, begin, goal, pixels)
                for held, rig in zip(errors, rigs, strict=True):
                    held.append((carried(rig, name, other, begin, goal, pixels) - truth).ravel())
    before, after, *rates = (np.concatenate(held) for held in errors)
    by_number = (np.array(rates) - after) / bit
    return before, after, np.sqrt(np.einsum("in,ij,jn->n", by_number, fit.covariance, by_number))


def carried(
    rig: Rig, name: str, other: str, begin: tuple[float, float], goal: tuple[float, float], pixels: FloatArray
) -> FloatArray:
    """Where points that one camera shows at one rest are seen by another at another rest, by a rig."""
    rays = rig.camera_in_rover(name, *rig.joints.true_rad(begin)).ray(pixels)
    points = rays.origins_m + np.array(RANGES_M)[:, None, None] * rays.directions
    return rig.camera_in_rover(other, *rig.joints.true_rad(goal)).project(points.reshape(-1, 3))[0]


def main() -> int:
    """Print the tables."""
    parser = options(__doc__, 24, "scenes")
    parser.add_argument("--right", action="store_true", help="nothing is wrong with the rigs")
    parser.add_argument("--pictures", action="store_true", help="rendered pictures instead of features")
    parser.add_argument("--repeat-rad", type=positive_number, default=1e-4)
    parser.add_argument("--told-rad", type=positive_number, default=2e-4)
    args = parser.parse_args()
    tasks = [
        SceneTask(
            seed, "" if args.right else KINDS[seed % len(KINDS)], args.repeat_rad, args.told_rad,
            args.pictures,
        )
        for seed in range(args.seed, args.seed + args.cases)
    ]  # fmt: skip
    found = run_cases(args, "scenes", score, tasks, lambda task: f"seed {task.seed}")
    scores = [one for one in found if isinstance(one, SceneScore)]
    if scores:
        report(scores)
    refused = [one for one in found if isinstance(one, str)]
    codes = Counter(one.split(": ")[1] for one in refused)
    print(f"{len(found)} scenes: {len(scores)} corrected, {dict(codes)}")
    print("\n".join(one for one in refused if args.right is (": not_significant: " not in one)))
    return 0


def report(scores: list[SceneScore]) -> None:
    """Print the tables."""
    for kind in sorted({one.kind for one in scores}):
        mine = [one for one in scores if one.kind == kind]
        terms = Counter(words for one in mine for words in one.taken)
        told = ", ".join(f"{words} {count}" for words, count in terms.most_common())
        before, after = (
            np.median([getattr(one, f"{when}_px") for one in mine]) for when in ("before", "after")
        )
        print(f"{kind or 'right'}: {len(mine)} corrected, {before:.2f} px become {after:.2f} px; {told}")
    by_scene = [np.abs(np.array(list(one.numbers.values()))) < Z for one in scores]
    print(f"95 % intervals of the numbers hold the truth: {_rate(by_scene)}")
    names = Counter(name for one in scores for name in one.numbers)
    for name, count in sorted(names.items()):
        off = np.array([one.numbers[name] for one in scores if name in one.numbers])
        held = 100 * np.mean(np.abs(off) < Z)
        print(f"  {name}: {held:.0f} % of {count}, rms {rms(off):.2f} sigma")
    print(f"95 % intervals of the pixels: {_rate([np.abs(one.pixels) < Z for one in scores])}")
    worst = max(scores, key=lambda one: rms(one.pixels))
    print(f"  worst scene: {rms(worst.pixels):.1f} sigma rms, {worst.kind}: {', '.join(worst.taken)}")
    spread = 1e3 * float(np.median([one.joint_sigma_rad for one in scores]))
    print(f"joints repeat to {spread:.2f} mrad, fit {np.mean([one.seconds for one in scores]):.1f} s")


def _rate(by_scene: list[np.ndarray]) -> str:
    """Part that holds, per cent, and its standard error by whole scenes."""
    rates = 100 * np.array([np.mean(held) for held in by_scene])
    pooled = 100 * np.mean(np.concatenate(by_scene))
    return f"{pooled:.1f} ± {rates.std(ddof=1) / np.sqrt(len(rates)) if len(rates) > 1 else np.nan:.1f} %"


if __name__ == "__main__":
    end(main)
