"""Which view a picture shows: its joint angles by what it shares with an earlier picture of the same camera.

Some twenty textured patches of the earlier picture are looked for where the joint angles reported for the
later one put them. Every found patch is a vote for two angles; the view is the majority's. If that is not the
reported one, or none is found, the patches are looked for in the whole picture, and the angles solved for.

Rotation moves a picture as a whole, whatever its range; the camera's own way with the head moves near things
further. Ranges come from the other camera of the earlier moment where there is one. Without it a patch may be
at any range from ``nearest_m`` on, and what that leaves open of the angles is the bound ``parallax_rad``.

Not decided here: what follows from a contradiction. Not reported here: changes below the tolerance of
`Limits`, which joints with play make themselves, and a picture of another moment of the same view.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.patch_search import AgreedView
from calib.matching.same_patches import LEAST_PATCHES, Comparison, Posed, spread

Verdict = Literal["seen", "small_move", "contradicted", "unlike", "too_plain", "no_overlap"]


@dataclass(frozen=True)
class ViewLimits:
    """The allowed difference of reported and shown angles.

    Attributes
    ----------
    floor_rad
        Of each joint: what a sound head leaves between readings and pictures of two poses. The full
        backlash of a 12-bit servo is 4.4 mrad, half a count at either end 1.5 mrad together.
    share
        Of the way between the poses: camera models of that quality.
    sigmas
        Of the fit: 5.3 is one chance in a million for two angles.
    nearest_m
        Nothing is nearer to the camera.
    """

    floor_rad: float = 7e-3
    share: float = 0.01
    sigmas: float = 5.3
    nearest_m: float = 0.4


@dataclass(frozen=True)
class ShownView:
    """The view that a picture shows.

    Attributes
    ----------
    verdict
        ``seen``: the reported one. ``small_move``: the reported one, but the way is so small that the picture
        of before would pass too, or that the shown view is as near to the one before. ``contradicted``:
        another one. ``unlike``: nothing of what the earlier picture shows, though much of it should be there.
        ``too_plain``: too little texture, or a pattern that fits both views. ``no_overlap``: the reported
        view shares too little with the earlier one, and the picture shows none of it either.
    pan_rad, tilt_rad
        The shown view; not-a-number if none was found.
    off_rad
        Shown less reported, (pan, tilt).
    sigma_rad, parallax_rad
        One sigma of the fit, and the largest error by ranges that are not known, (pan, tilt).
    allowed_rad
        How large ``off_rad`` may be, (pan, tilt).
    off_px
        How far the shown view moves the patches against the reported one, root of the mean square.
    agreeing, expected
        Patches that agree on the view, and that it should show.
    """

    verdict: Verdict
    pan_rad: float = math.nan
    tilt_rad: float = math.nan
    off_rad: tuple[float, float] = (math.nan, math.nan)
    sigma_rad: tuple[float, float] = (math.nan, math.nan)
    parallax_rad: tuple[float, float] = (math.nan, math.nan)
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
    limits: ViewLimits | None = None,
) -> ShownView:
    """Return which view a later picture of a head camera shows.

    The angles reported for the picture ``before`` are believed, those for ``after`` are checked. ``beside``
    is name and picture of the other camera at the earlier moment, for ranges.
    """
    limits = limits or ViewLimits()
    pictures = Comparison(rig, camera, before, after, limits.nearest_m, limits.floor_rad)
    reported = pictures.reported_rad
    way = np.abs(reported - before.angles_rad)
    every, inside = pictures.patches(beside)
    if len(every.places) < LEAST_PATCHES:
        return ShownView("too_plain", expected=len(every.places))
    overlaps = len(inside.places) >= LEAST_PATCHES
    if overlaps:
        fit = pictures.at(inside, reported, 1.5 * limits.floor_rad)
        if fit is not None and fit.holds("reported"):
            shown = _shown(fit, reported, way, limits)
            if shown.verdict == "contradicted":
                fit = pictures.at(inside, fit.angles_rad, limits.floor_rad) or fit
                return _shown(fit, reported, way, limits)
            if shown.verdict == "seen":
                rival = pictures.at(inside, np.array(before.angles_rad), limits.floor_rad)
                if rival is not None and rival.agreeing >= 0.8 * fit.agreeing:
                    stayed = np.abs(rival.angles_rad - before.angles_rad) <= limits.floor_rad
                    if stayed.all():
                        # The same match, between the two views: the head played back. Else a pattern.
                        if (np.abs(rival.angles_rad - fit.angles_rad) <= limits.floor_rad / 2).all():
                            return replace(shown, verdict="small_move")
                        return ShownView("too_plain", expected=fit.expected, agreeing=fit.agreeing)
            return shown
    known = inside if overlaps else every.some(spread(np.arange(len(every.places))))
    fit = pictures.anywhere(known)
    if fit is not None:
        return _shown(fit, reported, way, limits)
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


def _shown(fit: AgreedView, reported: FloatArray, way: FloatArray, limits: ViewLimits) -> ShownView:
    """What a fit says about the reported view."""
    off = fit.angles_rad - reported
    allowed = (
        limits.floor_rad + limits.share * float(way.max()) + fit.parallax_rad + limits.sigmas * fit.sigma_rad
    )
    if (np.abs(off) > allowed).any():
        verdict: Verdict = "contradicted"
    else:
        verdict = "small_move" if (way <= allowed).all() else "seen"
    off_rad, sigma_rad, parallax_rad, allowed_rad = (
        (float(pan), float(tilt)) for pan, tilt in (off, fit.sigma_rad, fit.parallax_rad, allowed)
    )
    off_px = float(np.sqrt(((fit.rate_px_per_rad @ off) ** 2).sum(axis=1).mean()))
    pan_rad, tilt_rad = fit.angles_rad.tolist()
    return ShownView(
        verdict,
        pan_rad,
        tilt_rad,
        off_rad,
        sigma_rad,
        parallax_rad,
        allowed_rad,
        off_px,
        fit.agreeing,
        fit.expected,
    )
