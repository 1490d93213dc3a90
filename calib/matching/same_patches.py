"""Patches of one picture in a later one of the same camera: by the reported joint angles, or anywhere.

Ranges come from the other camera of the earlier moment where there is one. Without it a patch may be at any
range from ``nearest_m`` on. `calib.matching.shown_view` concludes the later view.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.patch_search import HALF, AgreedView, Reduced, agreed_view, cut, found, textured
from calib.matching.warp import SIDES, Grey

MOST_PATCHES = 20

LEAST_PATCHES = 6

LEAST_CORRELATION = 0.7

CLUSTER_RAD = 0.03

RANGES = 48
"""Inverse ranges tried along a patch's line in the other camera."""

STEP_RAD = 1e-4


@dataclass(frozen=True, eq=False)
class Posed:
    """A camera's picture (h, w) grey with the joint angles reported for it."""

    image: Grey
    pan_rad: float
    tilt_rad: float

    @cached_property
    def reduced(self) -> Reduced:
        """The picture as patches are looked for in it."""
        return Reduced.of(self.image)

    @cached_property
    def places(self) -> FloatArray:
        """Its textured places (n, 2), reduced pixels, row by row."""
        places, strength = textured(self.reduced)
        return places[strength >= 1.0]

    @property
    def angles_rad(self) -> tuple[float, float]:
        """(pan, tilt)."""
        return self.pan_rad, self.tilt_rad


@dataclass(frozen=True, eq=False)
class _Patches:
    """Patches of the earlier picture: places (n, 2) reduced; rays; inverse ranges with half their width."""

    places: FloatArray
    origins_m: FloatArray
    directions: FloatArray
    inverse_per_m: FloatArray
    unsure_per_m: FloatArray
    side_directions: FloatArray

    def points_m(self, share: float = 0.0) -> FloatArray:
        """The patches' middles (n, 3), ``share`` of their ranges' uncertainty nearer."""
        inverse = np.maximum(self.inverse_per_m + share * self.unsure_per_m, 1e-4)
        return np.asarray(self.origins_m + self.directions / inverse[:, None])

    def sides_m(self) -> FloatArray:
        """Points (n, 4, 3) at their sides, at the same range."""
        inverse = np.maximum(self.inverse_per_m, 1e-4)[:, None, None]
        return np.asarray(self.origins_m[:, None] + self.side_directions / inverse)

    def some(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> _Patches:
        """Only some of them."""
        return _Patches(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


class Comparison:
    """One camera's two pictures."""

    def __init__(
        self, rig: Rig, name: str, before: Posed, after: Posed, nearest_m: float, floor_rad: float
    ) -> None:
        self._rig, self._name = rig, name
        self._nearest_m, self._floor_rad = nearest_m, floor_rad
        self.before, self.after = before, after
        self.earlier, self.later = before.reduced, after.reduced
        self.step = self.earlier.step

    def camera(self, pan_rad: float, tilt_rad: float) -> CameraModel:
        return self._rig.camera_in_rover(self._name, pan_rad, tilt_rad)

    def patches(self, beside: tuple[str, Posed] | None) -> tuple[_Patches, _Patches]:
        """The textured patches of the earlier picture, and those that the reported view should show."""
        places = self.before.places
        camera = self.camera(*self.before.angles_rad)
        pixels = self.earlier.to_full(places)
        around = pixels[:, None] + HALF * self.step * SIDES
        rays, sides = camera.ray(pixels.reshape(-1, 2)), camera.ray(around)
        near = 1.0 / self._nearest_m
        every = _Patches(
            places,
            rays.origins_m,
            rays.directions,
            np.full(len(places), near / 2),
            np.full(len(places), near / 2),
            sides.directions,
        ).some(rays.valid & sides.valid.all(axis=1))
        told = self.camera(*self.after.angles_rad)
        shown = np.ones(len(every.places), dtype=bool)
        for share in (-1.0, 1.0):
            seen, valid = told.project(every.points_m(share))
            shown &= valid & self.later.holds(self.later.from_full(seen), HALF + 2)
        inside = every.some(spread(np.flatnonzero(shown)))
        if beside is not None and len(inside.places):
            inside = self._ranged(inside, *beside)
        return every, inside

    def _ranged(self, patches: _Patches, name: str, picture: Posed) -> _Patches:
        """The patches with ranges from the other camera; without one where it shows nothing alike."""
        other = picture.reduced
        camera = self._rig.camera_in_rover(name, *picture.angles_rad)
        tried = np.linspace(1e-4, 1.0 / self._nearest_m, RANGES)
        points = patches.origins_m[:, None] + patches.directions[:, None] / tried[:, None]
        line, valid = camera.project(points)
        line = other.from_full(line)
        inverse, unsure = patches.inverse_per_m.copy(), patches.unsure_per_m.copy()
        identity = np.broadcast_to(np.eye(2), (len(inverse), 2, 2))
        own = cut(self.earlier, patches.places, identity, np.rint(patches.places).astype(int), patches.places)
        size = np.array(other.grey.shape[::-1])
        for k, patch in enumerate(own):
            here = line[k][valid[k] & ((line[k] > -HALF) & (line[k] < size + HALF)).all(axis=1)]
            if len(here) < 2:
                continue
            low, high = here.min(axis=0), here.max(axis=0)
            centre = np.rint((low + high) / 2).astype(int)
            reach = np.ceil((high - low) / 2).astype(int) + 2
            place, score = found(patch, other, centre, (int(reach[0]), int(reach[1])))
            if score < LEAST_CORRELATION:
                continue
            apart = np.linalg.norm(line[k] - place, axis=1)
            best = int(np.nanargmin(apart))
            near, far = line[k][max(best - 1, 0)], line[k][min(best + 1, RANGES - 1)]
            way = far - near
            length = max(float(np.linalg.norm(way)), 1e-9)
            ends = tried[max(best - 1, 0)], tried[min(best + 1, RANGES - 1)]
            along = float(np.clip((place - near) @ way / length**2, 0.0, 1.0))
            across = abs(float((place - near)[0] * way[1] - (place - near)[1] * way[0])) / length
            if across > 2.0:
                continue
            inverse[k] = ends[0] + along * (ends[1] - ends[0])
            unsure[k] = 0.5 * (ends[1] - ends[0]) / length
        return _Patches(
            patches.places, patches.origins_m, patches.directions, inverse, unsure, patches.side_directions
        )

    def at(self, patches: _Patches, view: FloatArray, reach_rad: float) -> AgreedView | None:
        """Look for the patches where a view puts them; None if nothing agrees."""
        pan, tilt = float(view[0]), float(view[1])
        camera = self.camera(pan, tilt)
        points = patches.points_m()
        expected, ok = camera.project(points)
        around, sides_ok = camera.project(patches.sides_m())
        places = self.later.from_full(expected)
        usable = ok & sides_ok.all(axis=1) & self.later.holds(places, HALF + 1)
        if usable.sum() < LEAST_PATCHES - 1:
            return None
        patches, points, expected, around, places = (
            patches.some(usable), points[usable], expected[usable], around[usable], places[usable],
        )  # fmt: skip
        rates = np.stack(
            [
                (self.camera(pan + a, tilt + b).project(points)[0] - expected) / STEP_RAD
                for a, b in ((STEP_RAD, 0.0), (0.0, STEP_RAD))
            ],
            axis=-1,
        )
        open_px = np.zeros_like(expected)
        if (patches.unsure_per_m > 0).any():
            near, far = (camera.project(patches.points_m(share))[0] for share in (1.0, -1.0))
            open_px = (near - far) / 2
        sides = np.stack([around[:, 1] - around[:, 0], around[:, 3] - around[:, 2]], axis=-1)
        shapes = sides / (2.0 * HALF * self.step)
        known = np.isfinite(rates).all(axis=(1, 2)) & np.isfinite(open_px).all(axis=1)
        known &= np.abs(np.linalg.det(np.where(np.isfinite(shapes), shapes, 0.0))) > 0.1
        if known.sum() < LEAST_PATCHES - 1:
            return None
        rates, open_px, expected = rates[known], open_px[known], expected[known]
        patches, places, shapes = patches.some(known), places[known], shapes[known]
        centres = np.rint(places).astype(int)
        wanted = cut(self.earlier, patches.places, shapes, centres, places)
        focal_px = float(np.abs(rates).max())
        farthest = reach_rad * focal_px / self.step + 2.0
        off, scores = np.empty((len(places), 2)), np.empty(len(places))
        for k, patch in enumerate(wanted):
            reach = np.ceil(farthest + np.abs(open_px[k]) / self.step).astype(int)
            seen, scores[k] = found(patch, self.later, centres[k], (int(reach[0]), int(reach[1])))
            off[k] = (seen - centres[k]) * self.step
        good = (scores >= LEAST_CORRELATION) & np.isfinite(off).all(axis=1)
        return agreed_view(view, off[good], rates[good], open_px[good], scores[good], self.step, len(places))

    def anywhere(self, patches: _Patches) -> AgreedView | None:
        """The view that the later picture shows, wherever; None if it shows nothing of the earlier one."""
        before, told = np.array(self.before.angles_rad), np.array(self.after.angles_rad)
        starts = [before, *self._voted(patches, before, told)]
        fits = [self._settled(patches, start) for start in starts]
        held = [fit for fit in fits if fit is not None and fit.holds("any")]
        return max(held, key=lambda fit: (fit.agreeing, fit.correlation), default=None)

    def _settled(self, patches: _Patches, start: FloatArray) -> AgreedView | None:
        """The fit at a view found from a rough one."""
        fit = self.at(patches, start, CLUSTER_RAD)
        if fit is None or fit.agreeing < LEAST_PATCHES - 1:
            return None
        return self.at(patches, fit.angles_rad, self._floor_rad) or fit

    def _voted(self, patches: _Patches, before: FloatArray, told: FloatArray) -> list[FloatArray]:
        """Views that several patches vote for, looked for in the whole picture as seen from three views."""
        size = np.array(self.later.grey.shape[::-1])
        middle = size // 2
        votes: list[FloatArray] = []
        points = patches.points_m()
        model = self._rig.cameras[self._name].model
        for share in (0.0, 0.5, 1.0):
            camera = self.camera(*(before + share * (told - before)))
            around, ok = camera.project(patches.sides_m())
            sides = np.stack([around[:, 1] - around[:, 0], around[:, 3] - around[:, 2]], axis=-1)
            shapes = sides / (2.0 * HALF * self.step)
            with np.errstate(invalid="ignore"):
                usable = ok.all(axis=1) & (np.abs(np.linalg.det(shapes)) > 0.1)
            if not usable.any():
                continue
            index = np.flatnonzero(usable)
            centres = np.rint(patches.places[index]).astype(int)
            wanted = cut(self.earlier, patches.places[index], shapes[index], centres, patches.places[index])
            for k, patch in zip(index, wanted, strict=True):
                seen, score = found(patch, self.later, middle, (int(size[0]), int(size[1])))
                if score < LEAST_CORRELATION:
                    continue
                try:
                    solutions = solve(
                        self._rig.mast, model, points[k], self.later.to_full(seen),
                        from_pan_rad=float(told[0]), from_tilt_rad=float(told[1]),
                    )  # fmt: skip
                except CalibError:
                    continue
                votes += [np.array([one.pan_rad, one.tilt_rad]) for one in solutions[:1]]
        if len(votes) < LEAST_PATCHES - 1:
            return []
        all_votes = np.array(votes)
        near = np.asarray((np.abs(all_votes[:, None] - all_votes[None]) < CLUSTER_RAD).all(axis=2))
        starts: list[FloatArray] = []
        left = np.ones(len(all_votes), dtype=bool)
        while len(starts) < 3:
            counts = (near & left).sum(axis=1) * left
            best = int(np.argmax(counts))
            if counts[best] < LEAST_PATCHES - 2:
                break
            starts.append(np.median(all_votes[near[best] & left], axis=0))
            left &= ~near[best]
        return starts


def spread(which: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return as many as are looked for, evenly, so that no one thing of strong contrast has them all."""
    if len(which) <= MOST_PATCHES:
        return which
    return np.asarray(which[np.linspace(0, len(which) - 1, MOST_PATCHES).round().astype(int)])
