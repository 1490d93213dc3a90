"""Follow one target while the rover moves: predicted, found in both cameras, filtered, or reported as lost.

The state is the target's position in the rover frame with its covariance (`calib.matching.track`). Each time
(`seen_by`) the key picture of the target is warped through its surface into each camera as that camera would
see it now (`calib.matching.patch`), so that neither scale nor slant nor the change to another camera spoils
the correlation; found near the prediction; and accepted only if both cameras, the prediction and the picture
mean the same point.

A target that is not found is ``lost``: the state goes on by rover motion alone, its covariance grows, and
with it the window of the next search. It is found again by the same rules, so that another rock does not take
its place.

Whether pictures contradict the motion that a track was carried over: it has the covariance that was stated of
the motion; the pictures after it show where the target is without that. How far the two lie apart, against
the covariance of both, is chi-square. Once in a thousand times an honest motion is off by so much; below that
nothing is reported.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import MOST_SIGMAS
from calib.geometry.rigid import FloatArray, Rigid, moved_rigid
from calib.geometry.significance import Level, chance, sigmas
from calib.matching.partner import find_partner
from calib.matching.patch import PatchMatch, match_patch, worst_px2
from calib.matching.track import (
    SIZES,
    KeyPicture,
    Track,
    TrackSettings,
    anchored,
    carried,
    drifted_m,
    fresh_key,
    motion_rate,
    on_surface,
    outgrown,
)
from calib.matching.warp import Plane, PosedImage

STEPS = 20
"""Gauss-Newton steps at most: near a camera the first ones are long..."""


UNKNOWN_M = 100.0
"""One sigma of where a target is of which only the pictures show."""

PixelSighting = tuple[CameraModel, FloatArray, FloatArray]
"""A camera in the point's frame, a pixel (2,), and its covariance (2, 2), px²."""

Images = Mapping[str, PosedImage]
"""By camera name, left first."""


@dataclass(frozen=True, eq=False)
class OnePoint:
    """The point (3,), metres, its covariance (3, 3), and the weighted sum of squares of what is left over."""

    position_m: FloatArray
    covariance_m2: FloatArray
    chi2: float


def one_point(
    believed_m: FloatArray, covariance_m2: FloatArray, sightings: Iterable[PixelSighting], model_px: float
) -> OnePoint | None:
    """Return the point that fits a believed position (3,), with its covariance, and pixels best.

    ``model_px`` is one sigma of what each camera's model is wrong by, added to each pixel. None if a camera
    cannot see where the point comes to lie, or the steps do not settle.
    """
    model_px2 = model_px**2 * np.eye(2)
    seen = [(camera, pixel, np.linalg.inv(noise + model_px2)) for camera, pixel, noise in sightings]
    prior = np.linalg.inv(covariance_m2 + 1e-12 * np.eye(3))
    position = believed_m.copy()
    for _ in range(STEPS):
        off = believed_m - position
        normal, right, chi2 = prior.copy(), prior @ off, float(off @ prior @ off)
        for camera, found_px, weight in seen:
            pixel, rate, valid = camera.project_jacobian(position)
            if not bool(valid):
                return None
            rest = found_px - pixel
            normal += rate.T @ weight @ rate
            right += rate.T @ weight @ rest
            chi2 += float(rest @ weight @ rest)
        step = np.linalg.solve(normal, right)
        position = position + step
        # 1e-4: and the step, in sigmas of the point, after which no more are made.
        if step @ right < 1e-4**2:
            return OnePoint(position, np.linalg.inv(normal), chi2)
    return None


def pose_doubt(believed_m: FloatArray, covariance_m2: FloatArray, seen: OnePoint, sure: bool = True) -> str:
    """Return what a place by the pictures alone says against a believed one, as the motion carried it.

    One sentence, empty if it says nothing that chance does not. ``sure``: what was found is the track's
    target by the rules of `seen_by`; else it may be another thing.
    """
    off = seen.position_m - believed_m
    probability = chance(float(off @ np.linalg.solve(covariance_m2 + seen.covariance_m2, off)), 3)
    if probability >= Level.STATED:
        return ""
    size = f"{100 * float(np.linalg.norm(off)):.1f} cm ({sigmas(probability):.1f} sigma)"
    wrong = "the pose is wrong by more than its covariance says"
    if sure:
        return f"the pictures put the target {size} from where the pose does: {wrong}"
    return (
        f"the pictures show what looks like the target {size} from where the pose puts it: {wrong}, "
        "or that is another thing"
    )


@dataclass(frozen=True, eq=False)
class TrackSearch:
    """The track after one search, and the match in each camera, by name.

    ``reason`` is why the target is lost, one sentence; empty while it is tracked. ``chi2`` is the weighted
    misfit of pixels and prediction, not-a-number if nothing was found; ``renewed``: the key picture is now
    one of these. ``doubt`` is the evidence of both cameras against the motion since the last search
    (`pose_doubt`); the target may be tracked all the same.
    """

    track: Track
    found: Mapping[str, PatchMatch] = field(default_factory=dict)
    reason: str = ""
    chi2: float = math.nan
    renewed: bool = False
    doubt: str = ""


def seen_by(track: Track, images: Images, settings: TrackSettings | None = None) -> TrackSearch:
    """Search for the target in one or two new pictures of one moment, and update the track.

    The cameras are in the rover frame. One camera alone serves while the target is tracked.
    """
    settings = settings or TrackSettings()
    result = _seen(track, images, settings)
    if result.track.state == "lost" and track.standby is not None and images:
        again = _seen(replace(track, key=track.standby, standby=None), images, settings)
        result = replace(again, renewed=True) if again.track.state == "tracked" else result
    if result.track.state == "lost" and not result.doubt and track.state == "tracked":
        result = replace(result, doubt=_seen_elsewhere(track, images, settings))
    return result


def _seen_elsewhere(track: Track, images: Images, settings: TrackSettings) -> str:
    """What a wider window shows of a target that is not where the motion since the last search put it.

    Both cameras must know the key picture well and mean one point. The target stays lost all the same: so far
    off, the next rock may resemble it.
    """
    key = anchored(track)
    if key is None or len(images) < 2 or not track.motion_covariance.any():
        return ""
    plane, wide = Plane(track.position_m, track.key.normal), replace(settings, least_px=settings.most_px)
    found = {name: _found(track, key, plane, image, wide) for name, image in images.items()}
    if any(m.verdict != "good" or m.correlation < settings.renew_below for m in found.values()):
        return ""
    seen = one_point(track.position_m, UNKNOWN_M**2 * np.eye(3), _pixels(found, images), settings.model_px)
    if seen is None or seen.chi2 > MOST_SIGMAS**2:
        return ""
    return pose_doubt(track.position_m, track.covariance_m2, seen, sure=False)


def _pixels(good: Mapping[str, PatchMatch], images: Images) -> list[PixelSighting]:
    return [(images[name].camera, one.pixel_px, one.covariance_px2) for name, one in good.items()]


def _seen(track: Track, images: Images, settings: TrackSettings) -> TrackSearch:
    """Search by the track's key."""
    key = anchored(track)
    if key is None:
        return _lost(
            track, {}, "the surface of the target is not visible from where its key picture was taken"
        )
    plane = Plane(track.position_m, track.key.normal)
    found, slope = _matched(track, key, plane, images, settings)
    good = {name: one for name, one in found.items() if one.verdict == "good"}
    reason = _not_confirmed(track, found, good)
    if reason:
        return _lost(track, found, reason)
    sightings = _pixels(good, images)
    point = one_point(track.position_m, track.covariance_m2, sightings, settings.model_px)
    if point is None:
        return _lost(track, found, "the found pixels and the prediction have no point in common")
    # 13.8: as `TrackSettings.worst_chi2`, of the two pixel coordinates of one camera.
    allowed = settings.worst_chi2 if len(good) > 1 else 13.8
    doubt = ""
    if len(good) > 1 and track.motion_covariance.any():
        seen = one_point(point.position_m, UNKNOWN_M**2 * np.eye(3), sightings, settings.model_px)
        if seen is not None:
            doubt = pose_doubt(track.position_m, track.covariance_m2, seen, sure=point.chi2 <= allowed)
    if point.chi2 > allowed:
        reason = (
            f"the match does not fit the prediction: weighted misfit {point.chi2:.0f}, at most "
            f"{allowed:g} is expected"
        )
        return replace(_lost(track, found, reason), chi2=point.chi2, doubt=doubt)
    turned = _turned(track, point.position_m)
    fresh = fresh_key(track.key, images, good, plane, slope)
    renewed = fresh is not None and outgrown(track.key, images, good, plane, settings)
    chosen = fresh if fresh is not None and renewed else carried(track.key, turned)
    drift_m = drifted_m(chosen)
    if drift_m > settings.worst_drift_m:
        reason = (
            f"the place that is followed may have drifted by {100 * drift_m:.0f} cm from the one picked, at "
            f"most {100 * settings.worst_drift_m:g} cm are allowed: the surface around it is no plane"
        )
        return replace(_lost(track, found, reason), chi2=point.chi2, doubt=doubt)
    standby = None if renewed else fresh or (track.standby and carried(track.standby, turned))
    after = Track("tracked", point.position_m, point.covariance_m2, chosen, standby)
    return TrackSearch(after, found, "", point.chi2, renewed, doubt)


def _matched(
    track: Track, key: KeyPicture, plane: Plane, images: Images, settings: TrackSettings
) -> tuple[dict[str, PatchMatch], Plane | None]:
    """Search every picture by the key; return also the surface, where one camera was searched by the other.

    On a rock the two cameras see the surface more differently than one camera sees it before and after a
    step. Stereo confirms whatever one camera has found: of a lost target it must know the key picture well.
    """
    found = {name: _found(track, key, plane, image, settings) for name, image in images.items()}
    alone = [name for name, one in found.items() if one.verdict == "good"]
    if len(alone) != 1 or len(found) == 1:
        return found, None
    first, one = alone[0], images[alone[0]]
    if track.state == "lost" and found[first].correlation < settings.renew_below:
        return found, None
    other = next(name for name in found if name != first)
    partner = find_partner(one, found[first].pixel_px, images[other], settings=SIZES)
    if partner.match.verdict != "good" or partner.plane is None:
        return found, None
    # As uncertain as the place in the first camera, seen over the surface, and its own match.
    on_plane = on_surface(found[first].covariance_px2, one.camera, partner.plane)
    _, rate, _ = images[other].camera.project_jacobian(partner.plane.point_m)
    covariance = partner.match.covariance_px2 + rate @ on_plane @ rate.T
    return found | {other: replace(partner.match, covariance_px2=covariance)}, partner.plane


def _not_confirmed(track: Track, found: Mapping[str, PatchMatch], good: Mapping[str, PatchMatch]) -> str:
    """Return why what was found is not accepted; empty if it is."""
    if not good:
        return "; ".join(f"{name}: {one.reason}" for name, one in found.items()) or "no picture was given"
    for name, one in found.items():
        if one.verdict in ("weak", "ambiguous"):
            return f"one camera does not confirm the other: {name}: {one.reason}"
    if len(good) == 1 and track.state == "lost":
        return "one camera alone does not find a lost target again"
    return ""


def _turned(track: Track, position_m: FloatArray) -> Rigid:
    """The motion's error that a found position shows, as far as it is the motion's.

    A heading off by half a degree puts a target 10 m away 9 cm off. Were the key camera shifted by as much
    instead of turned, it would see flat ground under another angle, and steps would add up.
    """
    weight = track.motion_covariance @ motion_rate(track.position_m).T
    spread = track.covariance_m2 + 1e-12 * np.eye(3)
    error = weight @ np.linalg.solve(spread, position_m - track.position_m)
    return moved_rigid(Rigid.identity(), error)


def _found(
    track: Track, key: KeyPicture, plane: Plane, image: PosedImage, settings: TrackSettings
) -> PatchMatch:
    """Search one picture, in the window that the prediction's covariance needs."""
    _, rate, valid = image.camera.project_jacobian(track.position_m)
    spread = rate @ track.covariance_m2 @ rate.T if bool(valid) else np.eye(2)
    reach = settings.sigmas * math.sqrt(max(worst_px2(spread), 0.0))
    search = min(max(reach + 2 * settings.model_px, settings.least_px), settings.most_px)
    return match_patch(key.view, key.pixel_px, plane, image, search, SIZES)


def _lost(track: Track, found: Mapping[str, PatchMatch], reason: str) -> TrackSearch:
    return TrackSearch(replace(track, state="lost", misses=track.misses + 1), found, reason)
