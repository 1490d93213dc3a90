"""Follow one target while the rover moves: predicted, found in both eyes, filtered, or said to be lost.

The state is the target's position in the rover frame with its covariance. A motion of the rover carries it
over and adds the motion's own covariance (`moved_track`). A look (`seen_by`) warps the key picture of the
target through its surface into each eye as that eye would see it now (`calib.pictures.patch_match`), so that
neither scale nor slant nor the change to another camera spoils the correlation; finds it near the prediction;
and takes it only if both eyes, the prediction and the picture mean the same point. The key picture is renewed
when scale or view have changed, not at every step: each renewal hands on its error.

A target that is not found is ``lost``: the state goes on by rover motion alone, its covariance grows, and
with it the window of the next look. It is found again by the same rules, so that another rock does not take
its place.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from calib.camera.cahvor import CameraModel
from calib.camera.one_point import OnePoint, Sighting, one_point
from calib.camera.stereo import triangulate
from calib.errors import CalibError
from calib.handoff.by_image import Eye
from calib.mast.ray_gap import MOST_SIGMAS, ray_gap, refuse_two_points
from calib.pictures.distinct import indistinct
from calib.pictures.epipolar import find_partner, normal_seen
from calib.pictures.patch_match import MatchSettings, PatchMatch, match_patch
from calib.pictures.warp import Plane
from calib.rigid import FloatArray, Rigid, carried_covariance, moved_rigid, rigid_rates
from calib.tracking.pose_doubt import PoseDoubt, pose_doubt

State = Literal["tracked", "lost"]

SIZES = MatchSettings(half_px=12, near_px=6.0, roughness=0.04, relief=0.1, worst_ratio=0.7, least_lead=0.03)
"""Smaller patches than a single match takes: seen flat from 10 m, 41 px of ground are 0.8 m long and no
plane, and what lies off the plane pulls the place along as the view steepens. Roughness and relief make nine
in ten and more of the range errors lie within two of the told sigmas. A second place may fit a little better
than elsewhere: the other eye and the prediction must confirm the best."""
MIDDLE_SEARCH_PX = 4.0
"""How far the range of a patch's middle may put it from where the whole patch puts it, at the start."""

UNKNOWN_M = 100.0
"""One sigma of where a target is of which only the pictures tell."""

EYES_PX = 0.4
"""One sigma, each pixel coordinate, of what two eyes' models may be wrong by where a track is begun: what is
found 2 px off the epipolar line is another thing, or the mast file is off."""


@dataclass(frozen=True)
class TrackSettings:
    """Thresholds of the tracking, with the reasons for their values.

    Attributes
    ----------
    sigmas
        Half width of the search window in standard deviations of the prediction.
    least_px, most_px
        Bounds of the window's half side.
    model_px
        One sigma of what the cameras' models are wrong by between two eyes and two pairs.
    worst_chi2
        Of the innovation, four pixel coordinates against the prior: 1 in 1000 good looks with both eyes is
        above 18.5.
    renew_grown, renew_shrunk
        The key picture is renewed when the target's surface is seen this much larger or smaller...
    renew_shape
        ...or foreshortened this much otherwise: seen flat, a step nearer shows much that it did not.
    renew_below
        Or when the correlation falls below this: what is seen now is no longer what the key picture shows.
        One eye that sees so little of it does not find a lost target again.
    worst_drift_m
        One sigma of the drift from the picked place; beyond it the target counts as lost.
    """

    sigmas: float = 3.5
    least_px: float = 4.0
    most_px: float = 120.0
    model_px: float = 0.12
    worst_chi2: float = 18.5
    renew_grown: float = 1.8
    renew_shrunk: float = 0.3
    renew_shape: float = 1.5
    renew_below: float = 0.8
    worst_drift_m: float = 0.03


@dataclass(frozen=True, eq=False)
class Key:
    """The picture that templates are cut from, its camera in the rover frame, the target's place in it.

    Attributes
    ----------
    drift_m2
        (3, 3) covariance, along the surface, of the place followed from the place picked: what the keys
        before handed on.
    """

    eye: Eye
    pixel_px: FloatArray
    normal: FloatArray
    drift_m2: FloatArray = field(default_factory=lambda: np.zeros((3, 3)))


@dataclass(frozen=True, eq=False)
class Track:
    """A followed target. Immutable: every step gives a new one.

    Attributes
    ----------
    state
        ``tracked``: the last look found it. ``lost``: it did not.
    position_m, covariance_m2
        (3,) and (3, 3) of the place that is followed, in the rover frame of the last motion.
    key
        The key picture.
    standby
        The key that the last look with both eyes would have given: what is looked for where a look by the
        key loses the target, since the light has changed or another side shows. None after a renewal.
    misses
        Looks since it was last found.
    motion_covariance
        (6, 6) of the rover's motion since then, as `moved_track` takes it; it is part of ``covariance_m2``.
    """

    state: State
    position_m: FloatArray
    covariance_m2: FloatArray
    key: Key
    standby: Key | None = None
    misses: int = 0
    motion_covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def target_covariance_m2(self) -> FloatArray:
        """(3, 3) of the target that was picked: of the followed place, and of its drift from the picked one.

        What pixels and motions tell; an error that all cameras of the mast file share is not in it, and one
        that two eyes do not share is averaged by looks from one place as if it were noise.
        """
        return self.covariance_m2 + self.key.drift_m2


@dataclass(frozen=True, eq=False)
class Look:
    """What one look told.

    Attributes
    ----------
    track
        The track after it.
    found
        By camera name: the match in that eye, with its verdict.
    reason
        Why the target counts as lost, one sentence; empty while it is tracked.
    chi2
        The weighted misfit of pixels and prediction; not-a-number if nothing was found.
    renewed
        Whether the key picture is now from this look.
    doubt
        What both eyes say against the motion since the last look, if they do; the target may be tracked all
        the same.
    """

    track: Track
    found: Mapping[str, PatchMatch] = field(default_factory=dict)
    reason: str = ""
    chi2: float = math.nan
    renewed: bool = False
    doubt: PoseDoubt | None = None


def start_track(left: Eye, right: Eye, left_px: FloatArray, sigma_px: float = 0.2) -> Track:
    """Begin a track from a click in the left picture of a pair.

    Parameters
    ----------
    left, right
        Pictures of one moment with their cameras in the rover frame.
    left_px
        (2,) the target.
    sigma_px
        Of the click; it says how well the place of what was meant is known.

    Raises
    ------
    CalibError
        With the reason, if the target cannot be followed: sky, plain surface, an edge, repeated pattern,
        hidden from the other eye, outside the picture.
    """
    pixel = np.asarray(left_px, dtype=np.float64)
    if pixel.shape != (2,) or not np.isfinite(pixel).all():
        raise CalibError(f"target pixel {pixel.tolist()} is not two finite numbers")
    width, height = left.camera.size_px
    if not (0 <= pixel[0] <= width - 1 and 0 <= pixel[1] <= height - 1):
        raise CalibError(
            f"the target pixel ({pixel[0]:.1f}, {pixel[1]:.1f}) is outside the picture of {width} x {height}"
        )
    found = find_partner(left.image, left.camera, pixel, right.image, right.camera)
    if found.match.verdict != "good" or found.plane is None:
        raise CalibError(f"the target cannot be followed: {found.match.reason}")
    # The patch that tells the surface reaches beyond it on a rock: the range is that of its middle.
    middle = match_patch(
        left.image, left.camera, pixel, found.plane, right.image, right.camera, MIDDLE_SEARCH_PX, SIZES
    )
    reason = middle.reason or indistinct(left.image, left.camera, pixel, found.plane, SIZES)
    if reason:
        raise CalibError(f"the target cannot be followed: {reason}")
    noise = max(sigma_px, float(middle.sigma_px.max()))
    seen = triangulate(left.camera, right.camera, pixel, middle.pixel_px, noise)
    gap = ray_gap(seen, (noise**2 + EYES_PX**2) * np.eye(4))
    by = f"a match good to {noise:.2g} px and cameras good to {EYES_PX:g} px"
    try:
        refuse_two_points(gap, ("the left eye", "the right eye"), by)
    except CalibError as error:
        raise CalibError(f"the target cannot be followed: {error}") from None
    key = Key(left, pixel, found.plane.normal)
    return Track("tracked", seen.position_m, seen.covariance_m2, key)


def moved_track(track: Track, now_from_then: Rigid, covariance: FloatArray) -> Track:
    """Carry a track over a motion of the rover.

    Parameters
    ----------
    now_from_then
        The rover frame of before in the one of now.
    covariance
        (6, 6) of that motion: small rotation (radians), then translation (metres), both in the frame of now:
        true = (1 + rotation) believed + translation.

    Raises
    ------
    CalibError
        If the covariance is not (6, 6), finite and without negative variances.
    """
    spread = np.asarray(covariance, dtype=np.float64)
    if spread.shape != (6, 6) or not np.isfinite(spread).all() or (np.diag(spread) < 0).any():
        raise CalibError(
            "a motion's covariance is 6 rows of 6 finite numbers: rotation in rad², then translation in m²"
        )
    position = now_from_then.points(track.position_m)
    rate, turned = _motion_rate(position), now_from_then.rotation
    return replace(
        track,
        position_m=position,
        covariance_m2=turned @ track.covariance_m2 @ turned.T + rate @ spread @ rate.T,
        key=_carried(track.key, now_from_then),
        standby=track.standby and _carried(track.standby, now_from_then),
        motion_covariance=carried_covariance(track.motion_covariance, now_from_then) + spread,
    )


def _motion_rate(position_m: FloatArray) -> FloatArray:
    """Return d position / d motion (3, 6): how a small rotation, then a translation, move a point."""
    return np.asarray(rigid_rates(np.eye(3)[None], position_m[None], np.zeros(3))[0])


def _carried(key: Key, motion: Rigid) -> Key:
    """The key in another frame."""
    return Key(
        replace(key.eye, camera=key.eye.camera.moved(motion)),
        key.pixel_px,
        motion.vectors(key.normal),
        motion.rotation @ key.drift_m2 @ motion.rotation.T,
    )


def seen_by(track: Track, eyes: Mapping[str, Eye], settings: TrackSettings | None = None) -> Look:
    """Look for the target in one or two new pictures, and update the track.

    Parameters
    ----------
    eyes
        By camera name: one picture, or those of a stereo pair (left first) of one moment, cameras in the
        rover frame. A frame that is missing is left out; one eye alone serves while the target is tracked.
    """
    settings = settings or TrackSettings()
    look = _seen(track, eyes, settings)
    if look.track.state == "lost" and track.standby is not None and eyes:
        again = _seen(replace(track, key=track.standby, standby=None), eyes, settings)
        look = replace(again, renewed=True) if again.track.state == "tracked" else look
    if look.track.state == "lost" and look.doubt is None and track.state == "tracked":
        look = replace(look, doubt=_seen_elsewhere(track, eyes, settings))
    return look


def _seen_elsewhere(track: Track, eyes: Mapping[str, Eye], settings: TrackSettings) -> PoseDoubt | None:
    """What a wider window shows of a target that is not where the motion since the last look put it.

    Both eyes must know the key picture well and mean one point. The target stays lost all the same: so far
    off, the next rock may look like it.
    """
    key = _anchored(track)
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
    start_m: FloatArray, good: Mapping[str, PatchMatch], eyes: Mapping[str, Eye], settings: TrackSettings
) -> OnePoint | None:
    """The point that pixels mean without the prediction; ``chi2`` says how badly they meet."""
    sightings = [Sighting(eyes[n].camera, m.pixel_px, m.covariance_px2) for n, m in good.items()]
    return one_point(start_m, UNKNOWN_M**2 * np.eye(3), sightings, settings.model_px)


def _seen(track: Track, eyes: Mapping[str, Eye], settings: TrackSettings) -> Look:
    """Look with the track's key."""
    key = _anchored(track)
    if key is None:
        return _lost(
            track, {}, "the surface of the target is not visible from where its key picture was taken"
        )
    plane = Plane(track.position_m, track.key.normal)
    found = {name: _found(track, key, plane, eye, settings) for name, eye in eyes.items()}
    slope: Plane | None = None
    alone = [one for one in found.values() if one.verdict == "good"]
    # Stereo confirms whatever one eye has found: of a lost target that eye must know the key picture well.
    if len(alone) == 1 < len(found) and (
        track.state == "tracked" or alone[0].correlation >= settings.renew_below
    ):
        found, slope = _asked_the_other(found, eyes)
    good = {name: one for name, one in found.items() if one.verdict == "good"}
    doubt = next((f"{n}: {m.reason}" for n, m in found.items() if m.verdict in ("weak", "ambiguous")), "")
    if not good:
        words = "; ".join(f"{name}: {one.reason}" for name, one in found.items())
        return _lost(track, found, words or "no picture was given")
    if doubt:
        return _lost(track, found, f"one eye does not confirm the other: {doubt}")
    if len(good) == 1 and track.state == "lost":
        return _lost(track, found, "one eye alone does not find a lost target again")
    point = one_point(
        track.position_m,
        track.covariance_m2,
        [Sighting(eyes[n].camera, m.pixel_px, m.covariance_px2) for n, m in good.items()],
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
            f"what was found does not fit the prediction: weighted misfit {chi2:.0f}, at most "
            f"{allowed:g} is expected"
        )
        unsure = against and replace(against, sure=False)
        return replace(_lost(track, found, words), chi2=chi2, doubt=unsure)
    turned = _turned(track, point.position_m)
    corrected = _carried(track.key, turned)
    fresh = _fresh_key(track.key, eyes, good, plane, slope)
    renewed = fresh is not None and _outgrown(track.key, eyes, good, plane, settings)
    chosen = fresh if fresh is not None and renewed else corrected
    drift_m = _drifted(chosen)
    if drift_m > settings.worst_drift_m:
        words = (
            f"the place that is followed may have drifted by {100 * drift_m:.0f} cm from the one picked, at "
            f"most {100 * settings.worst_drift_m:g} cm are allowed: the surface around it is no plane"
        )
        return replace(_lost(track, found, words), chi2=chi2, doubt=against)
    standby = None if renewed else fresh or (track.standby and _carried(track.standby, turned))
    after = Track("tracked", point.position_m, point.covariance_m2, chosen, standby)
    return Look(after, found, "", chi2, renewed, against)


def _drifted(key: Key) -> float:
    """One sigma, metres, of the drift that the keys before handed on, in its worst direction."""
    return math.sqrt(max(float(np.linalg.eigvalsh(key.drift_m2)[-1]), 0.0))


def _turned(track: Track, position_m: FloatArray) -> Rigid:
    """The motion's error that a found position tells of, as far as it is the motion's.

    A heading off by half a degree puts a target 10 m away 9 cm off. Were the key camera shifted by as much
    instead of turned, it would look at flat ground under another angle, and steps would add up.
    """
    weight = track.motion_covariance @ _motion_rate(track.position_m).T
    spread = track.covariance_m2 + 1e-12 * np.eye(3)
    error = weight @ np.linalg.solve(spread, position_m - track.position_m)
    return moved_rigid(Rigid.identity(), error)


def _anchored(track: Track) -> Key | None:
    """The key with its camera shifted so that the target's ray meets the believed position.

    Rover motion is never exact: what counts is how the key camera stood to the target, and the shift across
    the ray is small beside the range.
    """
    camera = track.key.eye.camera
    ray = camera.ray(track.key.pixel_px)
    between = track.position_m - ray.origins_m
    along = float(between @ ray.directions)
    if not bool(ray.valid) or along <= 0:
        return None
    shift = Rigid(np.eye(3), between - along * ray.directions)
    return replace(track.key, eye=replace(track.key.eye, camera=camera.moved(shift)))


def _found(track: Track, key: Key, plane: Plane, eye: Eye, settings: TrackSettings) -> PatchMatch:
    """Look in one picture, in the window that the prediction's covariance asks for."""
    _, rate, valid = eye.camera.project_jacobian(track.position_m)
    spread = rate @ track.covariance_m2 @ rate.T if bool(valid) else np.eye(2)
    reach = settings.sigmas * math.sqrt(max(float(np.linalg.eigvalsh(spread)[-1]), 0.0))
    search = min(max(reach + 2 * settings.model_px, settings.least_px), settings.most_px)
    return match_patch(
        key.eye.image, key.eye.camera, key.pixel_px, plane, eye.image, eye.camera, search, SIZES
    )


def _asked_the_other(
    found: Mapping[str, PatchMatch], eyes: Mapping[str, Eye]
) -> tuple[dict[str, PatchMatch], Plane | None]:
    """Look from the eye that found the target into the one that did not; return also the surface this told.

    The place in the other eye is as uncertain as that in the first, seen over the surface, and its own match.
    On a rock the two eyes see the surface more differently than one eye sees it before and after a step.
    """
    seen = next(name for name, one in found.items() if one.verdict == "good")
    other = next(name for name in found if name != seen)
    one, two = eyes[seen], eyes[other]
    partner = find_partner(one.image, one.camera, found[seen].pixel_px, two.image, two.camera, settings=SIZES)
    if partner.match.verdict != "good" or partner.plane is None:
        return dict(found), None
    carried = _on_surface(found[seen].covariance_px2, one.camera, partner.plane)
    _, rate, _ = two.camera.project_jacobian(partner.plane.point_m)
    covariance = partner.match.covariance_px2 + rate @ carried @ rate.T
    return dict(found) | {other: replace(partner.match, covariance_px2=covariance)}, partner.plane


def _fresh_key(
    key: Key,
    eyes: Mapping[str, Eye],
    good: Mapping[str, PatchMatch],
    plane: Plane,
    slope: Plane | None,
) -> Key | None:
    """A key from the pictures of this look; None if one eye alone saw the target.

    ``slope`` is the surface that one eye asked through the other told. Without it both were asked through the
    key, over ``plane``, and tell the surface together.
    """
    if len(good) < 2:
        return None
    first, second = list(eyes)[:2]
    left, right = good[first], good[second]
    surface = slope or plane
    normal = surface.normal
    if slope is None:
        normal = normal_seen(plane.point_m, eyes[first].camera, eyes[second].camera, plane, right, left)
    drift = key.drift_m2 + _on_surface(left.covariance_px2, eyes[first].camera, surface)
    return Key(eyes[first], left.pixel_px, normal, drift)


def _on_surface(covariance_px2: FloatArray, camera: CameraModel, plane: Plane) -> FloatArray:
    """A pixel's covariance (2, 2) as that of its place on the surface (3, 3), square metres."""
    _, rate, _ = camera.project_jacobian(plane.point_m)
    to_surface = plane.axes @ np.linalg.inv(rate @ plane.axes)
    return np.asarray(to_surface @ covariance_px2 @ to_surface.T)


def _outgrown(
    key: Key, eyes: Mapping[str, Eye], good: Mapping[str, PatchMatch], plane: Plane, settings: TrackSettings
) -> bool:
    """Whether scale, view or light have changed so much that the key should be exchanged."""
    scale, shape = _seen_larger(next(iter(eyes.values())).camera, key.eye.camera, plane)
    alike = min(one.correlation for one in good.values()) >= settings.renew_below
    return not (
        settings.renew_shrunk < scale < settings.renew_grown and shape < settings.renew_shape and alike
    )


def _seen_larger(camera: CameraModel, key: CameraModel, plane: Plane) -> tuple[float, float]:
    """How much larger a camera sees the target's surface than the key's did, and how much another shape."""
    rates = [one.project_jacobian(plane.point_m) for one in (camera, key)]
    if not all(bool(valid) for _, _, valid in rates):
        return math.nan, math.nan
    now, then = (rate @ plane.axes for _, rate, _ in rates)
    larger, smaller = np.linalg.svd(now @ np.linalg.inv(then), compute_uv=False).tolist()
    return math.sqrt(larger * smaller), larger / smaller


def _lost(track: Track, found: Mapping[str, PatchMatch], reason: str) -> Look:
    return Look(replace(track, state="lost", misses=track.misses + 1), found, reason)
