"""The work of a track's operations: begin at a pixel or a position; point, take a pair, search the target.

Steps of a start at a pixel, as they are in the record: ``rest``, ``frames``, ``target``, ``start``; of one at
a position ``choose``, ``limits`` to ``settle``, ``look``, ``start``. A look has ``choose``, ``limits`` to
``settle`` (``rest`` for a pair on the body), ``look``, ``find``; ``before`` takes images ahead of a move that
the new ones must have moved against. What one pair does not find, the next one that sees the place searches.
Where the target shall go to another pair, the pair that found it last searches first, then the next one,
each with these steps, and ``hand_over`` makes the record of both.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from calib.errors import CalibError
from calib.geometry.cahvor import CameraModel
from calib.geometry.covariance import stored_covariance
from calib.geometry.handoff import Joints, hand_off
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.matching.handoff import MatchedHandoff, RefineSettings, matched_handoff, refine_handoff
from calib.matching.patch import PatchMatch
from calib.matching.search import seen_by
from calib.matching.track import Track, start_track
from drivers.clock import Clock
from mastctl.answers import CameraPixel, Step
from mastctl.devices.devices import Devices
from mastctl.devices.joint_history import HeadReading
from mastctl.errors import MastctlError
from mastctl.motion.measurement import CameraView, available, rounded
from mastctl.motion.pairs import PairChoice, TrackingSettings, choose_pairs
from mastctl.motion.requests import PixelTarget
from mastctl.motion.steps import Steps

PAIRS_TRIED = 2
"""How many pairs search a target from one pose of the rover."""
BEFORE_TIMEOUT_S = 2.0
"""An image to compare with is worth waiting for some frames, not for a camera that is gone."""
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
    """What a start or a look of a track has found.

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
class _Search:
    """What one pair's images show."""

    track: Track
    seen: TrackSighting
    taken: _Taken
    found: Mapping[str, PatchMatch]

    @property
    def is_found(self) -> bool:
        return self.seen.state == "tracked"


class TargetSearch(Steps):
    """Searches a track's target during one operation. Parameters of `Steps`, and those of tracking."""

    def __init__(
        self,
        rig: Rig,
        devices: Devices,
        clock: Clock,
        settings: TrackingSettings,
        record: Callable[[Step], None],
        cancelled: threading.Event,
    ) -> None:
        super().__init__(rig, devices, clock, record, cancelled)
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
        former = next((one for one in choices[1:] if one.pair == found_by), None)
        searches: list[_Search] = []
        if former is not None:
            searches.append(self._handed_over(former, choices[0], track))
        for choice in choices[:PAIRS_TRIED]:
            if (searches and searches[-1].is_found) or (former and choice in (former, choices[0])):
                continue
            searches.append(self._searched(self._take(choice), track))
        best = searches[-1] if searches[-1].is_found else searches[0]
        return best.track, best.seen

    def _handed_over(self, former: PairChoice, choice: PairChoice, track: Track) -> _Search:
        """Search with the pair before, then with the next one, which goes on if it finds the same thing."""
        before = self._searched(self._take(former), track)
        after = self._searched(self._take(choice), before.track if before.is_found else track)
        matched = self._matched(before, after) if before.is_found else None
        known = matched is not None and len(matched.found) == len(self._rig.stereo[choice.pair])
        if known and not after.is_found:
            # The same thing, but elsewhere: the pairs' calibrations differ. The next pair goes on
            # if what it sees fits what is known without the pair before.
            after = self._searched(after.taken, track)
        if before.is_found and not after.is_found:
            reason = f"{choice.pair} does not take over: {after.seen.reason}"
            return replace(before, seen=replace(before.seen, reason=reason, matched=matched))
        renewed = after.seen.renewed or (before.is_found and before.seen.renewed)
        # Between two pairs their calibrations differ too: only the former one shows an error of the pose.
        doubt = before.seen.pose_doubt if before.is_found else after.seen.pose_doubt
        return replace(after, seen=replace(after.seen, renewed=renewed, matched=matched, pose_doubt=doubt))

    def _matched(self, before: _Search, after: _Search) -> MatchedHandoff | None:
        with self.step("hand_over") as detail:
            detail.update(from_pair=before.seen.pair, to_pair=after.seen.pair)
            try:
                made = self._record_of(before, after)
            except CalibError as error:
                detail.update(reason=" ".join(str(error).split()))
                return None
            detail.update(verdicts={name: one.verdict for name, one in made.landed.items()})
        return made

    def _record_of(self, before: _Search, after: _Search) -> MatchedHandoff:
        """The record of a target that one pair found, in another's images. Raises CalibError without one."""
        pair, views, found, to = (
            self._rig.stereo[before.seen.pair], before.taken.views, before.found, after.taken.views
        )  # fmt: skip
        if not to or any(name not in found or found[name].verdict != "good" for name in pair):
            raise CalibError(
                "an image did not come, or the former pair did not find the target with both cameras"
            )
        left, right = (views[name] for name in pair)
        clicks = np.array([found[name].pixel_px for name in pair])
        sigma_px = max(LEAST_SIGMA_PX, *(float(found[name].sigma_px.max()) for name in pair))
        joints, to_joints = _joints(left), _joints(next(iter(to.values())))
        handed = hand_off(
            self._rig, pair, tuple(to), joints, clicks[0], clicks[1],
            to_joints=to_joints, sigma_px=sigma_px, calibration=stored_covariance(self._rig),
        )  # fmt: skip
        refined = refine_handoff(handed, (left, right), clicks, to, HANDOFF_SETTINGS)
        digest = left.frame.mast_digest
        return matched_handoff(digest, pair, joints, clicks, sigma_px, to_joints, handed, refined)

    def _take(self, choice: PairChoice) -> _Taken:
        settled = self._pointed(choice)
        cameras = self._rig.stereo[choice.pair]
        return _Taken(choice, settled, *available(cameras, lambda left: self.capture(left, settled)))

    def _searched(self, taken: _Taken, track: Track) -> _Search:
        with self.step("find") as detail:
            look = seen_by(track, taken.views)
            pixels = {name: _pixel("", "no_frame", reason) for name, reason in taken.missing.items()}
            pixels |= {
                name: _pixel(taken.views[name].frame.frame_id, match.verdict, match.reason, match)
                for name, match in look.found.items()
            }
            pair, position_m, reason = taken.choice.pair, look.track.position_m, look.reason
            if look.track.state == "lost" and taken.missing:
                reason = "; ".join([*taken.missing.values(), *([reason] if look.found else [])])
            joints = taken.settled.true_rad
            left, right = (self._rig.camera_in_rover(name, *joints) for name in self._rig.stereo[pair])
            range_m, state = _range_m(position_m, left, right), look.track.state
            seen = TrackSighting(
                state, reason, pair, position_m, range_m, pixels, look.chi2, look.renewed, look.doubt
            )
            detail.update(pair=pair, state=state, reason=reason, position_m=rounded(position_m, 5))
            if seen.pose_doubt:
                detail.update(pose_doubt=seen.pose_doubt)
        return _Search(look.track, seen, taken, look.found)

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
        if choice.true_rad is None:
            return self.rest()
        self.before(self._rig.stereo[choice.pair], choice.true_rad, timeout_s=BEFORE_TIMEOUT_S)
        return self.go_to_true(*choice.true_rad)[1]

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
        pixels: dict[str, CameraPixel] = {}
        for view, at in ((one, pixel_px), (other, partner_px)):
            pixel = _pixel(view.frame.frame_id, "good", "")
            pixels[view.frame.camera] = {**pixel, "x_px": float(at[0]), "y_px": float(at[1])}
        range_m = _range_m(track.position_m, one.camera, other.camera)
        return track, TrackSighting("tracked", "", pair, track.position_m, range_m, pixels)


def _range_m(position_m: FloatArray, left: CameraModel, right: CameraModel) -> float:
    """From the middle between a pair's cameras."""
    return float(np.linalg.norm(position_m - (left.C + right.C) / 2))


def _pixel(frame_id: str, verdict: str, reason: str, match: PatchMatch | None = None) -> CameraPixel:
    """Where a camera shows the target; not a number where it does not."""
    x_px, y_px = (math.nan, math.nan) if match is None else match.pixel_px.tolist()
    return {
        "frame_id": frame_id,
        "verdict": verdict,
        "reason": reason,
        "x_px": x_px,
        "y_px": y_px,
        "sigma_px": [math.nan, math.nan] if match is None else match.sigma_px.tolist(),
        "correlation": math.nan if match is None else float(match.correlation),
    }


def _joints(view: CameraView) -> Joints:
    frame = view.frame
    return Joints(*frame.true_rad, JOINT_SIGMA_RAD, (frame.pan_approach, frame.tilt_approach))
