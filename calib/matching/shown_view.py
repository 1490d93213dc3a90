"""Which view a picture shows: its joint angles by what it shares with an earlier picture of the same camera.

Some twenty textured patches of the earlier picture are searched for where the joint angles reported for the
later one put them. Every found patch is a vote for two angles; the view is the majority's. If that is not the
reported one, or none is found, the patches are searched for in the whole picture, and the angles solved for.

Rotation moves a picture as a whole, whatever its range; the way of the camera with the head moves near things
further. Ranges come from the other camera of the earlier moment where there is one. Without it a patch may be
at any range from ``nearest_m`` on, and what that leaves open of the angles is the bound ``parallax_rad``.

Not decided here: what follows from a contradiction. Not reported here: changes below the tolerance of
`FLOOR_RAD`, which joints with play make themselves, and a picture of another moment of the same view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import JOINT_NAMES, pixel_rates
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.patch_search import HALF, AgreedView, Reduced, agreed_view, cut, found, textured
from calib.matching.warp import SIDES, Grey, Mask

MOST_PATCHES, LEAST_PATCHES = 20, 6

LEAST_CORRELATION = 0.7

CLUSTER_RAD = 0.03

RANGES = 48
"""Inverse ranges tried along a patch's line in the other camera."""

REPORTED, ANYWHERE = (5, 0.25), (6, 0.4)
"""How many patches, and which share of those that a view should show, must agree on it: the reported view
needs fewer, since a large thing may have moved in the picture, than one that is searched for everywhere."""

FLOOR_RAD = 7e-3
"""How much shown and reported angles of each joint may differ: what a sound head leaves between readings and
pictures of two poses. The full backlash of a 12-bit servo is 4.4 mrad, half a count at either end 1.5
mrad."""
SHARE = 0.01
"""The same, as a part of the way between the poses: camera models of that quality."""
SIGMAS = 5.3
"""The same, in sigmas of the fit: one chance in a million for two angles."""
NEAREST_M = 0.4
"""Nothing is nearer to the camera."""

ViewVerdict = Literal["seen", "small_move", "contradicted", "unlike", "too_plain", "no_overlap"]


@dataclass(frozen=True, eq=False)
class Posed:
    """A camera's picture (h, w) grey with the joint angles reported for it."""

    image: Grey
    pan_rad: float
    tilt_rad: float

    @cached_property
    def reduced(self) -> Reduced:
        """The picture as patches are searched for in it."""
        return Reduced.of(self.image)

    @cached_property
    def places(self) -> FloatArray:
        """Its textured places (n, 2), reduced pixels, row by row."""
        return textured(self.reduced)

    @property
    def angles_rad(self) -> tuple[float, float]:
        """(pan, tilt)."""
        return self.pan_rad, self.tilt_rad


@dataclass(frozen=True)
class ShownView:
    """The view that a picture shows; angles are not-a-number if none was found.

    ``verdict`` is ``seen``: the reported one. ``small_move``: the reported one, but the way is so small that
    the picture of before would pass too, or that the shown view is as near to the one before.
    ``contradicted``: another one. ``unlike``: nothing of what the earlier picture shows, though much of it
    should be there. ``too_plain``: too little texture, or a pattern that fits both views. ``no_overlap``: the
    reported view shares too little with the earlier one, and the picture shows none of it either.

    ``off_rad``, ``sigma_rad`` and ``allowed_rad`` are, of (pan, tilt), shown less reported, one sigma of the
    fit, and how large the difference may be; ``off_px`` how far the shown view moves the patches against the
    reported one, root of the mean square; ``agreeing`` and ``expected`` patches that agree on the view, and
    that it should show.
    """

    verdict: ViewVerdict
    pan_rad: float = math.nan
    tilt_rad: float = math.nan
    off_rad: tuple[float, float] = (math.nan, math.nan)
    sigma_rad: tuple[float, float] = (math.nan, math.nan)
    allowed_rad: tuple[float, float] = (math.nan, math.nan)
    off_px: float = math.nan
    agreeing: int = 0
    expected: int = 0


def shown_view(
    rig: Rig,
    camera: str,
    before: Posed,
    after: Posed,
    beside: tuple[str, Posed] | None = None,
) -> ShownView:
    """Return which view a later picture of a head camera shows.

    The angles reported for the picture ``before`` are believed, those for ``after`` are checked. ``beside``
    is name and picture of the other camera at the earlier moment, for ranges.
    """
    pictures = _Comparison(rig, camera, before, after)
    reported, start = np.array(after.angles_rad), np.array(before.angles_rad)
    every, inside = pictures.patches(beside)
    if len(every.places) < LEAST_PATCHES:
        return ShownView("too_plain", expected=len(every.places))
    overlaps = len(inside.places) >= LEAST_PATCHES
    if overlaps:
        fit = pictures.at(inside, reported, 1.5 * FLOOR_RAD)
        if fit is not None and _enough(fit, REPORTED):
            shown = _shown(fit, reported, start)
            if shown.verdict == "contradicted":
                fit = pictures.at(inside, fit.angles_rad, FLOOR_RAD) or fit
                return _shown(fit, reported, start)
            if shown.verdict == "seen":
                rival = pictures.at(inside, start, FLOOR_RAD)
                stayed = rival is not None and (np.abs(rival.angles_rad - start) <= FLOOR_RAD).all()
                if rival is not None and stayed and rival.agreeing >= 0.8 * fit.agreeing:
                    # The same match, between the two views: the head played back. Else a pattern.
                    if (np.abs(rival.angles_rad - fit.angles_rad) <= FLOOR_RAD / 2).all():
                        return replace(shown, verdict="small_move")
                    return ShownView("too_plain", expected=fit.expected, agreeing=fit.agreeing)
            return shown
    fit = pictures.anywhere(inside if overlaps else every.some(_spread(np.arange(len(every.places)))))
    if fit is not None:
        return _shown(fit, reported, start)
    if not overlaps:
        return ShownView("no_overlap", expected=len(inside.places))
    rich = len(after.places) >= LEAST_PATCHES
    return ShownView("unlike" if rich else "too_plain", expected=len(inside.places))


def overlap(rig: Rig, camera: str, before_rad: tuple[float, float], after_rad: tuple[float, float]) -> float:
    """Return which share (0..1) of a head camera's picture, of things far away, is in another view too."""
    earlier, later = (rig.camera_in_rover(camera, *angles) for angles in (before_rad, after_rad))
    x, y = (np.linspace(0.0, n - 1.0, 9) for n in earlier.size_px)
    rays = earlier.ray(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    seen, valid = later.project(rays.origins_m + 1e3 * rays.directions)
    size = np.array(later.size_px)
    with np.errstate(invalid="ignore"):
        inside = ((seen >= 0.0) & (seen <= size - 1.0)).all(axis=1)
    return float((rays.valid & valid & inside).mean())


def _enough(fit: AgreedView, least: tuple[int, float]) -> bool:
    """Whether enough patches agree, by `REPORTED` or `ANYWHERE`."""
    return fit.agreeing >= max(least[0], least[1] * fit.expected)


def _shown(fit: AgreedView, reported: FloatArray, start: FloatArray) -> ShownView:
    """What a fit says about the reported view."""
    off, way = fit.angles_rad - reported, np.abs(reported - start)
    allowed = FLOOR_RAD + SHARE * float(way.max()) + fit.parallax_rad + SIGMAS * fit.sigma_rad
    verdict: ViewVerdict = "small_move" if (way <= allowed).all() else "seen"
    if (np.abs(off) > allowed).any():
        verdict = "contradicted"
    pan_rad, tilt_rad = fit.angles_rad.tolist()
    off_rad, sigma_rad, allowed_rad = (
        (float(pan), float(tilt)) for pan, tilt in (off, fit.sigma_rad, allowed)
    )
    off_px = float(np.sqrt(((fit.rate_px_per_rad @ off) ** 2).sum(axis=1).mean()))
    return ShownView(
        verdict, pan_rad, tilt_rad, off_rad, sigma_rad, allowed_rad, off_px, fit.agreeing, fit.expected
    )


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

    def some(self, which: Mask | NDArray[np.intp]) -> _Patches:
        """Only some of them."""
        return _Patches(*(getattr(self, name)[which] for name in self.__dataclass_fields__))


class _Comparison:
    """One camera's two pictures."""

    def __init__(self, rig: Rig, name: str, before: Posed, after: Posed) -> None:
        self._rig, self._name = rig, name
        self._before_rad, self._reported_rad = np.array(before.angles_rad), np.array(after.angles_rad)
        self._places, self._earlier, self._later = before.places, before.reduced, after.reduced
        self._step = self._earlier.step

    def _camera(self, view: FloatArray) -> CameraModel:
        return self._rig.camera_in_rover(self._name, float(view[0]), float(view[1]))

    def patches(self, beside: tuple[str, Posed] | None) -> tuple[_Patches, _Patches]:
        """The textured patches of the earlier picture, and those that the reported view should show."""
        camera = self._camera(self._before_rad)
        pixels = self._earlier.to_full(self._places)
        rays, sides = camera.ray(pixels), camera.ray(pixels[:, None] + HALF * self._step * SIDES)
        half = np.full(len(pixels), 0.5 / NEAREST_M)
        every = _Patches(self._places, rays.origins_m, rays.directions, half, half, sides.directions).some(
            rays.valid & sides.valid.all(axis=1)
        )
        reported = self._camera(self._reported_rad)
        shown = np.ones(len(every.places), dtype=bool)
        for share in (-1.0, 1.0):
            seen, valid = reported.project(every.points_m(share))
            shown &= valid & self._later.holds(self._later.from_full(seen), HALF + 2)
        inside = every.some(_spread(np.flatnonzero(shown)))
        if beside is not None and len(inside.places):
            inside = self._ranged(inside, *beside)
        return every, inside

    def _ranged(self, patches: _Patches, name: str, picture: Posed) -> _Patches:
        """The patches with ranges from the other camera; without one where it shows nothing alike."""
        other = picture.reduced
        camera = self._rig.camera_in_rover(name, *picture.angles_rad)
        tried = np.linspace(1e-4, 1.0 / NEAREST_M, RANGES)
        points = patches.origins_m[:, None] + patches.directions[:, None] / tried[:, None]
        pixels, valid = camera.project(points)
        lines = other.from_full(pixels)
        inverse, unsure = patches.inverse_per_m.copy(), patches.unsure_per_m.copy()
        identity = np.broadcast_to(np.eye(2), (len(inverse), 2, 2))
        whole = np.rint(patches.places).astype(int)
        for k, patch in enumerate(cut(self._earlier, patches.places, identity, whole, patches.places)):
            line = lines[k]
            inside = line[valid[k] & other.holds(line, -HALF)]
            if len(inside) < 2:
                continue
            low, high = inside.min(axis=0), inside.max(axis=0)
            reach = np.ceil((high - low) / 2).astype(int) + 2
            place, score = found(patch, other, np.rint((low + high) / 2).astype(int), reach)
            if score < LEAST_CORRELATION:
                continue
            best = int(np.nanargmin(np.linalg.norm(line - place, axis=1)))
            ends = [max(best - 1, 0), min(best + 1, RANGES - 1)]
            near, (from_m, to_m) = line[ends[0]], tried[ends]
            way = line[ends[1]] - near
            length = max(float(np.linalg.norm(way)), 1e-9)
            along = float(np.clip((place - near) @ way / length**2, 0.0, 1.0))
            if abs(float((place - near)[0] * way[1] - (place - near)[1] * way[0])) / length > 2.0:
                continue
            inverse[k] = from_m + along * (to_m - from_m)
            unsure[k] = 0.5 * (to_m - from_m) / length
        return replace(patches, inverse_per_m=inverse, unsure_per_m=unsure)

    def _shapes(self, camera: CameraModel, patches: _Patches) -> tuple[FloatArray, Mask]:
        """Maps (n, 2, 2) of offsets in the earlier picture to those in a camera's; which are no slivers."""
        inverse = np.maximum(patches.inverse_per_m, 1e-4)[:, None, None]
        around, valid = camera.project(patches.origins_m[:, None] + patches.side_directions / inverse)
        sides = np.stack([around[:, 1] - around[:, 0], around[:, 3] - around[:, 2]], axis=-1)
        shapes = sides / (2.0 * HALF * self._step)
        flat = np.where(np.isfinite(shapes), shapes, 0.0)
        return shapes, valid.all(axis=1) & (np.abs(np.linalg.det(flat)) > 0.1)

    def at(self, patches: _Patches, view: FloatArray, reach_rad: float) -> AgreedView | None:
        """Search for the patches where a view puts them; None if nothing agrees."""
        camera = self._camera(view)
        pan_rad, tilt_rad = view.tolist()
        seen = pixel_rates(self._rig, JOINT_NAMES, self._name, pan_rad, tilt_rad, patches.points_m())
        expected, rates = seen.pixels_px, seen.to_rig
        shapes, usable = self._shapes(camera, patches)
        usable &= self._later.holds(self._later.from_full(expected), HALF + 1)
        open_px = np.zeros_like(expected)
        if (patches.unsure_per_m > 0).any():
            near, far = (camera.project(patches.points_m(share))[0] for share in (1.0, -1.0))
            open_px = (near - far) / 2
        usable &= np.isfinite(rates).all(axis=(1, 2)) & np.isfinite(open_px).all(axis=1)
        if usable.sum() < LEAST_PATCHES - 1:
            return None
        rates, open_px = rates[usable], open_px[usable]
        places = self._later.from_full(expected[usable])
        centres = np.rint(places).astype(int)
        wanted = cut(self._earlier, patches.places[usable], shapes[usable], centres, places)
        farthest = reach_rad * float(np.abs(rates).max()) / self._step + 2.0
        reaches = np.ceil(farthest + np.abs(open_px) / self._step).astype(int)
        each = zip(wanted, centres, reaches, strict=True)
        places_found, scores = map(
            np.array, zip(*(found(patch, self._later, *where) for patch, *where in each), strict=True)
        )
        off = (places_found - centres) * self._step
        good = (scores >= LEAST_CORRELATION) & np.isfinite(off).all(axis=1)
        return agreed_view(view, off[good], rates[good], open_px[good], scores[good], self._step, len(places))

    def anywhere(self, patches: _Patches) -> AgreedView | None:
        """The view that the later picture shows, wherever; None if it shows nothing of the earlier one."""
        fits = []
        for start in (self._before_rad, *self._voted(patches)):
            fit = self.at(patches, start, CLUSTER_RAD)
            if fit is not None and fit.agreeing >= LEAST_PATCHES - 1:
                fits.append(self.at(patches, fit.angles_rad, FLOOR_RAD) or fit)
        good = [fit for fit in fits if _enough(fit, ANYWHERE)]
        return max(good, key=lambda fit: (fit.agreeing, fit.correlation), default=None)

    def _voted(self, patches: _Patches) -> list[FloatArray]:
        """Views that several patches vote for, searched in the whole picture as seen from three views."""
        size, reported = self._later.size, self._reported_rad
        votes: list[list[float]] = []
        points = patches.points_m()
        model = self._rig.cameras[self._name].model
        for share in (0.0, 0.5, 1.0):
            view = self._before_rad + share * (reported - self._before_rad)
            shapes, usable = self._shapes(self._camera(view), patches)
            if not usable.any():
                continue
            places = patches.places[usable]
            wanted = cut(self._earlier, places, shapes[usable], np.rint(places).astype(int), places)
            for point_m, patch in zip(points[usable], wanted, strict=True):
                seen, score = found(patch, self._later, size // 2, size)
                if score < LEAST_CORRELATION:
                    continue
                try:
                    best = solve(
                        self._rig.mast, model, point_m, self._later.to_full(seen),
                        from_pan_rad=float(reported[0]), from_tilt_rad=float(reported[1]),
                    )[0]  # fmt: skip
                except CalibError:
                    continue
                votes.append([best.pan_rad, best.tilt_rad])
        if len(votes) < LEAST_PATCHES - 1:
            return []
        all_votes = np.array(votes)
        near = np.asarray((np.abs(all_votes[:, None] - all_votes[None]) < CLUSTER_RAD).all(axis=2))
        starts: list[FloatArray] = []
        left = np.ones(len(all_votes), dtype=bool)
        while len(starts) < 3:
            counts = (near & left).sum(axis=1) * left
            best_vote = int(np.argmax(counts))
            if counts[best_vote] < LEAST_PATCHES - 2:
                break
            starts.append(np.median(all_votes[near[best_vote] & left], axis=0))
            left &= ~near[best_vote]
        return starts


def _spread(which: NDArray[np.intp]) -> NDArray[np.intp]:
    """As many as are searched for, evenly, so that no one thing of strong contrast has them all."""
    if len(which) <= MOST_PATCHES:
        return which
    return np.asarray(which[np.linspace(0, len(which) - 1, MOST_PATCHES).round().astype(int)])
