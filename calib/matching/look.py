"""Follow one target while the rover moves: predicted, found in both cameras, filtered, or said to be lost.

The state is the target's position in the rover frame with its covariance (`calib.matching.track`). A look
(`seen_by`) warps the key picture of the target through its surface into each camera as that camera would see
it now (`calib.matching.patch`), so that neither scale nor slant nor the change to another camera spoils the
correlation; finds it near the prediction; and takes it only if both cameras, the prediction and the picture
mean the same point.

A target that is not found is ``lost``: the state goes on by rover motion alone, its covariance grows, and
with it the window of the next look. It is found again by the same rules, so that another rock does not take
its place.

Whether pictures contradict the motion that a track was carried over: it has the covariance that was stated of
the motion; the pictures after it show where the target is without that. How far the two lie apart, against
the covariance of both, is chi-square. Once in a thousand looks an honest motion is off by so much; below that
nothing is said.
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
from calib.matching.patch import match_patch
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
from calib.matching.verdict import PatchMatch
from calib.matching.warp import Plane, PosedImage

STEPS = 20
"""Gauss-Newton steps at most: near a camera the first ones are long..."""
ENOUGH = 1e-4
"""...and the step, in sigmas of the point, after which no more are made."""


@dataclass(frozen=True, eq=False)
class PixelSighting:
    """A pixel (2,) with its covariance (2, 2), px², in a camera of the point's frame."""

    camera: CameraModel
    pixel_px: FloatArray
    covariance_px2: FloatArray


@dataclass(frozen=True, eq=False)
class OnePoint:
    """The point (3,), metres, its covariance (3, 3), and the weighted sum of squares of what is left over."""

    position_m: FloatArray
    covariance_m2: FloatArray
    chi2: float


def one_point(
    believed_m: FloatArray, covariance_m2: FloatArray, sightings: Iterable[PixelSighting], model_px: float
) -> OnePoint | None:
    """Return the point that fits a believed position and pixels best, by least squares.

    Parameters
    ----------
    believed_m, covariance_m2
        (3,) and (3, 3), in the cameras' common frame.
    sightings
        What the cameras see.
    model_px
        One sigma of what each camera's model is wrong by, added to each pixel.

    Returns
    -------
    point
        None if a camera cannot see where the point comes to lie, or the steps do not settle.
    """
    seen = list(sightings)
    weights = [np.linalg.inv(one.covariance_px2 + model_px**2 * np.eye(2)) for one in seen]
    prior = np.linalg.inv(covariance_m2 + 1e-12 * np.eye(3))
    position, normal, chi2 = believed_m.copy(), prior, 0.0
    for _ in range(STEPS):
        off = believed_m - position
        normal, right, chi2 = prior.copy(), prior @ off, float(off @ prior @ off)
        for one, weight in zip(seen, weights, strict=True):
            pixel, rate, valid = one.camera.project_jacobian(position)
            if not bool(valid):
                return None
            rest = one.pixel_px - pixel
            normal += rate.T @ weight @ rate
            right += rate.T @ weight @ rest
            chi2 += float(rest @ weight @ rest)
        step = np.linalg.solve(normal, right)
        position = position + step
        if step @ right < ENOUGH**2:
            return OnePoint(position, np.linalg.inv(normal), chi2)
    return None


@dataclass(frozen=True, eq=False)
class PoseDoubt:
    """The evidence of pictures against a motion.

    Attributes
    ----------
    off_m
        (3,) where the pictures put the target less where the motion did, rover frame of now.
    sigmas
        How unlikely that is by chance, as a normal error's number of sigmas.
    sure
        Whether what was found is the track's target by the rules of a look; else it may be another thing.
    """

    off_m: FloatArray
    sigmas: float
    sure: bool = True

    @property
    def sentence(self) -> str:
        """It in words."""
        off = f"{100 * float(np.linalg.norm(self.off_m)):.1f} cm ({self.sigmas:.1f} sigma)"
        if self.sure:
            return (
                f"the pictures put the target {off} from where the pose does: the pose is wrong by more than "
                "its covariance says"
            )
        return (
            f"the pictures show what looks like the target {off} from where the pose puts it: the pose is "
            "wrong by more than its covariance says, or that is another thing"
        )


def pose_doubt(
    believed_m: FloatArray, covariance_m2: FloatArray, seen: OnePoint, sure: bool = True
) -> PoseDoubt | None:
    """Return what a seen place says against a believed one; None if it says nothing that chance does not.

    Parameters
    ----------
    believed_m, covariance_m2
        (3,) and (3, 3) of the target as the motion carried it.
    seen
        The target by the pictures alone.
    sure
        As `PoseDoubt.sure`.
    """
    off = seen.position_m - believed_m
    statistic = float(off @ np.linalg.solve(covariance_m2 + seen.covariance_m2, off))
    probability = chance(statistic, 3)
    return PoseDoubt(off, sigmas(probability), sure) if probability < Level.STATED else None


UNKNOWN_M = 100.0
"""One sigma of where a target is of which only the pictures show."""


@dataclass(frozen=True, eq=False)
class TrackLook:
    """The result of one look.

    Attributes
    ----------
    track
        The track after it.
    found
        By camera name: the match in that camera, with its verdict.
    reason
        Why the target counts as lost, one sentence; empty while it is tracked.
    chi2
        The weighted misfit of pixels and prediction; not-a-number if nothing was found.
    renewed
        Whether the key picture is now from this look.
    doubt
        The evidence of both cameras against the motion since the last look, if any; the target may be tracked
        all the same.
    """

    track: Track
    found: Mapping[str, PatchMatch] = field(default_factory=dict)
    reason: str = ""
    chi2: float = math.nan
    renewed: bool = False
    doubt: PoseDoubt | None = None


def seen_by(track: Track, eyes: Mapping[str, PosedImage], settings: TrackSettings | None = None) -> TrackLook:
    """Look for the target in one or two new pictures, and update the track.

    Parameters
    ----------
    eyes
        By camera name: one picture, or those of a stereo pair (left first) of one moment, cameras in the
        rover frame. A frame that is missing is left out; one camera alone serves while the target is tracked.
    """
    settings = settings or TrackSettings()
    look = _seen(track, eyes, settings)
    if look.track.state == "lost" and track.standby is not None and eyes:
        again = _seen(replace(track, key=track.standby, standby=None), eyes, settings)
        look = replace(again, renewed=True) if again.track.state == "tracked" else look
    if look.track.state == "lost" and look.doubt is None and track.state == "tracked":
        look = replace(look, doubt=_seen_elsewhere(track, eyes, settings))
    return look


def _seen_elsewhere(
    track: Track, eyes: Mapping[str, PosedImage], settings: TrackSettings
) -> PoseDoubt | None:
    """What a wider window shows of a target that is not where the motion since the last look put it.

    Both cameras must know the key picture well and mean one point. The target stays lost all the same: so far
    off, the next rock may look like it.
    """
    key = anchored(track)
    if key is None or len(eyes) < 2 or not track.motion_covariance.any():
        return None
    plane, wide = Plane(track.position_m, track.key.normal), replace(settings, least_px=settings.most_px)
    found = {name: _found(track, key, plane, eye, wide) for name, eye in eyes.items()}
    if any(m.verdict != "good" or m.correlation < settings.renew_below for m in found.values()):
        return None
    seen = _by_pictures(track.position_m, found, eyes, settings)
    if seen is None or seen.chi2 > MOST_SIGMAS**2:
        return None
    return pose_doubt(track.position_m, track.covariance_m2, seen, sure=False)


def _by_pictures(
    start_m: FloatArray,
    good: Mapping[str, PatchMatch],
    eyes: Mapping[str, PosedImage],
    settings: TrackSettings,
) -> OnePoint | None:
    """The point that pixels mean without the prediction; ``chi2`` says how badly they meet."""
    sightings = [PixelSighting(eyes[n].camera, m.pixel_px, m.covariance_px2) for n, m in good.items()]
    return one_point(start_m, UNKNOWN_M**2 * np.eye(3), sightings, settings.model_px)


def _seen(track: Track, eyes: Mapping[str, PosedImage], settings: TrackSettings) -> TrackLook:
    """Look with the track's key."""
    key = anchored(track)
    if key is None:
        return _lost(
            track, {}, "the surface of the target is not visible from where its key picture was taken"
        )
    plane = Plane(track.position_m, track.key.normal)
    found, slope = _matched(track, key, plane, eyes, settings)
    good = {name: one for name, one in found.items() if one.verdict == "good"}
    reason = _not_confirmed(track, found, good)
    if reason:
        return _lost(track, found, reason)
    point = one_point(
        track.position_m,
        track.covariance_m2,
        [PixelSighting(eyes[n].camera, m.pixel_px, m.covariance_px2) for n, m in good.items()],
        settings.model_px,
    )
    if point is None:
        return _lost(track, found, "the found pixels and the prediction have no point in common")
    chi2 = point.chi2
    against = None
    if len(good) > 1 and track.motion_covariance.any():
        seen = _by_pictures(point.position_m, good, eyes, settings)
        against = None if seen is None else pose_doubt(track.position_m, track.covariance_m2, seen)
    # Each eye beyond the first adds a constraint; one eye alone has two.
    allowed = settings.worst_chi2 if len(good) > 1 else 13.8
    if chi2 > allowed:
        words = (
            f"the match does not fit the prediction: weighted misfit {chi2:.0f}, at most "
            f"{allowed:g} is expected"
        )
        unsure = against and replace(against, sure=False)
        return replace(_lost(track, found, words), chi2=chi2, doubt=unsure)
    turned = _turned(track, point.position_m)
    corrected = carried(track.key, turned)
    fresh = fresh_key(track.key, eyes, good, plane, slope)
    renewed = fresh is not None and outgrown(track.key, eyes, good, plane, settings)
    chosen = fresh if fresh is not None and renewed else corrected
    drift_m = drifted_m(chosen)
    if drift_m > settings.worst_drift_m:
        words = (
            f"the place that is followed may have drifted by {100 * drift_m:.0f} cm from the one picked, at "
            f"most {100 * settings.worst_drift_m:g} cm are allowed: the surface around it is no plane"
        )
        return replace(_lost(track, found, words), chi2=chi2, doubt=against)
    standby = None if renewed else fresh or (track.standby and carried(track.standby, turned))
    after = Track("tracked", point.position_m, point.covariance_m2, chosen, standby)
    return TrackLook(after, found, "", chi2, renewed, against)


def _matched(
    track: Track, key: KeyPicture, plane: Plane, eyes: Mapping[str, PosedImage], settings: TrackSettings
) -> tuple[dict[str, PatchMatch], Plane | None]:
    """Look in every picture by the key; return also the surface of a camera asked by the other."""
    found = {name: _found(track, key, plane, eye, settings) for name, eye in eyes.items()}
    alone = [one for one in found.values() if one.verdict == "good"]
    # Stereo confirms whatever one eye has found: of a lost target that eye must know the key picture well.
    if len(alone) == 1 < len(found) and (
        track.state == "tracked" or alone[0].correlation >= settings.renew_below
    ):
        return _asked_the_other(found, eyes)
    return found, None


def _not_confirmed(track: Track, found: Mapping[str, PatchMatch], good: Mapping[str, PatchMatch]) -> str:
    """Return why what was found does not count; empty if it does."""
    if not good:
        words = "; ".join(f"{name}: {one.reason}" for name, one in found.items())
        return words or "no picture was given"
    doubt = next((f"{n}: {m.reason}" for n, m in found.items() if m.verdict in ("weak", "ambiguous")), "")
    if doubt:
        return f"one camera does not confirm the other: {doubt}"
    if len(good) == 1 and track.state == "lost":
        return "one camera alone does not find a lost target again"
    return ""


def _turned(track: Track, position_m: FloatArray) -> Rigid:
    """The motion's error that a found position shows, as far as it is the motion's.

    A heading off by half a degree puts a target 10 m away 9 cm off. Were the key camera shifted by as much
    instead of turned, it would look at flat ground under another angle, and steps would add up.
    """
    weight = track.motion_covariance @ motion_rate(track.position_m).T
    spread = track.covariance_m2 + 1e-12 * np.eye(3)
    error = weight @ np.linalg.solve(spread, position_m - track.position_m)
    return moved_rigid(Rigid.identity(), error)


def _found(
    track: Track, key: KeyPicture, plane: Plane, eye: PosedImage, settings: TrackSettings
) -> PatchMatch:
    """Look in one picture, in the window that the prediction's covariance asks for."""
    _, rate, valid = eye.camera.project_jacobian(track.position_m)
    spread = rate @ track.covariance_m2 @ rate.T if bool(valid) else np.eye(2)
    reach = settings.sigmas * math.sqrt(max(float(np.linalg.eigvalsh(spread)[-1]), 0.0))
    search = min(max(reach + 2 * settings.model_px, settings.least_px), settings.most_px)
    return match_patch(key.view, key.pixel_px, plane, eye, search, SIZES)


def _asked_the_other(
    found: Mapping[str, PatchMatch], eyes: Mapping[str, PosedImage]
) -> tuple[dict[str, PatchMatch], Plane | None]:
    """Look from the camera that found the target into the one that did not; return also its surface.

    The place in the other camera is as uncertain as that in the first, seen over the surface, and its own
    match. On a rock the two cameras see the surface more differently than one camera sees it before and after
    a step.
    """
    seen = next(name for name, one in found.items() if one.verdict == "good")
    other = next(name for name in found if name != seen)
    one, two = eyes[seen], eyes[other]
    partner = find_partner(one, found[seen].pixel_px, two, settings=SIZES)
    if partner.match.verdict != "good" or partner.plane is None:
        return dict(found), None
    on_plane = on_surface(found[seen].covariance_px2, one.camera, partner.plane)
    _, rate, _ = two.camera.project_jacobian(partner.plane.point_m)
    covariance = partner.match.covariance_px2 + rate @ on_plane @ rate.T
    return dict(found) | {other: replace(partner.match, covariance_px2=covariance)}, partner.plane


def _lost(track: Track, found: Mapping[str, PatchMatch], reason: str) -> TrackLook:
    return TrackLook(replace(track, state="lost", misses=track.misses + 1), found, reason)
