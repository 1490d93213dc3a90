"""Provoke bad hand-offs and count which of the wrong ones the refinement's verdicts catch.

    .venv/bin/python -m tools.campaigns.handoff --cases 100 --seed 1

Five kinds, and good ones beside them: bricks before the target in the next camera's picture; ground nearly
without contrast; a pattern that repeats; shadows that moved between the two pictures; a wrong range,
because the second click or the second picture belongs to another place. In two of three looks the
destination pair's calibration is off by 3 px, so that the search window is large. The truth is the exact
projection by the true rig. The verdicts judge what correlation answers without them: the source's patch
warped through its range, its best place in the window. A case is wrong if that is more than 4 px off in
either camera, and flagged if no such camera is accepted; an accepted pixel is judged by itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.errors import NoHandoff, NoStereoPoint
from calib.files.mast_file import load_rig
from calib.geometry import pointing
from calib.geometry.covariance import RigCovariance, moved_rig, stored_covariance
from calib.geometry.handoff import Joints, PredictedPixel, hand_off
from calib.geometry.pointing import choose
from calib.geometry.rig import Rig
from calib.matching.handoff import RefinedPixel, RefineSettings, refine_handoff
from calib.matching.partner import find_partner
from calib.matching.patch import MatchSettings
from calib.matching.warp import Plane, PosedImage, warp_patch
from drivers.sim import kernels
from drivers.sim import scene as site
from drivers.sim.placed import SceneSettings
from drivers.sim.rocks import make_brick, meshes, together
from drivers.sim.scene import Scene, build_scene, sun_direction
from mastctl.cli.options import at_least
from mastctl.experiment.targets import BORDER_PX, texture_mask
from mastctl.packaged import config_folder
from tools.command import end, options, results_of, rms, show
from tools.studies.approach_world import ApproachWorld, WorldErrors

Float64 = NDArray[np.float64]

KINDS = ("shadow", "repeated", "range", "occluded", "flat")
STEPS = (("navcam", "hazcam", 2.0, 0.35), ("pancam", "navcam", 6.0, 0.9))
"""From, to, distance in metres, azimuth to either side."""

OFF_PX = 3.0
"""What the destination pair's calibration is off by in two of three looks, one sigma each axis."""

WRONG_PX, RIGHT_PX, WANTED = 4.0, 1.0, 0.9
CLICK_PX, PER_VIEW, APART_PX, EDGE_PX = 0.2, 5, 45.0, 25.0
TRIED, RANGE_SLACK, BEFORE_M = 3000, 0.25, 0.02
EDGE_M = 0.04  # a shadow's edge is nearer to the target than this
BLOCK, HALF_PX, PAD, JOINT_SIGMA_RAD = 20, 20, 120, 3e-5

scene_of = cache(build_scene)

ANYTHING = MatchSettings(
    flat_sigma_px=math.inf, least_correlation=-9.0, least_lead=-9.0, worst_ratio=math.inf,
    worst_sigma_px=math.inf,
)  # fmt: skip
"""No thresholds: for a surface where the stereo pair would be refused."""


@dataclass(frozen=True, eq=False)
class ProvokedView:
    """What one look is made of: scenes of the source's and the destination's pictures, and what is wrong."""

    source: Scene
    destination: Scene
    sigma_px: float = CLICK_PX
    second_click_px: float = 0.0
    second_camera_rad: float = 0.0


@dataclass(frozen=True)
class HandoffOutcome:
    """One destination camera: its verdict, and by how many px the refined pixel and correlation's are off."""

    verdict: str
    refined_px: float
    correlated_px: float

    @property
    def answer_px(self) -> float:
        """What the answer is off by: the accepted pixel, else what correlation alone would have answered."""
        return self.refined_px if self.verdict == "accepted" else self.correlated_px


class Stage:
    """The rover before scenes that provoke; cases of a kind have a draw of their own from ``first`` on."""

    def __init__(self, true: Rig, believed: Rig, seed: int, kind: str, first: int) -> None:
        self.kind, self.usual = kind, SceneSettings(seed=seed)
        self.rng = np.random.default_rng([seed, *kind.encode(), *([first] if first else [])])
        self.believed = believed
        self.calibration = stored_covariance(believed) or RigCovariance((), np.zeros((0, 0)))
        self.world = ApproachWorld(scene_of(self.usual), true, believed, WorldErrors(), self.rng)

    def cases(self, count: int) -> Iterator[list[HandoffOutcome]]:
        """Yield the outcomes in both cameras of ``count`` hand-offs, by turns of either step."""
        done, look = 0, 0
        while done < count:
            off_px = 0.0 if look % 3 == 2 else OFF_PX
            for outcomes in self.look(off_px, *STEPS[look % len(STEPS)]):
                yield outcomes
                done += 1
                if done == count:
                    return
            look += 1

    def look(
        self, off_px: float, source: str, to: str, distance_m: float, azimuth_rad: float
    ) -> Iterator[list[HandoffOutcome]]:
        """One look from a new place: up to ``PER_VIEW`` targets."""
        rng, world = self.rng, self.world
        azimuth = rng.uniform(-azimuth_rad, azimuth_rad)
        view = self.view(distance_m, azimuth)
        pair, next_pair = world.true.stereo[source], world.true.stereo[to]
        world.believed, calibration = self.mast_file(next_pair, off_px)
        world.relight(view.source)
        pan, tilt = self.angles(pair[0], distance_m, azimuth)
        cameras = world.look(pair, pan, tilt)
        if view.second_camera_rad:
            late = world.look((pair[1],), pan + view.second_camera_rad, tilt)[pair[1]]
            cameras[pair[1]] = replace(late, camera=cameras[pair[1]].camera)
        world.relight(view.destination)
        destinations = world.look(next_pair, pan, tilt)
        at = dict.fromkeys((pair[0], *next_pair), (pan, tilt))
        at[pair[1]] = (pan + view.second_camera_rad, tilt)
        taken: list[Float64] = []
        for point in self.candidates(view, pair[0], (pan, tilt), cameras[pair[0]].image, distance_m):
            exact = {name: world.true_pixel(name, *at[name], point) for name in at}
            shown = [self.shows(view.destination, name, at[name], point) for name in next_pair]
            if (
                not _inside(exact[pair[1]], cameras[pair[1]].image, BORDER_PX)
                or any(np.linalg.norm(exact[pair[0]] - other) < APART_PX for other in taken)
                or not self.shows(view.source, pair[1], at[pair[1]], point)
                or not all(_inside(exact[name], destinations[name].image, EDGE_PX) for name in next_pair)
                or all(shown) == (self.kind == "occluded")
            ):
                continue
            taken.append(exact[pair[0]])
            clicks = np.array([exact[name] for name in pair]) + rng.normal(0.0, view.sigma_px, (2, 2))
            clicks[1, 0] += view.second_click_px * rng.choice([-1.0, 1.0])
            sources = (cameras[pair[0]], cameras[pair[1]])
            joints = Joints(pan, tilt, JOINT_SIGMA_RAD)
            true = {name: exact[name] for name in next_pair}
            try:
                done = hand_off(
                    world.believed, pair, next_pair, joints, *clicks,
                    to_joints=joints, sigma_px=view.sigma_px, calibration=calibration,
                )  # fmt: skip
            except (NoHandoff, NoStereoPoint):
                yield [HandoffOutcome("refused", math.inf, math.inf) for _ in next_pair]
            else:
                refined = refine_handoff(done, sources, clicks, destinations)
                plane = _surface(sources, clicks, done.seen.position_m)
                yield [
                    _outcome(refined[name], done.pixels[name], true[name], sources[0], clicks[0], plane, one)
                    for name, one in destinations.items()
                ]
            if len(taken) == PER_VIEW:
                return

    def mast_file(self, pair: tuple[str, str], off_px: float) -> tuple[Rig, RigCovariance]:
        """The packaged mast file; or one whose pair is off in x and y together, and which knows how far."""
        known, moved = self.calibration, self.believed
        if not off_px:
            return moved, known
        parts = [f"cameras.{name}.{letter}.{axis}" for name in pair for letter in "HV" for axis in "xyz"]
        names = known.names + tuple(name for name in parts if name not in known.names)
        covariance = np.zeros((len(names), len(names)))
        covariance[: len(known.names), : len(known.names)] = known.covariance
        for letter in "HV":
            # A camera whose H (V) is off by A sees everything a pixel to the right (lower).
            step = np.zeros(len(names))
            for name in pair:
                for k, axis in enumerate("xyz"):
                    step[names.index(f"cameras.{name}.{letter}.{axis}")] = moved.cameras[name].model.A[k]
            covariance += off_px**2 * np.outer(step, step)
            moved = moved_rig(moved, names, float(self.rng.normal(0.0, off_px)) * step)
        return moved, RigCovariance(names, covariance)

    def angles(self, camera: str, distance_m: float, azimuth: float) -> tuple[float, float]:
        """Joint angles that look at level ground at the distance."""
        believed = self.world.believed
        head = believed.mast.rover_from_head(0.0, 0.0).translation_m
        along = math.sqrt(distance_m**2 - float(head[2]) ** 2)
        aim = np.array([head[0] + along * math.cos(azimuth), head[1] + along * math.sin(azimuth), 0.0])
        solutions = pointing.solve(believed.mast, believed.cameras[camera].model, aim)
        chosen = choose(solutions, (-2.6, 2.6), (-1.2, 0.5))
        return chosen.pan_rad, chosen.tilt_rad

    def candidates(
        self, view: ProvokedView, camera: str, at: tuple[float, float], image: Any, distance_m: float
    ) -> Float64:
        """Points (n, 3) of the site that the picture shows about the distance, in random order."""
        usable = texture_mask(image.astype(np.uint8))
        if self.kind in ("flat", "shadow"):
            usable[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
        rows, columns = np.nonzero(usable)
        if len(rows) == 0:
            return np.empty((0, 3))
        pick = self.rng.integers(len(rows), size=TRIED)
        pixels = np.column_stack([columns[pick], rows[pick]]).astype(float)
        rays = self.world.true_camera(camera, *at).ray(pixels)
        origins = self.world.site_from_rover.points(rays.origins_m)
        along = self.world.site_from_rover.vectors(rays.directions)
        ranges = view.source.cast(origins, along)
        points = origins + ranges[:, None] * along
        keep = np.abs(ranges - distance_m) < RANGE_SLACK * distance_m
        if self.kind == "shadow":
            keep &= _at_shadow_edge(view.source, points)
        return np.asarray(points[keep])

    def shows(self, scene: Scene, camera: str, at: tuple[float, float], point: Float64) -> bool:
        """Whether a camera sees a point of the site in a scene, by casting its ray at it."""
        ray = self.world.true_camera(camera, *at).ray(self.world.true_pixel(camera, *at, point))
        if not bool(ray.valid):
            return False
        origin = self.world.site_from_rover.points(ray.origins_m)
        met = scene.cast(origin, self.world.site_from_rover.vectors(ray.directions))
        return bool(float(met) > float(np.linalg.norm(point - origin)) - BEFORE_M)

    def view(self, distance_m: float, azimuth: float) -> ProvokedView:
        """The scenes of one look."""
        rng, scene = self.rng, scene_of(self.usual)
        if self.kind == "occluded":
            hidden = with_bricks(scene, distance_m, azimuth, rng)
            return ProvokedView(hidden if rng.random() < 0.5 and distance_m < 4.0 else scene, hidden)
        if self.kind == "flat":
            scene = faded(scene, float(np.exp(rng.uniform(*np.log((0.005, 0.2))))))
        elif self.kind == "repeated":
            count, natural = int(rng.choice((64, 128))), float(rng.choice([0.0, 0.1, 0.2]))
            scene = repeated(scene, count, natural, rng)
            return ProvokedView(scene, scene, sigma_px=float(rng.choice([CLICK_PX, 1.0])))
        elif self.kind == "shadow":
            low = self.usual.model_copy(update={"rocks": 300, "bricks": 12, "sun_elevation_rad": 0.45})
            by = float(rng.uniform(0.15, 0.7) * rng.choice([-1.0, 1.0]))
            contrast = float(rng.choice([1.0, 0.3, 0.1]))
            suns = (low, low.model_copy(update={"sun_azimuth_rad": low.sun_azimuth_rad + by}))
            before, after = (faded(scene_of(one), contrast, broad=False) for one in suns)
            return ProvokedView(before, after)
        elif self.kind == "range":
            if rng.random() < 0.5:
                return ProvokedView(scene, scene, second_click_px=float(rng.uniform(3.0, 30.0)))
            turn = float(rng.uniform(0.002, 0.02) * rng.choice([-1.0, 1.0]))
            return ProvokedView(scene, scene, second_camera_rad=turn)
        return ProvokedView(scene, scene)


def _outcome(
    one: RefinedPixel,
    predicted: PredictedPixel | None,
    true: Float64,
    source: PosedImage,
    click: Float64,
    plane: Plane,
    to: PosedImage,
) -> HandoffOutcome:
    if predicted is None:
        return HandoffOutcome(one.verdict, math.inf, math.inf)
    best = correlated(source, click, plane, predicted, to)
    refined_px, best_px = (float(np.linalg.norm(pixel - true)) for pixel in (one.pixel_px, best))
    return HandoffOutcome(one.verdict, refined_px, best_px)


def _surface(source: tuple[PosedImage, PosedImage], clicks: Float64, seen_m: Float64) -> Plane:
    """What the source pair sees, without thresholds; level ground at the clicks' point where it sees none."""
    left, right = source
    found = find_partner(left, clicks[0], right, settings=ANYTHING)
    return found.plane or Plane(seen_m, np.array([0.0, 0.0, -1.0]))


def correlated(
    source: PosedImage, click: Float64, plane: Plane, predicted: PredictedPixel, to: PosedImage
) -> Float64:
    """Return where the warped patch correlates best in the window; the geometric pixel if there is none."""
    settings = RefineSettings()
    reach = settings.sigmas * math.sqrt(float(np.linalg.eigvalsh(predicted.search_px2)[-1]))
    reach = math.ceil(min(max(reach, settings.least_px), settings.most_px))
    template = warp_patch(source, click, plane, to.camera, HALF_PX)
    if template is None:
        return predicted.pixel_px
    low = np.rint(predicted.pixel_px).astype(int) - reach - HALF_PX
    padded = cv2.copyMakeBorder(to.image, PAD, PAD, PAD, PAD, cv2.BORDER_REFLECT)
    x, y = np.clip(low + PAD, 0, np.array(padded.shape[::-1]) - 2 * (reach + HALF_PX) - 1)
    side = 2 * (reach + HALF_PX) + 1
    scores = cv2.matchTemplate(padded[y : y + side, x : x + side], template.values, cv2.TM_CCOEFF_NORMED)
    v, u = np.unravel_index(int(np.argmax(scores)), scores.shape)
    return np.array([x + u, y + v]) - PAD + HALF_PX + template.target_px - template.centre_px


def _inside(pixel_px: Float64, image: Any, edge: float) -> bool:
    """Whether a pixel is well inside a picture; no pixel is not."""
    most = np.array(image.shape[::-1]) - 1 - edge
    return bool((pixel_px > edge).all() and (pixel_px < most).all())


def _at_shadow_edge(scene: Scene, points_m: Float64) -> NDArray[np.bool_]:
    """Whether points (n, 3) are open ground at a shadow's edge: some neighbours see the sun, some do not."""
    around = EDGE_M * np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]])
    above = points_m[:, None] + around + [0.0, 0.0, -0.012]
    lit = np.isnan(scene.cast(above, sun_direction(scene.settings)))
    # Beside a stone a neighbour is in it, and meets its inside.
    wide = points_m[:, None] + 2.0 * around + [0.0, 0.0, -0.012]
    is_open = np.isnan(scene.cast(wide, [0.0, 0.0, -1.0])).all(axis=1)
    on_ground = np.array([abs(p[2] - scene.ground_z_m(p[0], p[1])) < 1e-3 for p in points_m], dtype=bool)
    return np.asarray(lit.any(axis=1) & ~lit.all(axis=1) & is_open & on_ground)


def with_bricks(scene: Scene, distance_m: float, azimuth: float, rng: np.random.Generator) -> Scene:
    """Return the scene with a row of bricks before the distance that throw no shadow."""
    away = math.sqrt(distance_m**2 - 1.45**2) - (0.25 if distance_m < 4 else 0.45)
    row = []
    for across in (-0.48, 0.0, 0.48):
        x = 0.4 + away * math.cos(azimuth) - across * math.sin(azimuth)
        y = away * math.sin(azimuth) + across * math.cos(azimuth)
        turn = azimuth + math.pi / 2 + float(rng.uniform(-0.3, 0.3))
        row.append(make_brick(x, y, turn, scene.ground_z_m))
    stones = together(scene.world.rocks, meshes(row))
    return Scene(scene.settings, scene.world._replace(rocks=stones))


def faded(scene: Scene, contrast: float, broad: bool = True) -> Scene:
    """Return the scene with its ground's contrast multiplied; ``broad`` also that of soil and shadows."""
    world = scene.world

    def less(picture: Any) -> Any:
        one = kernels.ONE
        texels = np.rint(one + contrast * (picture.texels.astype(np.float32) - one))
        return picture._replace(texels=texels.astype(np.uint16))

    changed = world._replace(detail=less(world.detail), broad=less(world.broad) if broad else world.broad)
    return Scene(scene.settings, changed)


def repeated(scene: Scene, count: int, natural: float, rng: np.random.Generator) -> Scene:
    """Return the scene with ground that repeats ``count`` times a texture's side, and some natural gravel."""
    side = site.DETAIL_TEXELS
    tile = 1.0 + 0.25 * site.fractal(side // count, rng, 0.8, 3.0, side / count)
    pebbles = site.gravel(rng, sun_direction(scene.settings), side) if natural else np.ones((side, side))
    tones = np.clip(np.tile(tile, (count, count)) * (1.0 + natural * (pebbles - 1.0)), 0.1, 1.9)
    detail = site.pyramid(tones.astype(np.float32), site.DETAIL_TEXEL_M)
    plain = faded(scene, 0.1)
    return Scene(scene.settings, plain.world._replace(detail=detail))


@dataclass(frozen=True, eq=False)
class HandoffBlock:
    """Cases of one kind from ``first`` on, up to ``BLOCK``, with a draw of their own."""

    true: Rig
    believed: Rig
    seed: int
    kind: str
    first: int
    count: int


def run_block(block: HandoffBlock) -> list[list[HandoffOutcome]]:
    """Hand over the cases of a block: outcomes in each camera."""
    stage = Stage(block.true, block.believed, block.seed, block.kind, block.first)
    try:
        return list(stage.cases(block.count))
    finally:
        stage.world.close()


def summary(kind: str, cases: Sequence[Sequence[HandoffOutcome]]) -> dict[str, Any]:
    """Count cases: wrong if a camera's answer is, flagged if no such camera's answer is accepted."""
    accepted = [[one for one in cameras if one.verdict == "accepted"] for cameras in cases]
    wrong = [bad for cameras in cases if (bad := [one for one in cameras if one.answer_px > WRONG_PX])]
    errors = [one.refined_px for cameras in accepted for one in cameras]
    right = [max(one.correlated_px for one in cameras) <= RIGHT_PX for cameras in cases]
    return {
        "kind": kind,
        "cases": len(cases),
        "accepted": sum(map(bool, accepted)),
        "accepted_rms_px": rms(errors) if errors else None,
        "accepted_worst_px": max(errors, default=None),
        "wrong": len(wrong),
        "flagged": sum(all(one.verdict != "accepted" for one in cameras) for cameras in wrong),
        "refused_right": sum(ok and not cameras for ok, cameras in zip(right, accepted, strict=True)),
    }


COLUMNS = {
    "kind": "{kind}", "cases": "{cases}", "wrong": "{wrong}", "flagged": "{flagged} of {wrong}",
    "accepted": "{accepted}", "rms px": "{accepted_rms_px:.2f}", "worst px": "{accepted_worst_px:.2f}",
    "refused right": "{refused_right}",
}  # fmt: skip


def main() -> int:
    """Run the campaign; exit 1 if less than nine tenths of the wrong answers are flagged."""
    parser = options(__doc__, 100, "bad cases, a fifth of each kind", as_json=True)
    parser.add_argument("--good", type=at_least(0), help="good cases beside them (default: half as many)")
    args = parser.parse_args()
    true = load_rig(config_folder() / "sim" / "rocky8.yaml").rig
    believed = load_rig(config_folder() / "masts" / "rocky8_simulated.yaml").rig
    wanted = {kind: math.ceil(args.cases / len(KINDS)) for kind in KINDS}
    wanted["good"] = args.cases // 2 if args.good is None else args.good
    blocks = [
        HandoffBlock(true, believed, args.seed, kind, first, min(BLOCK, count - first))
        for kind, count in wanted.items()
        for first in range(0, count, BLOCK)
    ]
    label = "{0.kind}, {0.count} from {0.first}".format
    done: dict[str, list[list[HandoffOutcome]]] = {kind: [] for kind in wanted}
    for block, cases in zip(blocks, results_of(args, "blocks", run_block, blocks, label), strict=True):
        done[block.kind] += cases
    total = summary("all bad", [cases for kind in KINDS for cases in done[kind]])
    show(args, [summary(kind, cases) for kind, cases in done.items()] + [total], COLUMNS)
    return 0 if total["flagged"] >= WANTED * total["wrong"] else 1


if __name__ == "__main__":
    end(main)
