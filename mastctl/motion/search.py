"""The work of a track's operations: begin at a pixel or a position; point, take a pair, search the target.

Steps of a start at a pixel, as they stand in the record: ``rest``, ``frames``, ``target``, ``start``; of one
at a position ``choose``, ``limits`` to ``settle``, ``look``, ``start``. A look has ``choose``, ``limits`` to
``settle`` (``rest`` for a pair on the body), ``look``, ``find``; ``before`` takes images ahead of a move that
the new ones must have moved against. What one pair does not find, the next one that sees the place searches.
Where the target shall go to another pair, the pair that found it last looks first, then the next one,
each with these steps, and ``hand_over`` makes the record of both.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import stored_covariance
from calib.geometry.handoff import Joints, hand_off
from calib.geometry.pointing import Solution, solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import stereo_range_error_m
from calib.matching.handoff import MatchedHandoff, RefineSettings, matched_handoff, refine_handoff
from calib.matching.patch import PatchMatch
from calib.matching.search import seen_by
from calib.matching.track import Track, start_track
from drivers.clock import Clock
from mastctl.answers import CameraPixel, Step
from mastctl.devices.devices import Devices
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.judge import Limits
from mastctl.devices.keep_out import KeptOut, Pair
from mastctl.errors import MastctlError
from mastctl.motion.measurement import CameraView, available, rounded
from mastctl.motion.requests import PixelTarget
from mastctl.motion.settings import HandoffRules, TrackingSettings
from mastctl.motion.steps import Steps

PAIRS_TRIED = 2
"""How many pairs search a target from one pose of the rover."""
UNKNOWN_PX = np.full(2, math.nan)
BEFORE_TIMEOUT_S = 2.0
"""An image to compare with is worth waiting for some frames, not for a camera that is gone."""

USUAL_RULES = HandoffRules()
CENTRING_STEPS = 3
"""Each solves exactly for one camera; the place in the other follows within a pixel after two."""

JOINT_SIGMA_RAD = 3e-5
"""What a joint reading is assumed to be wrong by: half a step of a stepped pan/tilt unit."""
LEAST_SIGMA_PX = 0.05
HANDOFF_SETTINGS = RefineSettings(least_px=6.0, model_px=1.0)
"""Two sets of cameras may mean rover frames that are 5 mrad apart, the paper's bias of 2 px in a Hazcam: wide
enough that this is found also by a mast file that says nothing of its own errors. Beyond 3 px nothing is."""


class NotTrackable(MastctlError):
    """A track that cannot begin: sky, plain surface, edge, hidden from one camera, nothing at the place."""

    code = "not_trackable"


@dataclass(frozen=True, eq=False)
class TrackSighting:
    """What a start or a look of a track saw.

    ``reason`` is one sentence for a target that is lost. ``pair`` took the images; empty if none could.
    ``position_m`` is (3,) of the target afterwards, in the rover frame of the look, ``range_m`` from the
    middle between the pair's cameras. ``chi2`` and ``renewed`` are as `calib.matching.search.TrackSearch` has
    them. ``pose_doubt`` says what the images say against the pose; empty if they do not. ``matched`` is the
    target in the images of the pair before and of the next one, if both took some.
    """

    state: Literal["tracked", "lost"]
    reason: str
    pair: str
    position_m: FloatArray
    range_m: float
    pixels: Mapping[str, CameraPixel] = field(default_factory=dict)
    chi2: float = math.nan
    renewed: bool = False
    pose_doubt: str = ""
    matched: MatchedHandoff | None = None


@dataclass(frozen=True, eq=False)
class _Taken:
    """The images of one pair: new ones by camera, left first, and why a camera has none."""

    choice: PairChoice
    settled: HeadReading
    views: Mapping[str, CameraView]
    missing: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class _Sight:
    """What one pair's images show."""

    track: Track
    seen: TrackSighting
    taken: _Taken
    found: Mapping[str, PatchMatch]


class TargetSearch(Steps):
    """Searches a track's target during one operation. Parameters of `Steps`, and those of tracking."""

    def __init__(
        self,
        rig: Rig,
        devices: Devices,
        limits: Limits,
        clock: Clock,
        settings: TrackingSettings,
        record: Callable[[Step], None],
        cancelled: threading.Event,
    ) -> None:
        super().__init__(rig, devices, limits, clock, record, cancelled)
        self._tracking = settings

    def begin_at_pixel(self, target: PixelTarget) -> tuple[Track, TrackSighting]:
        """Begin with a pixel of a named frame, found again in a fresh pair. Raises as `clicked`."""
        found = self.clicked(target)
        assert found.other is not None  # a track's pixel is of a pair: `check_pair`
        pair = next(name for name, both in self._rig.stereo.items() if target.camera in both)
        return self._began(pair, found.now, found.other, found.pixel_px, found.resting)

    def begin_at_position(self, position_m: FloatArray) -> tuple[Track, TrackSighting]:
        """Begin with what is seen at a position (3,) of the rover frame.

        Raises NotTrackable if nothing there can be followed, or what is seen there is elsewhere;
        MastctlError, CalibError, DriverError.
        """
        choice = self._choices(position_m)[0]
        settled = self._pointed(choice)
        left, right = self._rig.stereo[choice.pair]
        views = self.capture((left, right), settled)
        pixel = np.asarray(views[left].camera.project(position_m)[0])
        track, seen = self._began(choice.pair, views[left], views[right], pixel, settled)
        off_m = float(np.linalg.norm(track.position_m - position_m))
        allowed_m = self._tracking.start_error * choice.range_m
        if off_m > allowed_m:
            place = ", ".join(f"{value:.2f}" for value in track.position_m)
            raise NotTrackable(
                f"the surface that {left} sees in the direction of the position is at ({place}) m, "
                f"{off_m:.2f} m from it; at most {allowed_m:.2f} m is expected"
            )
        return track, seen

    def find(self, track: Track, found_by: str = "") -> tuple[Track, TrackSighting]:
        """Point, take a pair, search; with the next pair if the first does not find it.

        ``found_by`` is the pair that found the target last. If another one should serve now, that one is
        first, as long as it sees the place, so that both pairs' images are of one pose of the rover. That no
        image comes is a look without success. Raises MastctlError, DriverError if the head fails.
        """
        choices = self._choices(track.position_m)
        first: _Sight | None = None
        former = next((one for one in choices[1:] if one.pair == found_by), None)
        if former is not None:
            first = self._handed_over(former, choices[0], track)
            if first.seen.state == "tracked":
                return first.track, first.seen
        for choice in choices[:PAIRS_TRIED]:
            if former is not None and choice in (former, choices[0]):
                continue
            sight = self._searched(self._take(choice), track)
            if sight.seen.state == "tracked":
                return sight.track, sight.seen
            first = first or sight
        assert first is not None
        return first.track, first.seen

    def _handed_over(self, former: PairChoice, choice: PairChoice, track: Track) -> _Sight:
        """Search with the pair before, then with the next one, which goes on if it finds the same thing."""
        before = self._searched(self._take(former), track)
        is_found = before.seen.state == "tracked"
        after = self._searched(self._take(choice), before.track if is_found else track)
        matched = self._matched(before, after) if is_found else None
        known = matched is not None and len(matched.found) == len(self._rig.stereo[choice.pair])
        if known and after.seen.state == "lost":
            # The same thing, but elsewhere: the pairs' calibrations differ. The next pair goes on
            # if what it sees fits what is known without the pair before.
            after = self._searched(after.taken, track)
        if after.seen.state == "lost" and is_found:
            reason = f"{choice.pair} does not take over: {after.seen.reason}"
            return replace(before, seen=replace(before.seen, reason=reason, matched=matched))
        renewed = after.seen.renewed or (is_found and before.seen.renewed)
        # Between two pairs their calibrations differ too: only the former one shows an error of the pose.
        doubt = before.seen.pose_doubt if is_found else after.seen.pose_doubt
        return replace(after, seen=replace(after.seen, renewed=renewed, matched=matched, pose_doubt=doubt))

    def _matched(self, before: _Sight, after: _Sight) -> MatchedHandoff | None:
        with self.step("hand_over") as detail:
            detail.update(from_pair=before.seen.pair, to_pair=after.seen.pair)
            pair = self._rig.stereo[before.seen.pair]
            made = _record_of(self._rig, pair, before.taken.views, before.found, after.taken.views)
            if isinstance(made, str):
                detail.update(reason=made)
                return None
            detail.update(verdicts={name: one.verdict for name, one in made.landed.items()})
        return made

    def _take(self, choice: PairChoice) -> _Taken:
        settled = self._pointed(choice)
        cameras = self._rig.stereo[choice.pair]
        return _Taken(choice, settled, *available(cameras, lambda left: self.capture(left, settled)))

    def _searched(self, taken: _Taken, track: Track) -> _Sight:
        with self.step("find") as detail:
            look = seen_by(track, taken.views)
            pixels = {name: _pixel("", "no_frame", reason) for name, reason in taken.missing.items()}
            for name, match in look.found.items():
                frame_id, at, sigma = taken.views[name].frame.frame_id, match.pixel_px, match.sigma_px
                pixels[name] = _pixel(
                    frame_id, match.verdict, match.reason, at, sigma, float(match.correlation)
                )
            pair, position_m, reason = taken.choice.pair, look.track.position_m, look.reason
            if look.track.state == "lost" and taken.missing:
                reason = "; ".join([*taken.missing.values(), *([reason] if look.found else [])])
            joints = taken.settled.true_rad
            cameras = (self._rig.camera_in_rover(name, *joints) for name in self._rig.stereo[pair])
            range_m = _range_m(position_m, *cameras)
            seen = TrackSighting(
                look.track.state,
                reason,
                pair,
                position_m,
                range_m,
                pixels,
                look.chi2,
                look.renewed,
                look.doubt,
            )
            detail.update(
                pair=seen.pair, state=seen.state, reason=seen.reason, position_m=rounded(seen.position_m, 5)
            )
            if seen.pose_doubt:
                detail.update(pose_doubt=seen.pose_doubt)
        return _Sight(look.track, seen, taken, look.found)

    def _choices(self, position_m: FloatArray) -> list[PairChoice]:
        with self.step("choose") as detail:
            now = self.read()
            found = choose_pairs(
                self._rig,
                position_m,
                self._tracking.handoff,
                now.true_rad,
                lambda solutions: self.chosen(solutions, now),
            )
            detail.update(pairs=[one.pair for one in found], range_m=round(found[0].range_m, 3))
            detail.update(range_error_m=round(found[0].range_error_m, 4), outside=found[0].outside)
        return found

    def _pointed(self, choice: PairChoice) -> HeadReading:
        """Bring the target into the middle; a pair on the body only needs a head at rest."""
        if choice.pan_rad is None or choice.tilt_rad is None:
            return self.rest()
        cameras = self._rig.stereo[choice.pair]
        self.before(cameras, (choice.pan_rad, choice.tilt_rad), timeout_s=BEFORE_TIMEOUT_S)
        return self.go_to_true(choice.pan_rad, choice.tilt_rad)[1]

    def _began(
        self, pair: str, one: CameraView, other: CameraView, pixel_px: FloatArray, resting: HeadReading
    ) -> tuple[Track, TrackSighting]:
        """Follow what a pixel shows; the other camera's pixel is where the triangulated point lies in it."""
        with self.step("start") as detail:
            detail.update(self.cameras.check_one_moment(one, pixel_px, [other], resting))
            try:
                track = start_track(one, other, pixel_px)
            except CalibError as error:
                raise NotTrackable(" ".join(str(error).split())) from None
            sigma_m = np.sqrt(np.diag(track.covariance_m2))
            detail.update(position_m=rounded(track.position_m, 5), sigma_m=rounded(sigma_m, 5))
        partner_px = np.asarray(other.camera.project(track.position_m)[0])
        pixels = {
            view.frame.camera: _pixel(view.frame.frame_id, "good", "", at)
            for view, at in ((one, pixel_px), (other, partner_px))
        }
        range_m = _range_m(track.position_m, one.camera, other.camera)
        return track, TrackSighting("tracked", "", pair, track.position_m, range_m, pixels)


def _range_m(position_m: FloatArray, left: CameraModel, right: CameraModel) -> float:
    """From the middle between a pair's cameras."""
    return float(np.linalg.norm(position_m - (left.C + right.C) / 2))


def _pixel(
    frame_id: str,
    verdict: str,
    reason: str,
    at_px: FloatArray = UNKNOWN_PX,
    sigma_px: FloatArray = UNKNOWN_PX,
    correlation: float = math.nan,
) -> CameraPixel:
    return {
        "frame_id": frame_id,
        "verdict": verdict,
        "reason": reason,
        "x_px": float(at_px[0]),
        "y_px": float(at_px[1]),
        "sigma_px": sigma_px.tolist(),
        "correlation": correlation,
    }


@dataclass(frozen=True)
class PairChoice:
    """A pair that sees a target.

    The true joint angles bring the target midway between the two images' middles; None for a pair on the
    body, which the head does not turn. ``range_m`` is from the middle between the pair's cameras,
    ``range_error_m`` by eqs. (1) and (2), 3 sigma. ``outside`` says which bounds are broken; empty for none.
    """

    pair: str
    pan_rad: float | None
    tilt_rad: float | None
    range_m: float
    range_error_m: float
    outside: str = ""


def choose_pairs(
    rig: Rig,
    position_m: FloatArray,
    rules: HandoffRules = USUAL_RULES,
    from_rad: Pair = (0.0, 0.0),
    chosen: Callable[[Sequence[Solution]], Solution] = lambda solutions: solutions[0],
) -> list[PairChoice]:
    """Return the pairs that see a position (3,) of the rover frame, the one that should take images first.

    Pairs that keep their bounds come first, the most accurate in front. Then those that see the target but
    break a bound, the shortest focal length in front: they serve where no other does. ``from_rad`` are the
    true pan and tilt of now; ``chosen`` chooses among the solutions for one aim.

    Raises CalibError if no pair has the target well inside both images, with the reason for each.
    """
    kept: list[tuple[float, PairChoice]] = []
    broken: list[tuple[float, PairChoice]] = []
    reasons: list[str] = []
    for name in rig.stereo:
        try:
            focal_px, choice = _choice_of(rig, name, position_m, rules, chosen, from_rad)
        except (CalibError, KeptOut) as error:
            reasons.append(f"{name}: {error}")
            continue
        (broken if choice.outside else kept).append((focal_px, choice))
    kept.sort(key=lambda one: one[1].range_error_m)
    broken.sort(key=lambda one: one[0])
    found = [choice for _, choice in (*kept, *broken)]
    if not found:
        place = ", ".join(f"{value:.2f}" for value in position_m)
        why = "; ".join(reasons) or "none is configured with both cameras"
        raise CalibError(f"no stereo pair sees the target at ({place}) m: {why}")
    return found


def _choice_of(
    rig: Rig,
    name: str,
    position_m: FloatArray,
    rules: HandoffRules,
    chosen: Callable[[Sequence[Solution]], Solution],
    from_rad: Pair,
) -> tuple[float, PairChoice]:
    """One pair's focal length and how it would see the position. Raises CalibError if it cannot."""
    cameras = rig.stereo[name]
    angles = None
    if rig.cameras[cameras[0]].on == "head":
        angles = _centred(rig, cameras, position_m, chosen, from_rad)
    left, right = (rig.camera_in_rover(camera, *(angles or (0.0, 0.0))) for camera in cameras)
    for camera, model in zip(cameras, (left, right), strict=True):
        _check_in_image(camera, model, position_m, rules.margin_px)
    between = position_m - (left.C + right.C) / 2
    range_m = float(np.linalg.norm(between))
    steep_rad = math.asin(float(between[2]) / range_m)
    focal_px = left.focal_px[0]
    baseline_m = float(np.linalg.norm(right.C - left.C))
    error_m = stereo_range_error_m(range_m, focal_px, baseline_m, rules.disparity_error_px)
    bounds = rules.bounds(name)
    outside = []
    if range_m < bounds.nearest_m:
        outside.append(f"{range_m:.2f} m away, nearer than {bounds.nearest_m:g} m")
    if steep_rad > bounds.steepest_rad:
        outside.append(f"{steep_rad:.2f} rad below the horizontal, steeper than {bounds.steepest_rad:g} rad")
    if error_m > rules.range_error * range_m:
        outside.append(f"range error {error_m:.2f} m, more than {rules.range_error:g} of the range")
    pan_rad, tilt_rad = angles or (None, None)
    return focal_px, PairChoice(name, pan_rad, tilt_rad, range_m, error_m, "; ".join(outside))


def _centred(
    rig: Rig,
    cameras: tuple[str, str],
    position_m: FloatArray,
    chosen: Callable[[Sequence[Solution]], Solution],
    from_rad: Pair,
) -> Pair:
    """Joint angles that put the target as far from the middle in the one camera as in the other.

    In the middle of one camera alone a near target may be outside the other's image. Raises CalibError.
    """
    left, right = (rig.cameras[camera].model for camera in cameras)
    middle = np.array(left.image_center_px)
    aim = middle.copy()
    pan_rad, tilt_rad = from_rad
    for _ in range(CENTRING_STEPS):
        solutions = solve(
            rig.mast, left, position_m, aim, from_pan_rad=from_rad[0], from_tilt_rad=from_rad[1]
        )
        best = chosen(solutions)
        pan_rad, tilt_rad = best.pan_rad, best.tilt_rad
        in_right, seen = rig.camera_in_rover(cameras[1], pan_rad, tilt_rad).project(position_m)
        if not bool(seen):
            break  # the check of both images says so
        off = (np.array(right.image_center_px) - in_right - (aim - middle)) / 2
        aim = np.clip(aim + off, 0.0, np.array(left.size_px) - 1.0)
    return pan_rad, tilt_rad


def _check_in_image(camera: str, model: CameraModel, position_m: FloatArray, margin_px: float) -> None:
    """Pass a camera that has a position well inside its image. Raises CalibError."""
    pixel, seen = model.project(position_m)
    if not bool(seen):
        raise CalibError(f"{camera} has it behind itself or beyond what its lens images")
    if not model.holds(pixel, margin_px):
        width, height = model.size_px
        raise CalibError(
            f"{camera} has it at pixel ({pixel[0]:.0f}, {pixel[1]:.0f}), not {margin_px:g} px inside its "
            f"{width}x{height} px"
        )


def _record_of(
    rig: Rig, pair: tuple[str, str], views: Mapping[str, CameraView], found: Mapping[str, PatchMatch],
    to: Mapping[str, CameraView],
) -> MatchedHandoff | str:  # fmt: skip
    """The record of a target that one pair found, in another's images, or why there is none.

    ``pair``, ``views`` and ``found`` are the former pair, left camera first, its images, and where the target
    was found in them; ``to`` the images of the next pair.
    """
    if not to or any(name not in found or found[name].verdict != "good" for name in pair):
        return (
            "one of the pictures did not come, or the former pair did not find the target with both cameras"
        )
    left, right = (views[name] for name in pair)
    clicks = np.array([found[name].pixel_px for name in pair])
    sigma_px = max(LEAST_SIGMA_PX, *(float(found[name].sigma_px.max()) for name in pair))
    joints, to_joints = _joints(left), _joints(next(iter(to.values())))
    try:
        handed = hand_off(
            rig, pair, tuple(to), joints, clicks[0], clicks[1],
            to_joints=to_joints, sigma_px=sigma_px, calibration=stored_covariance(rig),
        )  # fmt: skip
    except CalibError as error:
        return " ".join(str(error).split())
    refined = refine_handoff(handed, (left, right), clicks, to, HANDOFF_SETTINGS)
    return matched_handoff(left.frame.mast_digest, pair, joints, clicks, sigma_px, to_joints, handed, refined)


def _joints(view: CameraView) -> Joints:
    frame = view.frame
    return Joints(*frame.true_rad, JOINT_SIGMA_RAD, (frame.pan_approach, frame.tilt_approach))


LEAST_ELLIPSE_PX = 0.05


def in_picture(camera: CameraModel, position_m: ArrayLike, covariance_m2: object) -> dict[str, float] | None:
    """Return the pixel of a point (3,), in the camera's frame, and one sigma of it as an ellipse.

    ``x_px``, ``y_px``, the half axes ``major_px``, ``minor_px``, and ``turn_rad`` of the major one, from x
    towards y; 0 where the covariance (3, 3) is not known. None if the camera does not show the point.
    """
    place, rates, valid = camera.project_jacobian(position_m)
    if not bool(valid) or not camera.holds(place):
        return None
    ellipse = {"x_px": float(place[0]), "y_px": float(place[1])}
    if covariance_m2 is None:
        return ellipse | {"major_px": 0.0, "minor_px": 0.0, "turn_rad": 0.0}
    variances, axes = np.linalg.eigh(rates @ np.asarray(covariance_m2, dtype=float) @ rates.T)
    minor, major = (max(LEAST_ELLIPSE_PX, math.sqrt(max(0.0, one))) for one in variances.tolist())
    return ellipse | {
        "major_px": major, "minor_px": minor, "turn_rad": math.atan2(axes[1, 1], axes[0, 1])
    }  # fmt: skip
