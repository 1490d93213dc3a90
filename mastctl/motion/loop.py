"""The pointing loop: see, measure, solve, move, settle, see again, measure what is left.

Steps of a pixel request, as they stand in the record: ``rest``, ``frames``, ``target``, ``stereo``,
``triangulate``; then for each pointing ``solve``, ``limits``, ``move``, ``settle``, ``look``, ``measure``,
``eyes``, ``repeat`` (and ``triangulate``, ``rest`` before the second; ``before`` ahead of the first move if
the aiming camera has no image yet that the new one could be compared with). A position needs ``rest``,
``solve`` to ``settle`` and ``look``; joint angles ``rest`` and ``limits`` to ``settle``, no image.

With one camera (its partner is not configured, or ``range_m`` or a plane says how far the target is)
``sight`` takes the place of ``stereo`` and ``triangulate``, ``range`` that of ``eyes``
(`mastctl.motion.one_camera`).

The partner's frame beside a named frame may not be kept, and what was clicked may have been seen from another
pose; so a fresh pair is always taken, the clicked patch is found in it, and range comes from that pair. After
each move the clicked patch itself, never a later copy of it, is searched, so nothing drifts.

What the loop does not do: it does not retry, and it reports no residual on a match that is not good, or that
a later image does not repeat (`mastctl.motion.measurement`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np

from calib.errors import CalibError
from calib.geometry.line_of_sight import SeenFrom
from calib.geometry.pointing import Solution, solve
from calib.geometry.rigid import FloatArray
from calib.geometry.stereo import Triangulation, triangulate
from calib.matching.partner import StereoMatch
from calib.matching.patch import PatchMatch
from drivers.errors import DriverError
from mastctl.answers import Pointing, PointingResult, Preview
from mastctl.as_json import as_json
from mastctl.devices.frames import StampedFrame
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.keep_out import Pair
from mastctl.errors import MastctlError
from mastctl.motion.measurement import CameraView, Clicked, match_facts, rounded
from mastctl.motion.one_camera import PIXEL_SIGMA_PX, OneCamera
from mastctl.motion.requests import Aim, PixelTarget, PointingError, PointRequest, aim_of
from mastctl.motion.steps import FoundAgain, Steps

REPEAT_AFTER_S = 1.0
"""How much later a second image is taken, which has to repeat a residual before it is reported; 0: none. So
an image older than its stamp by up to that is found out: the residual was measured in one that was exposed by
a head at rest."""
REPEAT_SIGMAS = 3.0
WATCHED_S = 0.05
"""How often a head at rest is read while a moment is waited for; a stop is noticed as soon."""
NO_PICTURE_OF_A_POSITION = "no residual: a position has no picture that could be looked for"
CHANGED = (
    ". The scene or the rover has changed since the panorama: take another, or point by direction alone "
    "(by_direction)"
)
NO_TARGET = "no residual: joint angles name no target; no picture was taken"
NOT_MEASURED: dict[str, Any] = {
    "camera": "", "frame_id": "", "aim_px": None, "predicted_px": None, "target_px": None,
    "residual_px": None, "residual_sigma_px": None, "predicted_sigma_px": None,
    "predicted_covariance_px2": None, "note": "", "motion_evidence": {},
}  # fmt: skip
"""What a pointing has beside its angles, where nothing was measured."""


class PointingLoop(Steps):
    """One request: points the head at its target, and measures how well it did."""

    _position_m: FloatArray | None = None
    _range_m: float | None = None
    _one_camera: OneCamera | None = None
    _range_from = ""

    def __init__(self, *parts: Any, repeat_after_s: float = REPEAT_AFTER_S) -> None:
        super().__init__(*parts)
        self._repeat_after_s = repeat_after_s
        self._pointings: list[Pointing] = []

    def run(self, request: PointRequest, view_rad: Pair | None = None) -> PointingResult:
        """Carry out the request; blocks until it is done, at most the sum of its deadlines.

        ``view_rad``: true angles at which the clicked picture of a panorama was taken; the head goes there
        first. Raises PointingError with the step and the pointings done before; its caller stops the mast.
        """
        try:
            if view_rad is not None and request.pixel is not None:
                self._return_to(view_rad, request.pixel.camera)
            self._run(request)
        except (MastctlError, DriverError, CalibError) as error:
            code, message = getattr(error, "code", "failed"), " ".join(str(error).split())
            if view_rad is not None and self.last == "target":
                message += CHANGED
            raise PointingError(code, message, self.last, self._so_far()) from error
        result = self._so_far()
        assert result is not None
        return result

    def preview(self, request: PointRequest) -> Preview:
        """Return what a pixel request would point at and where the head would go; nothing moves.

        Raises MastctlError, DriverError, CalibError if what was clicked is not found, or has no range.
        """
        target, aim = request.pixel, aim_of(request, self._rig)
        assert target is not None
        about: dict[str, Any]
        if self._is_alone(request, target):
            found, _ = self._sight(request, target)
            one = self._one_camera
            assert one is not None
            about = {
                "range_m": one.sight.range_m,
                "range_from": one.range_from,
                "range_interval_m": one.sight.range_interval_m,
            }
        else:
            found, partnered, point = self._in_stereo(target)
            assert found.other is not None
            about = _stereo_facts(found.now, found.pixel_px, found.other, partnered, point)
        return self._previewed(found.now, found.pixel_px, about, aim)

    def preview_kept(
        self, request: PointRequest, frames: Sequence[StampedFrame], pixel_px: FloatArray, range_m: float
    ) -> Preview:
        """Return the same of a pixel of a kept picture, with the partner's of that moment, if there is one.

        ``range_m``: how far the thing is if nothing measures it. Raises as `preview`.
        """
        now, *others = (self.cameras.view(frame) for frame in frames)
        aim, about = aim_of(request, self._rig), {}
        if others:
            partnered = self.cameras.stereo(now, pixel_px, others[0])
            point = self._triangulate(now, pixel_px, others[0], partnered.match)
            about = _stereo_facts(now, pixel_px, others[0], partnered, point)
        else:
            ray = now.camera.ray(pixel_px)
            self._position_m = ray.origins_m + range_m * ray.directions
            about = {"range_m": range_m, "range_from": "surface"}
        return self._previewed(now, pixel_px, about, aim)

    def _previewed(self, now: CameraView, pixel_px: FloatArray, about: dict[str, Any], aim: Aim) -> Preview:
        """With the readings that the head would be sent to, and why it would not."""
        goal: Pair | None = None
        refused: dict[str, str] | None = None
        try:
            start = self.read()
            best = self._solved(aim, np.array([aim.x_px, aim.y_px]), start, {})
            goal = self._devices.goal((best.pan_rad, best.tilt_rad), start)
            self.check_goal(*goal)
        except (MastctlError, CalibError) as error:
            message = " ".join(str(error).split())
            refused = {"code": getattr(error, "code", "failed"), "message": message}
        answer = {
            **dict.fromkeys(Preview.__annotations__),
            **about,
            "camera": now.frame.camera,
            "frame_id": now.frame.frame_id,
            "pixel_px": pixel_px,
            "position_m": self._position_m,
            "aim": aim,
            "goal_rad": goal,
            "refused": refused,
        }
        return cast(Preview, as_json(answer))

    def _return_to(self, view_rad: Pair, camera: str) -> None:
        """Go to where a kept picture was taken, so that a fresh one shows the same."""
        with self.whole("view") as detail:
            detail.update(true_pan_rad=view_rad[0], true_tilt_rad=view_rad[1])
            self.rest()
            self.before((camera,), view_rad)
            _, settled = self.go_to_true(*view_rad)
            self.capture((camera,), settled)

    def _run(self, request: PointRequest) -> None:
        if request.angles_rad is not None:
            self.rest()
            settled = self.go(*request.angles_rad)
            self._pointings.append(_pointing(request.angles_rad, settled, note=NO_TARGET))
            return
        aim, target = aim_of(request, self._rig), request.pixel
        aim_px = np.array([aim.x_px, aim.y_px])
        if target is None:
            self._position_m = np.array(request.position_m)
            commanded, settled = self._solve_and_go(aim, aim_px, self.rest())
            now = self.capture((aim.camera,), settled)[aim.camera]
            self._measured(commanded, now, aim_px, None)
        elif self._is_alone(request, target):
            self._point(self._sight(request, target)[1], aim, aim_px, request.pointings)
        else:
            self._range_from = "stereo"
            found, partnered, _ = self._in_stereo(target)
            plane, relief = partnered.plane, partnered.relief
            assert plane is not None and relief is not None
            relief = relief.seen_by(found.view.camera, found.clicked_px, plane, found.now.camera)
            clicked = Clicked(found.view, found.clicked_px, plane, relief=relief)
            self._point(clicked, aim, aim_px, request.pointings)

    def _in_stereo(self, target: PixelTarget) -> tuple[FoundAgain, StereoMatch, Triangulation]:
        """Find the clicked thing in a fresh pair, and its position."""
        found = self.clicked(target)
        now, other = found.now, found.other
        assert other is not None
        with self.step("stereo") as detail:
            detail.update(self.cameras.check_one_moment(now, found.pixel_px, [other], found.resting))
            partnered = self.cameras.stereo(now, found.pixel_px, other)
            detail.update(match_facts(partnered.match), across_px=round(partnered.across_px, 3))
        return found, partnered, self._triangulate(now, found.pixel_px, other, partnered.match)

    def _is_alone(self, request: PointRequest, target: PixelTarget) -> bool:
        """Whether one camera points: the request says how far it is, or there is no stereo partner."""
        given = request.range_m is not None or request.plane is not None
        return given or self.cameras.partner(target.camera) is None

    def _sight(self, request: PointRequest, target: PixelTarget) -> tuple[FoundAgain, Clicked]:
        """From the clicked pixel to a line of sight, and what is known of the range."""
        found = self.clicked(target, alone=True)
        with self.step("sight") as detail:
            one = OneCamera(self._rig, self._devices.reading_sigma_rad, found, request)
            self._one_camera, self._position_m = one, one.position_m
            detail.update(one.facts())
            return found, one.clicked(found)

    def _triangulate(
        self, one: CameraView, one_px: FloatArray, other: CameraView, seen: PatchMatch
    ) -> Triangulation:
        with self.step("triangulate") as detail:
            # the match is of one pixel of the two that are treated as equally sure
            match_px = float(seen.sigma_px.max()) / math.sqrt(2.0)
            sigma_px = math.hypot(PIXEL_SIGMA_PX, match_px)
            point = triangulate(one.camera, other.camera, one_px, seen.pixel_px, sigma_px)
            self._position_m = point.position_m
            detail.update(
                position_m=rounded(point.position_m, 5),
                sigma_m=rounded(np.sqrt(np.diag(point.covariance_m2)), 5),
                covariance_m2=point.covariance_m2.tolist(),
                ray_gap_m=round(point.ray_gap_m, 6),
                range_m=round(point.ranges_m[0], 5),
            )
        return point

    def _point(self, clicked: Clicked, aim: Aim, aim_px: FloatArray, pointings: int) -> None:
        """Point once or twice at the clicked thing and measure each time."""
        one, source = self._one_camera, clicked.view.frame.camera
        expected: SeenFrom | None = None
        for number in range(1, pointings + 1):
            commanded, settled = self._solve_and_go(aim, aim_px, self.rest() if number > 1 else None)
            assert self._position_m is not None
            companions: tuple[str, ...] = ()
            if one is None:
                companions = self.cameras.companions(aim.camera, source, self._position_m, settled)
            views = self.capture((aim.camera, *companions), settled)
            now = views.pop(aim.camera)
            with self.step("measure") as detail:
                if one is None:
                    seen = self.cameras.find(clicked, now)
                    predicted_px = seen.predicted_px
                else:
                    expected = one.expected(now)
                    seen = one.find(self.cameras, clicked, now)
                    predicted_px = expected.pixel_px
                detail.update(camera=aim.camera, **match_facts(seen), predicted_px=rounded(predicted_px))
                detail.update(residual_px=rounded(seen.pixel_px - aim_px))
                if one is not None and expected is not None:
                    detail.update(one.check(now, seen, expected))
            confirmed = [(now, seen)]
            if one is None:
                confirmed += self._confirmed(clicked, now, seen, views)
            later, again = self._repeated(clicked, now, seen, settled, aim_px)
            if one is None or expected is None:
                self._measured(commanded, later, aim_px, again)
                if number < pointings:
                    self._measure_again(confirmed)
                continue
            self._measured(commanded, later, aim_px, again, **one.predicted(seen, expected))
            with self.step("range") as detail:
                one.learn(now, seen.pixel_px, float(seen.sigma_px.max()), expected)
                self._position_m = one.position_m
                detail.update(one.facts())
        if one is not None:
            self._range_m = one.sight.range_m

    def _confirmed(
        self, clicked: Clicked, now: CameraView, seen: PatchMatch, others: Mapping[str, CameraView]
    ) -> list[tuple[CameraView, PatchMatch]]:
        """Have other cameras confirm what the aiming one shows; their views and matches."""
        pair = {clicked.view.frame.camera, self.cameras.partner(clicked.view.frame.camera)}
        confirmed = []
        with self.step("eyes") as detail:
            detail.update(confirmed_by=list(others))
            for name, other in others.items():
                self.check_not_stopped()
                same_pair = {now.frame.camera, name} == pair
                found, detail[name] = self.cameras.agree(clicked, now, seen, other, same_pair)
                confirmed.append((other, found))
        return confirmed

    def _repeated(
        self, clicked: Clicked, first: CameraView, seen: PatchMatch, settled: HeadReading, aim_px: FloatArray
    ) -> tuple[CameraView, PatchMatch]:
        """Find the clicked thing in a later image of the same camera, where the ``first`` one showed it.

        Returns the later image and where that shows it; the first one's, if no second is wanted. The record
        gets ``repeated_after_s``, ``apart_px`` (x, y) and ``fresh_to_s``: images older than their stamps by
        up to that would not have passed; 0 where both are the same to the last bit: a camera froze.

        Raises PointingError ``not_repeated`` if it is elsewhere by more than three sigma and what the joints
        read between the two (a head at rest may dither by some counts), or not found.
        """
        if not self._repeat_after_s:
            return first, seen
        camera, began_s = first.frame.camera, first.frame.exposure_began_s
        with self.step("repeat") as detail:
            until_s = began_s + self._repeat_after_s
            while (left_s := until_s - self._clock.now_s()) > 0.0:
                self.check_not_stopped()
                self.read()
                self._clock.sleep(min(left_s, WATCHED_S))
            later = self.cameras.new((camera,), until_s, settled)[camera]
            after_s = later.frame.exposure_began_s - began_s
            try:
                again = self.cameras.find(clicked, later)
            except PointingError as error:
                message = f"{after_s:.2f} s later {camera} does not see the target any more: {error}"
                raise PointingError("not_repeated", message) from None
            apart_px = again.pixel_px - seen.pixel_px
            before_px, after_px = (view.camera.project(clicked.plane.point_m)[0] for view in (first, later))
            sigma_px = np.hypot(seen.sigma_px, again.sigma_px)
            allowed_px = REPEAT_SIGMAS * sigma_px + np.abs(after_px - before_px)
            if (np.abs(apart_px) > allowed_px).any():
                raise PointingError(
                    "not_repeated",
                    f"{after_s:.2f} s later {camera} shows the target {apart_px[0]:+.2f}, {apart_px[1]:+.2f} "
                    f"px elsewhere, at most {allowed_px[0]:.2f}, {allowed_px[1]:.2f} px (3 sigma) is "
                    "expected of a head at rest. The pictures are older than their stamps ('mastctl camera "
                    "sync' measures by how much), the mast still rings, or the target or the rover moves",
                )
            another = not np.array_equal(first.image, later.image)
            proven = {
                "repeated_after_s": round(after_s, 3),
                "apart_px": rounded(apart_px),
                "fresh_to_s": round(later.frame.exposure_began_s - settled.time_s, 3) if another else 0.0,
            }
            detail.update(camera=camera, frame_ids=[later.frame.frame_id], **match_facts(again))
            detail.update(residual_px=rounded(again.pixel_px - aim_px), **proven)
            evidence = self.motion_evidence
            self.motion_evidence = {**evidence, camera: {**evidence[camera], **proven}}
        return later, again

    def _measure_again(self, confirmed: Sequence[tuple[CameraView, PatchMatch]]) -> None:
        """Measure the position again in the new images, by the aiming camera and its partner.

        Another pair gives the range only; the direction stays the aiming camera's own, free of what the mast
        file has wrong between the two.
        """
        if len(confirmed) < 2:
            with self.step("triangulate"):
                message = "a second pointing needs two cameras of a pair that see the target after the first"
                raise PointingError("no_stereo", message)
        (one, own), (other, seen) = confirmed[-2:]
        position_m = self._triangulate(one, own.pixel_px, other, seen).position_m
        if len(confirmed) > 2:
            aiming, first = confirmed[0]
            ray = aiming.camera.ray(first.pixel_px)
            range_m = float((position_m - ray.origins_m) @ ray.directions)
            self._position_m = ray.origins_m + range_m * ray.directions

    def _solve_and_go(
        self, aim: Aim, aim_px: FloatArray, resting: HeadReading | None
    ) -> tuple[Pair, HeadReading]:
        """Solve for the present position, move, settle; return the commanded readings and the arrival."""
        start = resting or self.read()
        with self.step("solve") as detail:
            best = self._solved(aim, aim_px, start, detail)
        self._range_m = best.range_m
        cameras = [name for name in (aim.camera, self.cameras.partner(aim.camera)) if name is not None]
        self.before(cameras, (best.pan_rad, best.tilt_rad), needed=(aim.camera,))
        return self.go_to_true(best.pan_rad, best.tilt_rad)

    def _solved(self, aim: Aim, aim_px: FloatArray, start: HeadReading, detail: dict[str, Any]) -> Solution:
        """Solve for the present position; return the solution that is taken from ``start``."""
        assert self._position_m is not None
        model = self._rig.cameras[aim.camera].model
        pan_rad, tilt_rad = start.true_rad
        solutions = solve(
            self._rig.mast, model, self._position_m, aim_px, from_pan_rad=pan_rad, from_tilt_rad=tilt_rad
        )
        detail.update(solutions=[_facts(one) for one in solutions])
        best = self.chosen(solutions, start)
        detail.update(chosen=_facts(best))
        return best

    def _measured(
        self, commanded: Pair, now: CameraView, aim_px: FloatArray, seen: PatchMatch | None, **more: Any
    ) -> None:
        """Keep what one pointing did; the steps that follow belong to the next."""
        assert self._position_m is not None
        place, valid = now.camera.project(self._position_m)
        found: dict[str, Any] = {"note": NO_PICTURE_OF_A_POSITION}
        if seen is not None:
            found = {
                "target_px": seen.pixel_px.tolist(),
                "residual_px": (seen.pixel_px - aim_px).tolist(),
                "residual_sigma_px": seen.sigma_px.tolist(),
            }
        one = _pointing(
            commanded,
            now.frame,
            camera=now.frame.camera,
            frame_id=now.frame.frame_id,
            aim_px=aim_px.tolist(),
            predicted_px=place.tolist() if bool(valid) else None,
            motion_evidence=self.motion_evidence,
            **found,
            **more,
        )
        self._pointings.append(one)
        self.pointing += 1

    def _so_far(self) -> PointingResult | None:
        """The result with the pointings done, None without any."""
        if not self._pointings:
            return None
        one = self._one_camera
        return {
            "position_m": None if self._position_m is None else self._position_m.tolist(),
            "range_m": self._range_m,
            "range_from": self._range_from if one is None else one.range_from,
            "range_interval_m": None if one is None else list(one.sight.range_interval_m),
            "pointings": self._pointings,
        }


def _stereo_facts(
    now: CameraView, pixel_px: FloatArray, other: CameraView, partnered: StereoMatch, point: Triangulation
) -> dict[str, Any]:
    """What a pair says of a pixel, for a preview."""
    along = point.position_m - now.camera.ray(pixel_px).origins_m
    along /= np.linalg.norm(along)
    return {
        "other_camera": other.frame.camera,
        "other_frame_id": other.frame.frame_id,
        "other_pixel_px": partnered.match.pixel_px,
        "other_sigma_px": partnered.match.sigma_px,
        "correlation": partnered.match.correlation,
        "second": partnered.match.second,
        "across_px": partnered.across_px,
        "sigma_m": np.sqrt(np.diag(point.covariance_m2)),
        "covariance_m2": point.covariance_m2,
        "range_m": point.ranges_m[0],
        "range_sigma_m": math.sqrt(float(along @ point.covariance_m2 @ along)),
        "range_from": "stereo",
    }


def _facts(solution: Solution) -> dict[str, float]:
    """A solution, for a step's detail."""
    return {
        "pan_rad": round(solution.pan_rad, 6),
        "tilt_rad": round(solution.tilt_rad, 6),
        "range_m": round(solution.range_m, 4) if math.isfinite(solution.range_m) else math.nan,
    }


def _pointing(commanded: Pair, at: HeadReading | StampedFrame, **more: Any) -> Pointing:
    """A pointing with the head's angles as sent and as measured."""
    names = [f"{kind}_{axis}_rad" for kind in ("commanded", "measured", "true") for axis in ("pan", "tilt")]
    angles = dict(zip(names, (*commanded, at.pan_rad, at.tilt_rad, *at.true_rad), strict=True))
    return cast(Pointing, angles | NOT_MEASURED | more)
