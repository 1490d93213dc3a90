"""The work of a track's operations: begin at a pixel or a position; point, take a pair, look for the target.

Steps of a start at a pixel, as they stand in the record: ``rest``, ``frames``, ``target``, ``start``; of one
at a position ``choose``, ``limits`` to ``settle``, ``look``, ``start``. A look has ``choose``, ``limits`` to
``settle`` (``rest`` for a pair on the body), ``look``, ``find``; ``before`` takes pictures ahead of a move
that the new ones must have moved against. What one pair does not find, the next one that sees the place looks
for. Where the target shall go to another pair, the pair that found it last looks first, then the next one,
each with these steps, and ``hand_over`` makes the record of both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from calib.errors import CalibError
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.handed_over import MatchedHandoff
from calib.matching.look import TrackLook, seen_by
from calib.matching.track import Track, start_track
from calib.matching.verdict import PatchMatch
from drivers.errors import DriverError
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.limits import Limits
from mastctl.errors import MastctlError
from mastctl.motion.looking import CameraView
from mastctl.motion.pairs import PairChoice, choose_pairs, record_of
from mastctl.motion.requests import PixelTarget
from mastctl.motion.results import rounded
from mastctl.motion.settings import TrackingSettings
from mastctl.motion.steps import Steps

PAIRS_TRIED = 2
"""How many pairs look for a target at one stop."""
BEFORE_TIMEOUT_S = 2.0
"""A picture to compare with is worth waiting for some frames, not for a camera that is gone."""


class NotTrackable(MastctlError):
    """A track that cannot begin: sky, plain surface, edge, hidden from one camera, nothing at the place."""

    code = "not_trackable"


@dataclass(frozen=True)
class EyePixel:
    """What one eye told: the verdict is `calib.matching.patch`'s or ``no_frame``; pixel and sigma if it

    is good.
    """

    frame_id: str
    verdict: str
    reason: str = ""
    x_px: float = math.nan
    y_px: float = math.nan
    sigma_px: tuple[float, float] = (math.nan, math.nan)
    correlation: float = math.nan


@dataclass(frozen=True, eq=False)
class TrackSighting:
    """What a start or a look told.

    Attributes
    ----------
    state, reason
        ``tracked``, or ``lost`` with the reason in one sentence.
    pair
        Which looked; empty if none could.
    position_m, covariance_m2
        (3,) and (3, 3) of the target afterwards, in the rover frame of the look.
    range_m
        From the middle between the pair's cameras.
    pixels
        By camera.
    chi2, renewed
        As `calib.matching.look.TrackLook`.
    pose_doubt
        What the pictures say against the pose, one sentence; empty if they do not.
    matched
        The target in the pictures of the pair before and of the next one, if both looked.
    """

    state: Literal["tracked", "lost"]
    reason: str
    pair: str
    position_m: FloatArray
    covariance_m2: FloatArray
    range_m: float
    pixels: Mapping[str, EyePixel] = field(default_factory=dict)
    chi2: float = math.nan
    renewed: bool = False
    pose_doubt: str = ""
    matched: MatchedHandoff | None = None


@dataclass(frozen=True, eq=False)
class _Taken:
    """The pictures of one pair: new ones by camera, left first, and why an eye has none."""

    choice: PairChoice
    settled: HeadReading
    views: Mapping[str, CameraView]
    missing: Mapping[str, str]


@dataclass(frozen=True, eq=False)
class _Sight:
    """What one pair's pictures told."""

    track: Track
    seen: TrackSighting
    taken: _Taken
    found: Mapping[str, PatchMatch]


class Looker:
    """Looks for targets during one operation.

    Parameters
    ----------
    steps
        Head, eyes and record of the operation.
    rig
        The mast file in use.
    limits
        Of the head, for the choice among solutions.
    settings
        Which pair looks.
    """

    def __init__(self, steps: Steps, rig: Rig, limits: Limits, settings: TrackingSettings) -> None:
        self._steps = steps
        self._rig = rig
        self._limits = limits
        self._settings = settings

    def begin_at_pixel(self, target: PixelTarget) -> tuple[Track, TrackSighting]:
        """Begin with a pixel of a named frame, found again in a fresh pair.

        Raises
        ------
        MastctlError, DriverError
            If it cannot be followed.
        """
        found = self._steps.clicked(target)
        assert found.other is not None  # a track's pixel is of a pair: `check_pair`
        track = self._started(found.now, found.other, found.pixel_px, found.resting)
        pair = next(name for name, eyes in self._rig.stereo.items() if target.camera in eyes)
        return track, self._first(pair, track, found.now, found.other, found.pixel_px)

    def begin_at_position(self, position_m: FloatArray) -> tuple[Track, TrackSighting]:
        """Begin with what is seen at a position (3,) of the rover frame.

        Raises
        ------
        NotTrackable, PointingError, Unreachable, OutsideLimits, DriverError
            If nothing there can be followed, or what is there stands elsewhere.
        """
        choice = self._choices(position_m)[0]
        settled = self._pointed(choice)
        left, right = self._rig.stereo[choice.pair]
        views = self._steps.look((left, right), settled)
        pixel = np.asarray(views[left].camera.project(position_m)[0])
        track = self._started(views[left], views[right], pixel, settled)
        off_m = float(np.linalg.norm(track.position_m - position_m))
        allowed_m = self._settings.start_error * choice.range_m
        if off_m > allowed_m:
            place = ", ".join(f"{value:.2f}" for value in track.position_m)
            raise NotTrackable(
                f"the surface that {left} sees in the direction of the position is at ({place}) m, "
                f"{off_m:.2f} m from it; at most {allowed_m:.2f} m is expected"
            )
        return track, self._first(choice.pair, track, views[left], views[right], pixel)

    def look(self, track: Track, found_by: str = "") -> tuple[Track, TrackSighting]:
        """Point, take a pair, look; with the next pair if the first does not find it.

        Parameters
        ----------
        found_by
            The pair that found the target last. If another one should look now, it looks first, as long as
            it sees the place, so that both pairs' pictures are of one pose of the rover.

        Raises
        ------
        PointingError, OutsideLimits, DriverError
            If the head fails, or goes where it was not sent. That no picture comes is a look without
            success.
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
            sight = self._find(self._take(choice), track)
            if sight.seen.state == "tracked":
                return sight.track, sight.seen
            first = first or sight
        assert first is not None
        return first.track, first.seen

    def _handed_over(self, former: PairChoice, choice: PairChoice, track: Track) -> _Sight:
        """Look with the pair before, then with the next one, which goes on if it finds the same thing."""
        before = self._find(self._take(former), track)
        held = before.seen.state == "tracked"
        after = self._find(self._take(choice), before.track if held else track)
        matched = self._matched(before, after) if held else None
        known = matched is not None and len(matched.found) == len(self._rig.stereo[choice.pair])
        if known and after.seen.state == "lost":
            # The same thing to look at, but elsewhere: the pairs' calibrations differ. The next pair goes on
            # if what it sees fits what is known without the pair before.
            after = self._find(after.taken, track)
        if after.seen.state == "lost" and held:
            reason = f"{choice.pair} does not take over: {after.seen.reason}"
            return replace(before, seen=replace(before.seen, reason=reason, matched=matched))
        renewed = after.seen.renewed or (held and before.seen.renewed)
        # Between two pairs their calibrations differ too: of a pose only the former pair tells.
        doubt = before.seen.pose_doubt if held else after.seen.pose_doubt
        return replace(after, seen=replace(after.seen, renewed=renewed, matched=matched, pose_doubt=doubt))

    def _matched(self, before: _Sight, after: _Sight) -> MatchedHandoff | None:
        with self._steps.step("hand_over") as detail:
            detail.update(from_pair=before.seen.pair, to_pair=after.seen.pair)
            pair = self._rig.stereo[before.seen.pair]
            made = self._steps.unless_stopped(
                record_of, self._rig, pair, before.taken.views, before.found, after.taken.views
            )
            if isinstance(made, str):
                detail.update(reason=made)
                return None
            detail.update(verdicts={name: one.verdict for name, one in made.landed.items()})
        return made

    def _take(self, choice: PairChoice) -> _Taken:
        settled = self._pointed(choice)
        return _Taken(choice, settled, *self._pictures(self._rig.stereo[choice.pair], settled))

    def _find(self, taken: _Taken, track: Track) -> _Sight:
        with self._steps.step("find") as detail:
            look = self._steps.unless_stopped(seen_by, track, taken.views)
            pixels = {name: EyePixel("", "no_frame", reason) for name, reason in taken.missing.items()}
            pixels |= {name: _eye_pixel(taken.views[name], found) for name, found in look.found.items()}
            seen = self._told(taken.choice, look, pixels, taken.settled)
            detail.update(
                pair=seen.pair, state=seen.state, reason=seen.reason, position_m=rounded(seen.position_m, 5)
            )
            if seen.pose_doubt:
                detail.update(pose_doubt=seen.pose_doubt)
        return _Sight(look.track, seen, taken, look.found)

    def _told(
        self, choice: PairChoice, look: TrackLook, pixels: Mapping[str, EyePixel], settled: HeadReading
    ) -> TrackSighting:
        track, reason = look.track, look.reason
        gone = [one.reason for one in pixels.values() if one.verdict == "no_frame"]
        if track.state == "lost" and gone:
            reason = "; ".join([*gone, reason] if look.found else gone)
        range_m = self._range_m(choice.pair, track.position_m, settled)
        return TrackSighting(
            track.state,
            reason,
            choice.pair,
            track.position_m,
            track.target_covariance_m2,
            range_m,
            pixels,
            look.chi2,
            look.renewed,
            "" if look.doubt is None else look.doubt.sentence,
        )

    def _choices(self, position_m: FloatArray) -> list[PairChoice]:
        with self._steps.step("choose") as detail:
            here = self._steps.head.read()
            found = choose_pairs(
                self._rig,
                position_m,
                self._settings.handoff,
                self._limits,
                here.true_rad,
                lambda solutions: self._steps.head.chosen(solutions, here),
            )
            detail.update(pairs=[one.pair for one in found], range_m=round(found[0].range_m, 3))
            detail.update(range_error_m=round(found[0].range_error_m, 4), outside=found[0].outside)
        return found

    def _pointed(self, choice: PairChoice) -> HeadReading:
        """Bring the target into the middle; a pair on the body only needs a head at rest."""
        if choice.pan_rad is None or choice.tilt_rad is None:
            return self._steps.rest()
        eyes = self._rig.stereo[choice.pair]
        self._steps.before(eyes, (choice.pan_rad, choice.tilt_rad), timeout_s=BEFORE_TIMEOUT_S)
        return self._steps.go_to_true(choice.pan_rad, choice.tilt_rad, eyes[0])[1]

    def _pictures(
        self, eyes: tuple[str, str], settled: HeadReading
    ) -> tuple[dict[str, CameraView], dict[str, str]]:
        """New pictures, left first, and why an eye has none. Raises PointingError, the head's DriverError."""
        missing: dict[str, str] = {}
        while len(missing) < len(eyes):
            asked = [name for name in eyes if name not in missing]
            try:
                views = self._steps.look(asked, settled)
                return {name: views[name] for name in asked}, missing
            except DriverError as error:
                if error.device not in asked:
                    raise
                missing[error.device] = " ".join(str(error).split())
        return {}, missing

    def _started(
        self, one: CameraView, other: CameraView, pixel_px: FloatArray, resting: HeadReading
    ) -> Track:
        with self._steps.step("start") as detail:
            detail.update(self._steps.one_moment(one, pixel_px, [other], resting))
            try:
                track = self._steps.unless_stopped(start_track, one, other, pixel_px)
            except CalibError as error:
                raise NotTrackable(" ".join(str(error).split())) from None
            sigma_m = np.sqrt(np.diag(track.covariance_m2))
            detail.update(position_m=rounded(track.position_m, 5), sigma_m=rounded(sigma_m, 5))
        return track

    def _first(
        self, pair: str, track: Track, one: CameraView, other: CameraView, pixel_px: FloatArray
    ) -> TrackSighting:
        """What a start told; the other eye's pixel is where the triangulated point lies in it."""
        partner = np.asarray(other.camera.project(track.position_m)[0])
        middle = (one.camera.C + other.camera.C) / 2
        return TrackSighting(
            "tracked",
            "",
            pair,
            track.position_m,
            track.target_covariance_m2,
            float(np.linalg.norm(track.position_m - middle)),
            {
                view.frame.camera: EyePixel(view.frame.frame_id, "good", "", float(at[0]), float(at[1]))
                for view, at in ((one, pixel_px), (other, partner))
            },
        )

    def _range_m(self, pair: str, position_m: FloatArray, settled: HeadReading) -> float:
        left, right = (self._rig.camera_in_rover(eye, *settled.true_rad) for eye in self._rig.stereo[pair])
        return float(np.linalg.norm(position_m - (left.C + right.C) / 2))


def _eye_pixel(view: CameraView, found: PatchMatch) -> EyePixel:
    x, y = (float(value) for value in found.pixel_px)
    sigma = found.sigma_px
    return EyePixel(
        view.frame.frame_id,
        found.verdict,
        found.reason,
        x,
        y,
        (float(sigma[0]), float(sigma[1])),
        float(found.correlation),
    )
