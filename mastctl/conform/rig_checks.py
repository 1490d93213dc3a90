"""What a rig promises through its daemon: fresh readings and frames, motion within limits, the stop."""

from __future__ import annotations

import hashlib
import itertools
import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any

import cv2
import numpy as np

from mastctl.client import ClientError, Snapshot
from mastctl.conform.device_checks import NotTried, PromiseBroken, expect
from mastctl.conform.rig import ARRIVED_RAD, POLL_S, Angles, Check, RigTrial

RIG: list[Check] = []
"""The checks in the order in which they run."""

Test = Callable[[RigTrial], str | None]

READ_EVERY_S = 1.0  # the head at rest is read 20 times a second; a reading this old is none
BEYOND_RAD = 0.015  # an approach may pass a limit by its own length, and a reading has its noise
FASTER_PART, FASTER_RAD_PER_S = 0.1, 0.05
PACE_S = 0.1  # readings nearer to each other tell more of their noise than of a speed
STOP_TRIES = 4
BRAKED_WITHIN_S = 3.0
BEGINS_WITHIN_S = 5.0
CLICKS = 6
OF_THE_SCENE = {
    "target_flat", "target_ambiguous", "target_border", "target_not_found", "target_moving", "not_in_view",
    "outside_image", "outside_limits", "eyes_disagree", "too_near", "blind_cone", "not_one_point",
}  # fmt: skip
"""Why a click may come to nothing with a rig that does all it should."""


def _check(name: str, promise: str, *, moves: bool = False) -> Callable[[Test], Test]:
    """Add a function to the checks."""

    def add(test: Test) -> Test:
        RIG.append(Check(name, promise, moves, test))
        return test

    return add


@_check("status.joints", "measured joint angles are finite, within a turn, and fresh")
def _joints(trial: RigTrial) -> str:
    status = trial.status()
    pan, tilt = trial.joints(status)
    for name, angle in (("pan_rad", pan), ("tilt_rad", tilt)):
        expect(
            math.isfinite(angle) and abs(angle) <= math.tau, f"joints.{name} is {angle}, beyond a full turn"
        )
    age_s = status["joints"]["age_s"]
    expect(0 <= age_s < READ_EVERY_S, f"joints.age_s is {age_s:.3f} s: no reading came for so long")
    return f"pan {pan:.4f} rad, tilt {tilt:.4f} rad, {age_s:.3f} s old"


@_check("pictures.facts", "a picture is a PNG of the mast file's size, and its headers are true at rest")
def _facts(trial: RigTrial) -> str:
    digest, at = hashlib.sha256(trial.mast).hexdigest(), trial.joints(trial.rest())
    for camera in trial.cameras:
        shot = trial.client.snapshot(camera)
        expect(shot.data.startswith(b"\x89PNG\r\n"), f"{camera}: the picture is announced as PNG and is not")
        height, width = shot.image.shape[:2]
        size = trial.mast_cameras[camera]["size_px"]
        expect(
            list(size) == [width, height],
            f"{camera}: {width}x{height} px where the mast file has {'x'.join(map(str, size))} px",
        )
        expect(shot.camera == camera, f"{camera}: its picture says that it is of {shot.camera}")
        expect(shot.mast_digest == digest, f"{camera}: the digest is not that of the mast file in use")
        expect(shot.exposure_s >= 0, f"{camera}: exposure {shot.exposure_s} s")
        expect(not shot.moving, f"{camera}: a picture of the head at rest says that it moved")
        off_rad = _away((shot.pan_rad, shot.tilt_rad), at)
        expect(off_rad <= ARRIVED_RAD, f"{camera}: its angles are {off_rad:.4f} rad from the measured ones")
    return f"{len(trial.cameras)} cameras"


@_check("pictures.fresh", "exposed within its request; ids are unique, counts and times grow together")
def _fresh(trial: RigTrial) -> str:
    longest_s, seen = 0.0, set()
    for camera in trial.cameras:
        shots: list[Snapshot] = []
        for _ in range(3):
            before_s = trial.status()["now_s"]
            shot = trial.client.snapshot(camera)
            after_s = trial.status()["now_s"]
            early_s = before_s - (shot.mid_exposure_s - shot.exposure_s / 2)
            late_s = shot.mid_exposure_s + shot.exposure_s / 2 - after_s
            expect(early_s <= 0, f"{camera}: the exposure began {early_s:.4f} s before the request")
            expect(late_s <= 0, f"{camera}: the exposure ends {late_s:.4f} s after the answer")
            expect(shot.frame_id not in seen, f"{camera}: two pictures bear the id {shot.frame_id}")
            seen.add(shot.frame_id)
            shots.append(shot)
            longest_s = max(longest_s, after_s - before_s)
        for before, shot in itertools.pairwise(shots):
            expect(
                shot.sequence > before.sequence and shot.mid_exposure_s > before.mid_exposure_s,
                f"{camera}: frame {shot.sequence} of {shot.mid_exposure_s:.4f} s came after frame "
                f"{before.sequence} of {before.mid_exposure_s:.4f} s",
            )
    return f"at most {longest_s:.2f} s a picture"


@_check(
    "motion.pointing",
    "a pointing to joint angles ends there, inside the limits and no faster than the limit all the way",
    moves=True,
)
def _pointing(trial: RigTrial) -> str:
    worst_rad, readings = 0.0, list[tuple[float, Angles]]()

    def note(status: Mapping[str, Any]) -> None:
        angles = trial.joints(status)
        readings.append((status["joints"]["measured_s"], angles))
        for name, angle, (low, high) in zip(("pan", "tilt"), angles, trial.limits, strict=True):
            beyond = max(low - angle, angle - high)
            message = f"{name} is measured at {angle:.4f} rad, {beyond:.4f} rad beyond its limit"
            expect(beyond <= BEYOND_RAD, message)

    for parts in ((0.9, -0.9), (-0.9, 0.9), (0.0, 0.0)):
        goal = trial.goal(*parts)
        record = trial.point(goal, note)
        status = trial.rest()
        note(status)
        at = trial.joints(status)
        off_rad = _away(at, goal)
        expect(
            off_rad <= ARRIVED_RAD,
            f"sent to ({goal[0]:.4f}, {goal[1]:.4f}) rad the head rests at ({at[0]:.4f}, {at[1]:.4f}) rad",
        )
        expect(record.get("residual_px") is None, "residual_px is given where no picture was to be compared")
        worst_rad = max(worst_rad, off_rad)
    fastest = 0.0
    for index, (time_s, angles) in enumerate(readings):
        later = next((one for one in readings[index + 1 :] if one[0] - time_s >= PACE_S), None)
        if later is not None:
            fastest = max(fastest, _away(angles, later[1]) / (later[0] - time_s))
    limit = trial.began["limits"]["speed_rad_per_s"]
    bound = limit * (1 + FASTER_PART) + FASTER_RAD_PER_S
    expect(fastest <= bound, f"{fastest:.3f} rad/s was measured where the limit is {limit:g} rad/s")
    return f"within {worst_rad:.1e} rad, at most {fastest:.3f} rad/s of {limit:g} rad/s"


@_check(
    "motion.stop",
    "a stop ends motion and operation short of the goal, and the next pointing goes out",
    moves=True,
)
def _stop(trial: RigTrial) -> str:
    ran_on = 0
    for attempt in range(STOP_TRIES):
        side = 1 if attempt % 2 == 0 else -1
        trial.point(trial.goal(-side, -side))
        goal = trial.goal(side, side)
        name = trial.start(goal)
        left_rad, read_s = _left(trial, name, goal)
        sent_s = time.monotonic()
        expect(trial.client.stop().get("stopped") is True, "POST /stop does not answer that it stopped")
        answered_s = time.monotonic()
        rests_rad = _away(trial.joints(trial.rest(BRAKED_WITHIN_S)), goal)
        record = trial.ended(name)
        if rests_rad <= ARRIVED_RAD:  # a stop that came too late cannot tell
            ran_on += left_rad > 2 * trial.began["limits"]["speed_rad_per_s"] * (answered_s - read_s)
            continue
        expect(record["state"] == "stopped", f"the operation that was stopped ended {record['state']!r}")
        state = trial.status().get("state")
        expect(state == "holding", f"after the stop the state is {state!r}, not holding")
        trial.let_pass(10 * POLL_S)
        crept_rad = abs(_away(trial.joints(), goal) - rests_rad)
        expect(crept_rad <= ARRIVED_RAD, f"after the stop the head crept by {crept_rad:.4f} rad")
        trial.point(trial.goal(0.0, 0.0))
        return f"{rests_rad:.3f} rad short of the goal, answered in {1e3 * (answered_s - sent_s):.0f} ms"
    expect(not ran_on, "stopped on its way the head went on to its goal")
    raise NotTried("the head had come too near to its goal before the stop; a larger --reach shows it")


def _left(trial: RigTrial, name: str, goal: Angles) -> tuple[float, float]:
    """Wait until an operation moves the head; return how much is left to its goal, and when that was read.

    Nothing is left where the operation ended before it was seen to move the head.
    """
    until_s = time.monotonic() + BEGINS_WITHIN_S
    while True:
        began_s, status = time.monotonic(), trial.status()
        if status.get("moving"):
            return _away(trial.joints(status), goal), began_s - status["joints"]["age_s"]
        if began_s > until_s or trial.client.operation(name)["state"] in ("done", "failed"):
            return 0.0, began_s


@_check("motion.stop_at_rest", "a stop at rest is taken too, again and again, and moves nothing")
def _stop_at_rest(trial: RigTrial) -> None:
    before = trial.joints()
    for _ in range(3):
        trial.client.stop()
    moved_rad = _away(before, trial.joints())
    expect(moved_rad <= ARRIVED_RAD, f"a stop at rest moved the head by {moved_rad:.4f} rad")


@_check("motion.estop", "an emergency stop refuses moves until a reset, and that moves nothing", moves=True)
def _estop(trial: RigTrial) -> str:
    reason, name = "a check of this rig's promises", "mastctl conform"
    before = trial.joints()
    answer = trial.client.estop(reason=reason, name=name)
    expect(answer.get("latched") is True, "POST /estop does not answer that it is latched")
    try:
        try:
            trial.start(trial.goal(0.5, 0.5))
        except ClientError as error:
            expect(error.code == "estopped", f"a pointing after it: {error.code} where estopped is expected")
        else:
            raise PromiseBroken("a pointing after it was taken")
        expect(trial.status().get("state") == "stopped", "after an emergency stop the state is not stopped")
    finally:
        others = [one for one in trial.status()["estops"] if one["name"] != name]
        if not others:
            trial.client.reset(reason=reason, name=name)
    if others:
        raise NotTried(f"{others[0]['name']} stopped the head too ({others[0]['reason']}): it stays latched")
    trial.let_pass(10 * POLL_S)
    moved_rad = _away(before, trial.joints())
    expect(moved_rad <= ARRIVED_RAD, f"emergency stop and reset moved the head by {moved_rad:.4f} rad")
    return "kept across a restart" if answer.get("kept") else "not kept across a restart"


@_check("clicks.pointed", "a click on a frame ends with a residual measured in a newer picture", moves=True)
def _clicked(trial: RigTrial) -> str:
    camera = _clicked_camera(trial)
    reasons = []
    for attempt in range(CLICKS):
        trial.rest()
        shot = trial.client.snapshot(camera)
        places = _places(trial, shot)
        if attempt >= len(places):
            break
        record = trial.ended(trial.client.point(pixel=(camera, shot.frame_id, *places[attempt])))
        if record["state"] == "done":
            return _residual(trial, shot, record)
        code, message = record["error"]["code"], record["error"]["message"]
        expect(code in OF_THE_SCENE, f"the operation ended {record['state']}: {code}: {message}")
        reasons.append(f"{code}: {message}")
    reason = reasons[-1] if reasons else "the picture shows nothing that stands out"
    raise NotTried(f"nothing that was clicked could be pointed at; the last time {reason}")


def _clicked_camera(trial: RigTrial) -> str:
    """The left camera of a stereo pair on the head."""
    for camera in trial.cameras:
        other = camera.removesuffix("_left") + "_right"
        on = trial.mast_cameras.get(camera, {}).get("on")
        if on == "head" and camera.endswith("_left") and other in trial.cameras:
            return camera
    raise NotTried("no stereo pair on the head gives pictures")


def _places(trial: RigTrial, shot: Snapshot) -> list[tuple[float, float]]:
    """Pixels that stand out, the clearest first, near enough to the image centre for the reach."""
    grey = shot.image if shot.image.ndim == 2 else cv2.cvtColor(shot.image, cv2.COLOR_BGR2GRAY)
    height, width = grey.shape
    vectors = trial.mast_cameras[shot.camera]
    focal_px = float(np.linalg.norm(np.cross(vectors["A"], vectors["H"])))
    half = round(min(0.25 * min(width, height), 0.5 * trial.reach_rad * focal_px))
    mask = np.zeros_like(grey)
    mask[height // 2 - half : height // 2 + half, width // 2 - half : width // 2 + half] = 255
    found = cv2.goodFeaturesToTrack(grey, CLICKS, 0.01, max(2.0, half / 4), mask=mask, blockSize=7)
    return [] if found is None else [(float(x), float(y)) for x, y in found.reshape(-1, 2)]


def _residual(trial: RigTrial, shot: Snapshot, record: dict[str, Any]) -> str:
    """Return the residual of a pointing that is done. Raises PromiseBroken if it cannot be one."""
    residual, sigma = record["residual_px"], record["residual_sigma_px"]
    expect(residual is not None and len(residual) == len(sigma) == 2, f"residual_px is {residual!r}")
    expect(min(sigma) > 0, f"residual_sigma_px is {sigma}")
    with suppress(ClientError):  # it need not be kept any more
        last = trial.client.snapshot(shot.camera, frame_id=record["pointings"][-1]["frame_id"])
        message = "the residual was measured in a picture from before the click"
        expect(last.mid_exposure_s > shot.mid_exposure_s, message)
    return f"residual {residual[0]:.2f}, {residual[1]:.2f} px, sigma {sigma[0]:.2f}, {sigma[1]:.2f} px"


@_check("motion.home", "the head goes back to where it stood before the checks", moves=True)
def _home(trial: RigTrial) -> None:
    pan, tilt = (
        min(max(angle, low), high)
        for angle, (low, high) in zip(trial.joints(trial.began), trial.limits, strict=True)
    )
    try:
        trial.point((pan, tilt))
    except PromiseBroken:
        trial.client.stop()
        raise


def _away(angles: Angles, others: Angles) -> float:
    """How far angles are apart, the farther axis, radians."""
    return max(abs(a - b) for a, b in zip(angles, others, strict=True))
