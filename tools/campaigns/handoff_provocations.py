"""Pictures for hand-offs that ought to fail, from scenes of the simulated rover; and good ones beside them.

Five kinds: something stands before the target in the next camera's picture; ground nearly without contrast;
a pattern that repeats; shadows that moved between the two pictures; a wrong range, because the second click
or the second picture belongs to another place. The truth is the exact projection by the true rig.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.geometry import pointing
from calib.geometry.covariance import RigCovariance, moved_rig
from calib.geometry.rig import Rig
from calib.geometry.solutions import choose
from calib.matching.handoff import Eye
from drivers.sim import ground
from drivers.sim.kept import kernels
from drivers.sim.rocks import Brick, make_brick, meshes, together
from drivers.sim.scene import Scene, SceneSettings, build_scene, sun_direction
from mastctl.experiment.targets import BORDER_PX, texture_mask
from tools.studies.approach_world import ApproachWorld, WorldErrors

Float64 = NDArray[np.float64]

OFF_PX = 3.0
"""What the destination pair's calibration is off by in two of three looks, one sigma each axis."""

KINDS = ("shadow", "repeated", "range", "occluded", "flat")
STEPS = (("navcam", "hazcam", 2.0, 0.35), ("pancam", "navcam", 6.0, 0.9))
"""From, to, distance in metres, azimuth to either side."""

CLICK_PX = 0.2
PER_VIEW = 5
APART_PX = 45.0
RANGE_SLACK = 0.25
TRIED = 3000
BEFORE_M = 0.02
EDGE_PX = 25.0
EDGE_M = 0.04  # a shadow's edge is nearer to the target than this
SUN_BY_RAD = (0.15, 0.7)
CONTRASTS = (0.005, 0.2)  # of flat ground, beside the natural 1
PERIODS_PER_SIDE = (64, 128)  # of the 4.096 m texture: 64 and 32 mm
SECOND_CLICK_PX = (3.0, 30.0)
SECOND_EYE_RAD = (0.002, 0.02)


@dataclass(frozen=True, eq=False)
class ProvokedView:
    """What one look is made of: scenes of the source's and the destination's pictures, and what is wrong."""

    source: Scene
    destination: Scene
    note: str
    sigma_px: float = CLICK_PX
    second_click_px: float = 0.0
    second_eye_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class ProvokedHandoff:
    """One target in the pictures of one look.

    Attributes
    ----------
    kind, note
        What is provoked, and how strongly.
    step
        From pair, to pair.
    joints_rad
        Commanded pan, tilt.
    source, destinations
        Pictures with the cameras as the mast file has them.
    believed, calibration
        The mast file: the packaged one, or one whose destination pair is off.
    clicks_px
        (2, 2) with their noise, and with what is wrong about the second.
    sigma_px
        What the clicks are said to be wrong by.
    true_px
        By destination camera: (2,) exact.
    """

    kind: str
    note: str
    step: tuple[str, str]
    joints_rad: tuple[float, float]
    source: tuple[Eye, Eye]
    destinations: dict[str, Eye]
    believed: Rig
    calibration: RigCovariance
    clicks_px: Float64
    sigma_px: float
    true_px: dict[str, Float64]


class Stage:
    """The rover before scenes that provoke."""

    def __init__(self, true: Rig, believed: Rig, calibration: RigCovariance, seed: int) -> None:
        self._scene_seed = seed
        self._rng = np.random.default_rng(seed)
        self._world: ApproachWorld | None = None
        self._true, self._believed, self._calibration = true, believed, calibration
        self._scenes: dict[SceneSettings, Scene] = {}

    def cases(self, kind: str, count: int, first: int = 0) -> Iterator[ProvokedHandoff]:
        """Yield ``count`` cases of a kind, by turns of either step; a draw of its own for each ``first``."""
        self.close()
        self._rng = np.random.default_rng([self._scene_seed, *kind.encode(), *([first] if first else [])])
        done, look = 0, 0
        while done < count:
            off_px = 0.0 if look % 3 == 2 else OFF_PX
            for case in self._look(kind, off_px, *STEPS[look % len(STEPS)]):
                yield case
                done += 1
                if done == count:
                    return
            look += 1

    def close(self) -> None:
        """Let go of the renderer."""
        if self._world is not None:
            self._world.close()
            self._world = None

    def _look(
        self, kind: str, off_px: float, source: str, to: str, distance_m: float, azimuth_rad: float
    ) -> Iterator[ProvokedHandoff]:
        """One look from a new place: up to ``PER_VIEW`` targets."""
        rng = self._rng
        azimuth = rng.uniform(-azimuth_rad, azimuth_rad)
        view = self._view(kind, distance_m, azimuth)
        if self._world is None:
            self._world = ApproachWorld(view.source, self._true, self._believed, WorldErrors(), rng)
        world = self._world
        believed, calibration = self._mast_file(world.true.stereo[to], off_px)
        world.believed = believed
        world.relight(view.source)
        pair, next_pair = world.true.stereo[source], world.true.stereo[to]
        pan, tilt = self._angles(world, pair[0], distance_m, azimuth)
        eyes = world.look(pair, pan, tilt)
        if view.second_eye_rad:
            late = world.look((pair[1],), pan + view.second_eye_rad, tilt)[pair[1]]
            eyes[pair[1]] = replace(late, camera=eyes[pair[1]].camera)
        world.relight(view.destination)
        destinations = world.look(next_pair, pan, tilt)
        points = self._candidates(view, world, pair[0], (pan, tilt), eyes[pair[0]].image, distance_m, kind)
        taken: list[Float64] = []
        for point in points:
            right_tilt = (pan + view.second_eye_rad, tilt)
            exact = np.array(
                [world.true_pixel(pair[0], pan, tilt, point), world.true_pixel(pair[1], *right_tilt, point)]
            )
            if not _inside(exact[1], eyes[pair[1]].image.shape, BORDER_PX):
                continue
            if any(np.linalg.norm(exact[0] - other) < APART_PX for other in taken):
                continue
            if not self._shows(world, view, (pair[1],), right_tilt, point)[0]:
                continue
            shown = self._shows(world, replace(view, source=view.destination), next_pair, (pan, tilt), point)
            true = {name: world.true_pixel(name, pan, tilt, point) for name in next_pair}
            inside = all(_inside(true[name], destinations[name].image.shape, EDGE_PX) for name in next_pair)
            if not inside or all(shown) == (kind == "occluded"):
                continue
            taken.append(exact[0])
            clicks = exact + rng.normal(0.0, view.sigma_px, (2, 2))
            clicks[1, 0] += view.second_click_px * rng.choice([-1.0, 1.0])
            source_eyes = (eyes[pair[0]], eyes[pair[1]])
            yield ProvokedHandoff(
                kind, f"{view.note}, mast file off by {off_px:g} px", (source, to), (pan, tilt), source_eyes,
                destinations, believed, calibration, clicks, view.sigma_px, true,
            )  # fmt: skip
            if len(taken) == PER_VIEW:
                return

    def _mast_file(self, pair: tuple[str, str], off_px: float) -> tuple[Rig, RigCovariance]:
        """The packaged mast file; or one whose pair is off in x and y together, and which knows how far."""
        if not off_px:
            return self._believed, self._calibration
        known, moved = self._calibration, self._believed
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
            moved = moved_rig(moved, names, float(self._rng.normal(0.0, off_px)) * step)
        return moved, RigCovariance(names, covariance)

    def _angles(
        self, world: ApproachWorld, camera: str, distance_m: float, azimuth: float
    ) -> tuple[float, float]:
        """Joint angles that look at level ground at the distance."""
        head = world.believed.mast.rover_from_head(0.0, 0.0).translation_m
        along = math.sqrt(distance_m**2 - float(head[2]) ** 2)
        aim = np.array([head[0] + along * math.cos(azimuth), head[1] + along * math.sin(azimuth), 0.0])
        solutions = pointing.solve(world.believed.mast, world.believed.cameras[camera].model, aim)
        chosen = choose(solutions, (-2.6, 2.6), (-1.2, 0.5))
        return chosen.pan_rad, chosen.tilt_rad

    def _candidates(
        self,
        view: ProvokedView,
        world: ApproachWorld,
        camera: str,
        joints: tuple[float, float],
        image: Any,
        distance_m: float,
        kind: str,
    ) -> Float64:
        """Points (n, 3) of the site that the picture shows about the distance, in random order."""
        usable = texture_mask(image.astype(np.uint8))
        if kind in ("flat", "shadow"):
            usable[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX] = True
        rows, columns = np.nonzero(usable)
        if len(rows) == 0:
            return np.empty((0, 3))
        pick = self._rng.integers(len(rows), size=TRIED)
        rays = world.true_camera(camera, *joints).ray(
            np.column_stack([columns[pick], rows[pick]]).astype(float)
        )
        origins = world.site_from_rover.points(rays.origins_m)
        along = world.site_from_rover.vectors(rays.directions)
        ranges = view.source.cast(origins, along)
        points = origins + ranges[:, None] * along
        keep = np.abs(ranges - distance_m) < RANGE_SLACK * distance_m
        if kind == "shadow":
            keep &= _at_shadow_edge(view.source, points)
        return np.asarray(points[keep])

    def _shows(
        self,
        world: ApproachWorld,
        view: ProvokedView,
        names: tuple[str, ...],
        joints: tuple[float, float],
        point: Float64,
    ) -> list[bool]:
        """Whether cameras see a point of the site in the source's scene, by casting their rays at it."""
        shown = []
        for name in names:
            pixel = world.true_pixel(name, *joints, point)
            ray = world.true_camera(name, *joints).ray(pixel)
            if not bool(ray.valid):
                shown.append(False)
                continue
            origin = world.site_from_rover.points(ray.origins_m)
            met = view.source.cast(origin, world.site_from_rover.vectors(ray.directions))
            shown.append(float(met) > float(np.linalg.norm(point - origin)) - BEFORE_M)
        return shown

    # ------------------------------------------------------------- what is wrong

    def _view(self, kind: str, distance_m: float, azimuth: float) -> ProvokedView:
        """The scenes of one look of a kind."""
        rng = self._rng
        usual = SceneSettings(seed=self._scene_seed)
        if kind == "good":
            scene = self._scene(usual)
            return ProvokedView(scene, scene, "as it is")
        if kind == "occluded":
            scene = self._scene(usual)
            hidden = with_bricks(scene, self._row(scene, distance_m, azimuth))
            stood = bool(rng.random() < 0.5) and distance_m < 4.0
            return ProvokedView(
                hidden if stood else scene, hidden, "stood there" if stood else "came between"
            )
        if kind == "flat":
            contrast = float(np.exp(rng.uniform(*np.log(CONTRASTS))))
            scene = faded(self._scene(usual), contrast)
            return ProvokedView(scene, scene, f"contrast {contrast:.3f}")
        if kind == "repeated":
            count, natural = int(rng.choice(PERIODS_PER_SIDE)), float(rng.choice([0.0, 0.1, 0.2]))
            scene = repeated(self._scene(usual), count, natural, rng)
            sigma = float(rng.choice([CLICK_PX, 1.0]))
            side_mm = ground.DETAIL_TEXELS * ground.DETAIL_TEXEL_M * 1e3
            note = f"period {side_mm / count:.0f} mm, natural {natural:g}, clicks {sigma:g} px"
            return ProvokedView(scene, scene, note, sigma_px=sigma)
        if kind == "shadow":
            low = replace(usual, rocks=300, bricks=12, sun_elevation_rad=0.45)
            by = float(rng.uniform(*SUN_BY_RAD) * rng.choice([-1.0, 1.0]))
            moved = replace(low, sun_azimuth_rad=low.sun_azimuth_rad + by)
            contrast = float(rng.choice([1.0, 0.3, 0.1]))
            scenes = [faded(self._scene(one), contrast, broad=False) for one in (low, moved)]
            return ProvokedView(
                scenes[0], scenes[1], f"sun by {math.degrees(by):.0f} degrees, contrast {contrast:g}"
            )
        assert kind == "range"
        scene = self._scene(usual)
        if rng.random() < 0.5:
            off = float(rng.uniform(*SECOND_CLICK_PX))
            return ProvokedView(scene, scene, f"second click off by {off:.1f} px", second_click_px=off)
        turn = float(rng.uniform(*SECOND_EYE_RAD) * rng.choice([-1.0, 1.0]))
        return ProvokedView(
            scene, scene, f"head turned by {turn * 1e3:.1f} mrad between", second_eye_rad=turn
        )

    def _scene(self, settings: SceneSettings) -> Scene:
        """Build a scene, or take it from those kept."""
        if settings not in self._scenes:
            self._scenes[settings] = build_scene(settings)
        return self._scenes[settings]

    def _row(self, scene: Scene, distance_m: float, azimuth: float) -> tuple[Brick, ...]:
        """Bricks across the view, nearer than the distance."""
        away = math.sqrt(distance_m**2 - 1.45**2) - (0.25 if distance_m < 4 else 0.45)
        row = []
        for step in (-1.0, 0.0, 1.0):
            across = 0.48 * step
            x = 0.4 + away * math.cos(azimuth) - across * math.sin(azimuth)
            y = away * math.sin(azimuth) + across * math.cos(azimuth)
            turn = azimuth + math.pi / 2 + float(self._rng.uniform(-0.3, 0.3))
            row.append(make_brick(x, y, turn, scene.ground_z_m))
        return tuple(row)


def _inside(pixel_px: Float64, shape: tuple[int, ...], edge: float) -> bool:
    """Whether a pixel is well inside a picture."""
    return bool(
        np.isfinite(pixel_px).all()
        and (pixel_px > edge).all()
        and (pixel_px < np.array(shape[::-1]) - 1 - edge).all()
    )


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


def with_bricks(scene: Scene, more: tuple[Brick, ...]) -> Scene:
    """Return the scene with bricks that throw no shadow, as if something were held before the camera."""
    stones = together(scene.world.rocks, meshes(more))
    return Scene(scene.settings, scene.world._replace(rocks=stones), scene.bricks + more)


def faded(scene: Scene, contrast: float, broad: bool = True) -> Scene:
    """Return the scene with its ground's contrast multiplied; ``broad`` also that of soil and shadows."""
    world = scene.world

    def less(picture: Any) -> Any:
        one = kernels().ONE
        texels = np.rint(one + contrast * (picture.texels.astype(np.float32) - one))
        return picture._replace(texels=texels.astype(np.uint16))

    changed = world._replace(detail=less(world.detail), broad=less(world.broad) if broad else world.broad)
    return Scene(scene.settings, changed, scene.bricks)


def repeated(scene: Scene, count: int, natural: float, rng: np.random.Generator) -> Scene:
    """Return the scene with ground that repeats ``count`` times a texture's side, and some natural gravel."""
    side = ground.DETAIL_TEXELS
    tile = 1.0 + 0.25 * ground.fractal(side // count, rng, 0.8, 3.0, side / count)
    gravel = ground.gravel(rng, sun_direction(scene.settings), side) if natural else np.ones((side, side))
    tones = np.clip(np.tile(tile, (count, count)) * (1.0 + natural * (gravel - 1.0)), 0.1, 1.9)
    detail = ground.pyramid(tones.astype(np.float32), ground.DETAIL_TEXEL_M)
    plain = faded(scene, 0.1)
    return Scene(scene.settings, plain.world._replace(detail=detail), scene.bricks)
