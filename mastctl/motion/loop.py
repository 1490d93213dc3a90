"""The pointing loop: see, measure, solve, move, settle, see again, measure what is left.

Steps of a pixel request, as they stand in the record: ``rest``, ``frames``, ``target``, ``stereo``,
``triangulate``; then for each pointing ``solve``, ``limits``, ``move``, ``settle``, ``look``, ``measure``,
``eyes``, ``repeat`` (and ``triangulate``, ``rest`` before the second; ``before`` ahead of the first move if
the aiming eye has no picture yet that the new one could be compared with). A position needs ``rest``,
``solve`` to ``settle`` and ``look``; joint angles ``rest`` and ``limits`` to ``settle``, no picture.

With one camera (its partner is not configured, or ``range_m`` or a plane says how far the target is)
``sight`` takes the place of ``stereo`` and ``triangulate``, ``range`` that of ``eyes``
(`mastctl.motion.one_camera`).

A named frame's other eye may not be kept, and what was clicked may have been seen from another pose; so a
fresh pair is always taken, the clicked patch is found in it, and range comes from that pair. The clicked
patch itself, never a later copy of it, is what is looked for after each move, so nothing drifts.

What the loop does not do: it does not retry, and it reports no residual on a match that is not good, or that
a later picture does not repeat (`mastctl.motion.evidence`).
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from calib.errors import CalibError
from calib.geometry.pointing import solve
from calib.geometry.rig import Rig
from calib.geometry.rigid import FloatArray
from calib.geometry.solutions import Solution
from calib.geometry.stereo import Triangulation, triangulate
from calib.matching.partner import StereoMatch
from calib.matching.verdict import PatchMatch
from drivers.clock import Clock
from drivers.errors import DriverError
from mastctl.devices.joint_history import HeadReading
from mastctl.devices.limits import Limits
from mastctl.errors import MastctlError
from mastctl.motion.looking import CameraView, Clicked, match_facts
from mastctl.motion.one_camera import OneCamera
from mastctl.motion.requests import Aim, AnglesTarget, PixelTarget, PointRequest, PositionTarget, aim_of
from mastctl.motion.results import (
    Pair,
    Pointing,
    PointingError,
    PointingResult,
    Preview,
    Step,
    pair,
    rounded,
    triple,
)
from mastctl.motion.settings import PointingSettings
from mastctl.motion.steps import DevicesLike, FoundAgain, Steps

log = logging.getLogger(__name__)


NO_PICTURE_OF_A_POSITION = "no residual: a position has no picture that could be looked for"
NO_TARGET = "no residual: joint angles name no target; no picture was taken"


class PointingLoop:
    """Points the head at what it is asked, and measures how well it did.

    Parameters
    ----------
    rig
        The mast file in use.
    devices
        Head and cameras.
    limits
        Limits, for the choice among solutions; `devices` checks them again, and knows what is kept out.
    clock
        The clock that stamps readings and frames.
    settings
        Times and tolerances.
    """

    def __init__(
        self,
        rig: Rig,
        devices: DevicesLike,
        limits: Limits,
        clock: Clock,
        settings: PointingSettings | None = None,
    ) -> None:
        self._rig = rig
        self._devices = devices
        self._limits = limits
        self._clock = clock
        self._settings = settings or PointingSettings()

    def run(
        self, request: PointRequest, record: Callable[[Step], None], cancelled: threading.Event
    ) -> PointingResult:
        """Carry out a request; blocks until it is done, at most the sum of its deadlines.

        Parameters
        ----------
        request
            Target, aim, number of pointings.
        record
            Called with each step when it ends.
        cancelled
            Set by somebody else to end the request; the mast is stopped.

        Raises
        ------
        PointingError
            For everything that goes wrong on purpose: its code and one sentence, the step, and the
            pointings done before. The mast was told to stop.
        """
        steps = Steps(self._rig, self._devices, self._limits, self._clock, self._settings, record, cancelled)
        return _Run(steps, self._rig, self._devices, self._limits, self._settings).all(request)

    def preview(self, request: PointRequest, cancelled: threading.Event) -> Preview:
        """Return what a pixel request would point at and where the head would go; nothing moves.

        Parameters
        ----------
        request
            With a pixel of a named frame.
        cancelled
            Ends it.

        Raises
        ------
        MastctlError, DriverError, CalibError
            If what was clicked is not found, or has no range.
        """
        steps = Steps(self._rig, self._devices, self._limits, self._clock, self._settings, _forget, cancelled)
        return _Run(steps, self._rig, self._devices, self._limits, self._settings).preview(request)


def _forget(step: Step) -> None:
    """Of a preview no record is kept."""


class _Run:
    """One request."""

    def __init__(
        self, steps: Steps, rig: Rig, devices: DevicesLike, limits: Limits, settings: PointingSettings
    ) -> None:
        self._steps = steps
        self._eyes = steps.eyes
        self._rig = rig
        self._devices = devices
        self._limits = limits
        self._settings = settings
        self._position_m: FloatArray | None = None
        self._point: Triangulation | None = None
        self._range_m: float | None = None
        self._one_eye: OneCamera | None = None
        self._range_from = ""
        self._pointings: list[Pointing] = []

    def all(self, request: PointRequest) -> PointingResult:
        """Do it, or stop the mast and say what went wrong."""
        try:
            self._do(request)
        except (MastctlError, DriverError, CalibError) as error:
            self._stop()
            code = getattr(error, "code", "failed")
            raise PointingError(
                code, " ".join(str(error).split()), self._steps.last, self._so_far()
            ) from error
        except BaseException:
            self._stop()
            raise
        result = self._so_far()
        assert result is not None
        return result

    def _do(self, request: PointRequest) -> None:
        target, rig = request.target, self._rig
        if isinstance(target, AnglesTarget):
            self._steps.rest()
            settled = self._steps.go(target.pan_rad, target.tilt_rad)
            self._done(_without_picture(target, settled))
            return
        aim = aim_of(request, rig)
        aim_px = np.array([aim.x_px, aim.y_px])
        if isinstance(target, PositionTarget):
            self._position_m = np.array(target.position_m)
            commanded, settled = self._solve_and_go(aim, aim_px, self._steps.rest())
            now = self._steps.look((aim.camera,), settled)[aim.camera]
            self._done(self._pointing(commanded, now, aim_px, None))
            return
        if self._alone(request):
            self._point_with_one_eye(self._see_alone(request)[1], aim, aim_px, request.pointings)
        else:
            self._range_from = "stereo"
            self._point_at(self._see(target), aim, aim_px, request.pointings)

    def preview(self, request: PointRequest) -> Preview:
        """See what was clicked, and where the head would go; nothing moves."""
        assert isinstance(request.target, PixelTarget)
        aim = aim_of(request, self._rig)
        if self._alone(request):
            return self._preview_alone(request, aim)
        found, partnered = self._seen(request.target)
        assert self._point is not None and found.other is not None
        point, now = self._point, found.now
        along = point.position_m - now.camera.ray(found.pixel_px).origins_m
        along /= np.linalg.norm(along)
        goal, refused = self._would_go(aim)
        return Preview(
            camera=now.frame.camera,
            frame_id=now.frame.frame_id,
            pixel_px=pair(found.pixel_px),
            other_camera=found.other.frame.camera,
            other_frame_id=found.other.frame.frame_id,
            other_pixel_px=pair(partnered.match.pixel_px),
            other_sigma_px=pair(partnered.match.sigma_px),
            correlation=float(partnered.match.correlation),
            second=float(partnered.match.second),
            across_px=float(partnered.across_px),
            position_m=triple(point.position_m),
            sigma_m=triple(np.sqrt(np.diag(point.covariance_m2))),
            range_m=float(point.ranges_m[0]),
            range_sigma_m=math.sqrt(float(along @ point.covariance_m2 @ along)),
            range_from="stereo",
            aim=aim,
            goal_rad=goal,
            refused=refused,
        )

    def _preview_alone(self, request: PointRequest, aim: Aim) -> Preview:
        """The same by one camera."""
        found, _ = self._see_alone(request)
        eye = self._one_eye
        assert eye is not None
        self._position_m = eye.position_m
        goal, refused = self._would_go(aim)
        return Preview(
            camera=found.now.frame.camera,
            frame_id=found.now.frame.frame_id,
            pixel_px=pair(found.pixel_px),
            position_m=triple(eye.position_m),
            range_m=eye.sight.range_m,
            range_from=eye.range_from,
            range_interval_m=eye.range_interval_m,
            aim=aim,
            goal_rad=goal,
            refused=refused,
        )

    def _would_go(self, aim: Aim) -> tuple[Pair | None, Mapping[str, str] | None]:
        """The readings that the head would be sent to, and why it would not."""
        goal: Pair | None = None
        try:
            here = self._steps.head.read()
            best = self._chosen(aim, np.array([aim.x_px, aim.y_px]), here, {})
            goal = self._steps.head.goal((best.pan_rad, best.tilt_rad), here)
            self._limits.check(*goal)
            self._steps.head.check_goal(*goal)
        except (MastctlError, CalibError) as error:
            words = " ".join(str(error).split())
            return goal, {"code": getattr(error, "code", "failed"), "message": words}
        return goal, None

    # Steps

    def _done(self, pointing: Pointing) -> None:
        """Keep a pointing; the steps that follow belong to the next."""
        self._pointings.append(pointing)
        self._steps.pointing += 1

    def _see(self, target: PixelTarget) -> Clicked:
        """From the clicked pixel to a position in the rover frame."""
        found, partnered = self._seen(target)
        plane, relief = partnered.plane, partnered.relief
        assert plane is not None and relief is not None
        relief = relief.seen_by(found.view.camera, found.clicked_px, plane, found.now.camera)
        return Clicked(found.view, found.clicked_px, plane, relief=relief)

    def _seen(self, target: PixelTarget) -> tuple[FoundAgain, StereoMatch]:
        """Find the clicked thing in a fresh pair, and its position."""
        found = self._steps.clicked(target)
        now, other = found.now, found.other
        assert other is not None
        with self._steps.step("stereo") as detail:
            detail.update(self._steps.one_moment(now, found.pixel_px, [other], found.resting))
            partnered = self._steps.unless_stopped(self._eyes.stereo, now, found.pixel_px, other)
            detail.update(match_facts(partnered.match), across_px=round(partnered.across_px, 3))
        self._triangulate(now, found.pixel_px, other, partnered.match)
        return found, partnered

    def _alone(self, request: PointRequest) -> bool:
        """Whether one camera points: how far it is was told, or there is no other eye."""
        assert isinstance(request.target, PixelTarget)
        told = request.range_m is not None or request.plane is not None
        return told or self._eyes.partner(request.target.camera) is None

    def _see_alone(self, request: PointRequest) -> tuple[FoundAgain, Clicked]:
        """From the clicked pixel to a line of sight, and what is known of the range."""
        assert isinstance(request.target, PixelTarget)
        found = self._steps.clicked(request.target, alone=True)
        with self._steps.step("sight") as detail:
            self._one_eye = OneCamera(
                self._rig, self._settings, self._devices.reading_sigma_rad, found, request
            )
            detail.update(self._one_eye.told())
            return found, self._one_eye.clicked(found)

    def _point_with_one_eye(self, clicked: Clicked, aim: Aim, aim_px: FloatArray, pointings: int) -> None:
        """Point once or twice at what one camera saw, and measure each time."""
        eye = self._one_eye
        assert eye is not None
        for number in range(1, pointings + 1):
            self._position_m = eye.position_m
            resting = self._steps.rest() if number > 1 else None
            commanded, settled = self._solve_and_go(aim, aim_px, resting)
            now = self._steps.look((aim.camera,), settled)[aim.camera]
            with self._steps.step("measure") as detail:
                expected = eye.expected(now)
                try:
                    seen = self._steps.unless_stopped(self._eyes.look_for, clicked, now)
                except PointingError as error:
                    if eye.range_from != "unknown" or not error.code.startswith("target_"):
                        raise
                    words = f"{error}; how far it is was not known: give range_m or a plane"
                    raise PointingError(error.code, words) from None
                detail.update(
                    camera=aim.camera, **match_facts(seen), residual_px=rounded(seen.pixel_px - aim_px)
                )
                detail.update(predicted_px=rounded(expected.pixel_px), **eye.check(now, seen, expected))
            match_px = float(seen.sigma_px.max())
            later, again = self._steps.repeated(clicked, now, seen, settled, aim_px)
            pointing = self._pointing(commanded, later, aim_px, again)
            known = expected.whole_px2(eye.sight.inverse_sigma_m) + match_px**2 * np.eye(2)
            self._done(
                replace(
                    pointing,
                    predicted_sigma_px=pair(np.sqrt(np.diag(known))),
                    predicted_covariance_px2=(pair(known[0]), pair(known[1])),
                )
            )
            with self._steps.step("range") as detail:
                eye.learn(now, seen.pixel_px, match_px, expected)
                detail.update(eye.told())
        self._position_m, self._range_m = eye.position_m, eye.sight.range_m

    def _triangulate(self, one: CameraView, one_px: FloatArray, other: CameraView, seen: PatchMatch) -> None:
        with self._steps.step("triangulate") as detail:
            # the match is of one pixel of the two that are taken as equally sure
            match_px = float(seen.sigma_px.max()) / math.sqrt(2.0)
            sigma_px = math.hypot(self._settings.triangulation_sigma_px, match_px)
            point = triangulate(one.camera, other.camera, one_px, seen.pixel_px, sigma_px)
            self._position_m, self._point = point.position_m, point
            detail.update(
                position_m=rounded(point.position_m, 5),
                sigma_m=rounded(np.sqrt(np.diag(point.covariance_m2)), 5),
                ray_gap_m=round(point.ray_gap_m, 6),
                range_m=round(point.ranges_m[0], 5),
            )

    def _point_at(self, clicked: Clicked, aim: Aim, aim_px: FloatArray, pointings: int) -> None:
        """Point once or twice at the clicked thing and measure each time."""
        source = clicked.view.frame.camera
        for number in range(1, pointings + 1):
            commanded, settled = self._solve_and_go(aim, aim_px, self._steps.rest() if number > 1 else None)
            assert self._position_m is not None
            companions = self._eyes.companions(aim.camera, source, self._position_m, settled)
            views = self._steps.look((aim.camera, *companions), settled)
            now = views.pop(aim.camera)
            with self._steps.step("measure") as detail:
                seen = self._steps.unless_stopped(self._eyes.look_for, clicked, now)
                detail.update(camera=aim.camera, **match_facts(seen), predicted_px=rounded(seen.predicted_px))
                detail.update(residual_px=rounded(seen.pixel_px - aim_px))
            confirmed: list[tuple[CameraView, PatchMatch]] = [(now, seen)]
            with self._steps.step("eyes") as detail:
                detail.update(confirmed_by=list(companions))
                if views:
                    detail.update(self._steps.one_moment(now, seen.pixel_px, list(views.values()), settled))
                for name, other in views.items():
                    same_pair = {aim.camera, name} == {source, self._eyes.partner(source)}
                    found, detail[name] = self._steps.unless_stopped(
                        self._eyes.agree, clicked, now, seen, other, same_pair
                    )
                    confirmed.append((other, found))
            later, again = self._steps.repeated(clicked, now, seen, settled, aim_px)
            self._done(self._pointing(commanded, later, aim_px, again))
            if number < pointings:
                self._again(confirmed)

    def _again(self, confirmed: Sequence[tuple[CameraView, PatchMatch]]) -> None:
        """Measure the position again in the new pictures, by the aiming eye and its partner.

        Where another pair stood in for the partner it gives the range only; the direction stays the aiming
        eye's own, free of what the mast file has wrong between the two.
        """
        if len(confirmed) < 2:
            with self._steps.step("triangulate"):
                words = "a second pointing needs two cameras of a pair that see the target after the first"
                raise PointingError("no_stereo", words)
        (one, own), (other, seen) = confirmed[-2:]
        self._triangulate(one, own.pixel_px, other, seen)
        if len(confirmed) > 2:
            assert self._position_m is not None
            aiming, first = confirmed[0]
            ray = aiming.camera.ray(first.pixel_px)
            range_m = float((self._position_m - ray.origins_m) @ ray.directions)
            self._position_m = ray.origins_m + range_m * ray.directions

    def _solve_and_go(
        self, aim: Aim, aim_px: FloatArray, resting: HeadReading | None
    ) -> tuple[Pair, HeadReading]:
        """Solve for the present position, move, settle; return the commanded readings and the arrival."""
        assert self._position_m is not None
        here = resting or self._steps.head.read()
        with self._steps.step("solve") as detail:
            best = self._chosen(aim, aim_px, here, detail)
        self._range_m = best.range_m
        eyes = [name for name in (aim.camera, self._eyes.partner(aim.camera)) if name is not None]
        self._steps.before(eyes, (best.pan_rad, best.tilt_rad), needed=(aim.camera,))
        return self._steps.go_to_true(best.pan_rad, best.tilt_rad, aim.camera)

    def _chosen(self, aim: Aim, aim_px: FloatArray, here: HeadReading, detail: dict[str, Any]) -> Solution:
        """Solve for the present position; return the solution that is taken from ``here``."""
        assert self._position_m is not None
        model = self._rig.cameras[aim.camera].model
        pan_rad, tilt_rad = here.true_rad
        solutions = solve(
            self._rig.mast, model, self._position_m, aim_px, from_pan_rad=pan_rad, from_tilt_rad=tilt_rad
        )
        detail.update(solutions=[_told(one) for one in solutions])
        best = self._steps.head.chosen(solutions, here)
        detail.update(chosen=_told(best))
        return best

    def _pointing(
        self, commanded: Pair, now: CameraView, aim_px: FloatArray, seen: PatchMatch | None
    ) -> Pointing:
        """Put together what one pointing did."""
        assert self._position_m is not None
        place, valid = now.camera.project(self._position_m)
        return Pointing(
            commanded_pan_rad=commanded[0],
            commanded_tilt_rad=commanded[1],
            measured_pan_rad=now.frame.pan_rad,
            measured_tilt_rad=now.frame.tilt_rad,
            true_pan_rad=now.frame.true_pan_rad,
            true_tilt_rad=now.frame.true_tilt_rad,
            camera=now.frame.camera,
            frame_id=now.frame.frame_id,
            aim_px=pair(aim_px),
            predicted_px=pair(place) if bool(valid) else None,
            target_px=None if seen is None else pair(seen.pixel_px),
            residual_px=None if seen is None else pair(seen.pixel_px - aim_px),
            residual_sigma_px=None if seen is None else pair(seen.sigma_px),
            note=NO_PICTURE_OF_A_POSITION if seen is None else "",
            motion_evidence=self._steps.motion_evidence,
        )

    def _so_far(self) -> PointingResult | None:
        """Return the result with the pointings done, None without any."""
        if not self._pointings:
            return None
        position = None if self._position_m is None else triple(self._position_m)
        eye = self._one_eye
        return PointingResult(
            position,
            self._range_m,
            tuple(self._pointings),
            self._range_from if eye is None else eye.range_from,
            None if eye is None else eye.range_interval_m,
        )

    def _stop(self) -> None:
        """Stop the mast whatever happened; what stops it must not hide why."""
        try:
            self._devices.stop()
        except Exception as error:
            log.error("the head did not confirm the stop: %s: %s", type(error).__name__, error)


def _told(solution: Solution) -> dict[str, float]:
    """Return a solution for a step's detail."""
    return {
        "pan_rad": round(solution.pan_rad, 6),
        "tilt_rad": round(solution.tilt_rad, 6),
        "range_m": round(solution.range_m, 4) if math.isfinite(solution.range_m) else math.nan,
    }


def _without_picture(target: AnglesTarget, settled: HeadReading) -> Pointing:
    """Return the pointing of joint angles: where the head rests, and nothing measured."""
    return Pointing(
        commanded_pan_rad=target.pan_rad,
        commanded_tilt_rad=target.tilt_rad,
        measured_pan_rad=settled.pan_rad,
        measured_tilt_rad=settled.tilt_rad,
        true_pan_rad=settled.true_rad[0],
        true_tilt_rad=settled.true_rad[1],
        camera="",
        frame_id="",
        aim_px=None,
        predicted_px=None,
        target_px=None,
        residual_px=None,
        residual_sigma_px=None,
        note=NO_TARGET,
    )
