"""Patches of one picture in a later one of the same camera: by the reported joint angles, or anywhere.

Ranges come from the other camera of the earlier moment where there is one. Without it a patch may be at any
range from ``nearest_m`` on. `calib.matching.shown_view` concludes the later view.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.patch_search import HALF, AgreedView, Reduced, agreed_view, cut, found, textured
from calib.matching.warp import SIDES, Grey, Mask

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
        self._before_rad, self.reported_rad = np.array(before.angles_rad), np.array(after.angles_rad)
        self._places, self._earlier, self._later = before.places, before.reduced, after.reduced
        self._step = self._earlier.step

    def _camera(self, view: FloatArray) -> CameraModel:
        return self._rig.camera_in_rover(self._name, float(view[0]), float(view[1]))

    def patches(self, beside: tuple[str, Posed] | None) -> tuple[_Patches, _Patches]:
        """The textured patches of the earlier picture, and those that the reported view should show."""
        camera = self._camera(self._before_rad)
        pixels = self._earlier.to_full(self._places)
        rays, sides = camera.ray(pixels), camera.ray(pixels[:, None] + HALF * self._step * SIDES)
        half = np.full(len(pixels), 0.5 / self._nearest_m)
        every = _Patches(self._places, rays.origins_m, rays.directions, half, half, sides.directions).some(
            rays.valid & sides.valid.all(axis=1)
        )
        reported = self._camera(self.reported_rad)
        shown = np.ones(len(every.places), dtype=bool)
        for share in (-1.0, 1.0):
            seen, valid = reported.project(every.points_m(share))
            shown &= valid & self._later.holds(self._later.from_full(seen), HALF + 2)
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
        own = cut(
            self._earlier, patches.places, identity, np.rint(patches.places).astype(int), patches.places
        )
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
            line_px = far - near
            length = max(float(np.linalg.norm(line_px)), 1e-9)
            ends = tried[max(best - 1, 0)], tried[min(best + 1, RANGES - 1)]
            along = float(np.clip((place - near) @ line_px / length**2, 0.0, 1.0))
            across = abs(float((place - near)[0] * line_px[1] - (place - near)[1] * line_px[0])) / length
            if across > 2.0:
                continue
            inverse[k] = ends[0] + along * (ends[1] - ends[0])
            unsure[k] = 0.5 * (ends[1] - ends[0]) / length
        return replace(patches, inverse_per_m=inverse, unsure_per_m=unsure)

    def _shapes(self, camera: CameraModel, patches: _Patches) -> tuple[FloatArray, Mask]:
        """Maps (n, 2, 2) of offsets in the earlier picture to those in a camera's; which are no slivers."""
        around, valid = camera.project(patches.sides_m())
        sides = np.stack([around[:, 1] - around[:, 0], around[:, 3] - around[:, 2]], axis=-1)
        shapes = sides / (2.0 * HALF * self._step)
        flat = np.where(np.isfinite(shapes), shapes, 0.0)
        return shapes, valid.all(axis=1) & (np.abs(np.linalg.det(flat)) > 0.1)

    def at(self, patches: _Patches, view: FloatArray, reach_rad: float) -> AgreedView | None:
        """Search for the patches where a view puts them; None if nothing agrees."""
        camera = self._camera(view)
        expected, valid = camera.project(patches.points_m())
        shapes, usable = self._shapes(camera, patches)
        usable &= valid & self._later.holds(self._later.from_full(expected), HALF + 1)
        if usable.sum() < LEAST_PATCHES - 1:
            return None
        patches, expected, shapes = patches.some(usable), expected[usable], shapes[usable]
        turned = (self._camera(view + STEP_RAD * axis) for axis in np.eye(2))
        points = patches.points_m()
        rates = np.stack([(one.project(points)[0] - expected) / STEP_RAD for one in turned], axis=-1)
        open_px = np.zeros_like(expected)
        if (patches.unsure_per_m > 0).any():
            near, far = (camera.project(patches.points_m(share))[0] for share in (1.0, -1.0))
            open_px = (near - far) / 2
        known = np.isfinite(rates).all(axis=(1, 2)) & np.isfinite(open_px).all(axis=1)
        if known.sum() < LEAST_PATCHES - 1:
            return None
        rates, open_px = rates[known], open_px[known]
        places = self._later.from_full(expected[known])
        centres = np.rint(places).astype(int)
        wanted = cut(self._earlier, patches.places[known], shapes[known], centres, places)
        farthest = reach_rad * float(np.abs(rates).max()) / self._step + 2.0
        reaches = np.ceil(farthest + np.abs(open_px) / self._step).astype(int)
        seen = [
            found(patch, self._later, centre, (int(reach[0]), int(reach[1])))
            for patch, centre, reach in zip(wanted, centres, reaches, strict=True)
        ]
        off = (np.array([place for place, _ in seen]) - centres) * self._step
        scores = np.array([score for _, score in seen])
        good = (scores >= LEAST_CORRELATION) & np.isfinite(off).all(axis=1)
        return agreed_view(view, off[good], rates[good], open_px[good], scores[good], self._step, len(places))

    def anywhere(self, patches: _Patches) -> AgreedView | None:
        """The view that the later picture shows, wherever; None if it shows nothing of the earlier one."""
        fits = []
        for start in (self._before_rad, *self._voted(patches)):
            fit = self.at(patches, start, CLUSTER_RAD)
            if fit is not None and fit.agreeing >= LEAST_PATCHES - 1:
                fits.append(self.at(patches, fit.angles_rad, self._floor_rad) or fit)
        held = [fit for fit in fits if fit.holds("any")]
        return max(held, key=lambda fit: (fit.agreeing, fit.correlation), default=None)

    def _voted(self, patches: _Patches) -> list[FloatArray]:
        """Views that several patches vote for, searched in the whole picture as seen from three views."""
        size = np.array(self._later.grey.shape[::-1])
        votes: list[FloatArray] = []
        points, reported = patches.points_m(), self.reported_rad
        model = self._rig.cameras[self._name].model
        for share in (0.0, 0.5, 1.0):
            view = self._before_rad + share * (reported - self._before_rad)
            shapes, usable = self._shapes(self._camera(view), patches)
            index = np.flatnonzero(usable)
            if not len(index):
                continue
            places = patches.places[index]
            wanted = cut(self._earlier, places, shapes[index], np.rint(places).astype(int), places)
            for k, patch in zip(index, wanted, strict=True):
                seen, score = found(patch, self._later, size // 2, (int(size[0]), int(size[1])))
                if score < LEAST_CORRELATION:
                    continue
                try:
                    solutions = solve(
                        self._rig.mast, model, points[k], self._later.to_full(seen),
                        from_pan_rad=float(reported[0]), from_tilt_rad=float(reported[1]),
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
