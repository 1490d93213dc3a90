"""Motion within limits, the stop, and operations whose times are in order."""

from __future__ import annotations

import itertools
import time
from typing import Any

import cv2
import numpy as np

from mastctl.client import Snapshot
from mastctl.conform.checks import NotTried, PromiseBroken, Suite, expect
from mastctl.conform.daemon import ARRIVED_RAD, POLL_S, Daemon, field, number

MOTION: Suite[Daemon] = Suite()

BEYOND_RAD = 0.015  # an approach may pass a limit by its own length, and a reading has its noise
FASTER_PART, FASTER_RAD_PER_S = 0.1, 0.05
PACE_S = 0.1  # readings nearer to each other tell more of their noise than of a speed
STOP_TRIES = 4
BRAKED_WITHIN_S = 3.0
CLICKS = 6
BEGINS_WITHIN_S = 5.0
ORDER_S = 0.002
OF_THE_SCENE = {
    "target_flat", "target_ambiguous", "target_border", "target_not_found", "target_moving", "not_in_view",
    "outside_image", "outside_limits", "eyes_disagree", "too_near", "blind_cone", "not_one_point",
}  # fmt: skip
"""Why a click may come to nothing with a daemon that does all it should."""


@MOTION.check(
    "motion.pointing", "a pointing to joint angles ends there, inside the limits all the way", moves=True
)
def _pointing(daemon: Daemon) -> str:
    worst_rad, seen = 0.0, 0
    ends = daemon.limits[:2]

    def inside(status: dict[str, Any]) -> None:
        nonlocal seen
        seen += 1
        for name, (low, high) in zip(("pan", "tilt"), ends, strict=True):
            angle = number(status, "joints", f"{name}_rad")
            beyond = max(low - angle, angle - high)
            expect(
                beyond <= BEYOND_RAD,
                f"{name} is measured at {angle:.4f} rad, {beyond:.4f} rad beyond its limit",
            )

    for parts in ((0.6, -0.4), (-0.6, 0.4), (0.0, 0.0)):
        goal = daemon.goal(*parts)
        record = daemon.point(goal, inside)
        status = daemon.rest()
        inside(status)
        at = number(status, "joints", "pan_rad"), number(status, "joints", "tilt_rad")
        off_rad = max(abs(a - g) for a, g in zip(at, goal, strict=True))
        expect(
            off_rad <= ARRIVED_RAD,
            f"sent to ({goal[0]:.4f}, {goal[1]:.4f}) rad the head rests at ({at[0]:.4f}, {at[1]:.4f}) rad",
        )
        expect(record.get("residual_px") is None, "residual_px is told where no picture was to be compared")
        worst_rad = max(worst_rad, off_rad)
    return f"within {worst_rad:.1e} rad, seen {seen} times on the way"


@MOTION.check("motion.speed", "the head is never measured to go faster than its limit", moves=True)
def _speed(daemon: Daemon) -> str:
    limit = daemon.limits[2]
    bound = limit * (1 + FASTER_PART) + FASTER_RAD_PER_S
    readings: list[tuple[float, float, float]] = []

    def note(status: dict[str, Any]) -> None:
        joints = field(status, "joints")
        readings.append((number(joints, "measured_s"), number(joints, "pan_rad"), number(joints, "tilt_rad")))

    daemon.point(daemon.goal(-0.9, -0.9))
    daemon.point(daemon.goal(0.9, 0.9), note)
    fastest = 0.0
    for index, (time_s, *angles) in enumerate(readings):
        for later_s, *later in readings[index + 1 :]:
            if later_s - time_s >= PACE_S:
                way = max(abs(b - a) for a, b in zip(angles, later, strict=True))
                fastest = max(fastest, way / (later_s - time_s))
                break
    expect(fastest <= bound, f"{fastest:.3f} rad/s was measured where the limit is {limit:g} rad/s")
    if fastest == 0.0:
        raise NotTried("the move was too short to be seen; a larger --reach shows it")
    return f"{fastest:.3f} rad/s, limit {limit:g} rad/s"


@MOTION.check(
    "motion.busy", "while an operation runs another one is refused, and the status names it", moves=True
)
def _busy(daemon: Daemon) -> None:
    daemon.point(daemon.goal(-0.9, 0.0))
    for way in (1, -1, 1):
        goal = daemon.goal(0.9 * way, 0.0)
        name = daemon.start({"pan_rad": goal[0], "tilt_rad": goal[1]})
        runs = daemon.status().get("operation")
        answer = daemon.wire.ask("POST", "/point", json={"pan_rad": goal[0], "tilt_rad": goal[1]})
        if answer.status >= 400:
            expect(answer.status == 409, f"a second pointing: {answer.status} where 409 is expected")
            expect(answer.refusal[0] == "busy", f"a second pointing: code {answer.refusal[0]!r}, not busy")
            expect(runs in (name, None), f"the status names operation {runs}, {name} was started")
            daemon.ended(name)
            return
        second = field(answer.document(), "id")
        began_s, ended_s = (daemon.ended(str(second)).get("created_s"), daemon.ended(name).get("ended_s"))
        expect(
            isinstance(began_s, float) and isinstance(ended_s, float) and began_s >= ended_s,
            f"operation {second} was taken while {name} ran",
        )
    raise NotTried("every operation had ended before the next was asked for; a larger --reach takes longer")


@MOTION.check("motion.stop", "a stop ends motion and operation short of the goal, from anybody", moves=True)
def _stop(daemon: Daemon) -> str:
    for attempt in range(STOP_TRIES):
        way = 1 if attempt % 2 == 0 else -1
        daemon.point(daemon.goal(-way, -way))
        told = _stopped_on_the_way(daemon, daemon.goal(way, way))
        if told:
            return told
    raise NotTried("the head had come too near to its goal before the stop; a larger --reach shows it")


def _stopped_on_the_way(daemon: Daemon, goal: tuple[float, float]) -> str:
    """Send the head off and stop it; empty if it was too near to its goal to tell."""
    name = daemon.start({"pan_rad": goal[0], "tilt_rad": goal[1]})
    until_s = time.monotonic() + BEGINS_WITHIN_S
    while True:
        asked_s = time.monotonic()
        status = daemon.status()
        if status.get("moving"):
            break
        if time.monotonic() > until_s or daemon.operation(name)["state"] in ("done", "failed"):
            return ""
    left_rad = _left(status, goal)
    answer = daemon.wire.stop()
    took_s = time.monotonic() - asked_s + number(field(status, "joints"), "age_s")
    expect(answer.status == 200, f"POST /stop: {answer.status} where 200 is expected{answer.why}")
    expect(answer.document().get("stopped") is True, "POST /stop does not answer that it stopped")
    status = daemon.rest(BRAKED_WITHIN_S)
    record = daemon.ended(name)
    rests_rad = _left(status, goal)
    if rests_rad <= ARRIVED_RAD and left_rad < 2 * daemon.limits[2] * took_s:
        return ""
    expect(
        rests_rad > ARRIVED_RAD,
        f"stopped {left_rad:.3f} rad before its goal the head went on ({took_s:.2f} s from that reading)",
    )
    expect(record["state"] == "stopped", f"the operation that was stopped ended {record['state']!r}")
    word = daemon.status().get("state")
    expect(word == "holding", f"after the stop the state is {word!r}, not holding")
    daemon.let_pass(10 * POLL_S)
    crept_rad = abs(_left(daemon.status(), goal) - rests_rad)
    expect(crept_rad <= ARRIVED_RAD, f"after the stop the head crept by {crept_rad:.4f} rad")
    return (
        f"{rests_rad:.3f} rad short of the goal, answered in {1e3 * (answer.ended_s - answer.began_s):.0f} ms"
    )


def _left(status: dict[str, Any], goal: tuple[float, float]) -> float:
    """How far the head is from its goal, the farther axis, radians."""
    joints = field(status, "joints")
    return max(abs(number(joints, "pan_rad") - goal[0]), abs(number(joints, "tilt_rad") - goal[1]))


@MOTION.check(
    "motion.stop_at_rest", "a stop at rest is taken too, again and again, whatever body comes with it"
)
def _stop_at_rest(daemon: Daemon) -> None:
    before = daemon.joints()
    for options in ({}, {}, {"content": "not JSON", "headers": {"Content-Type": "text/plain"}}):
        answer = daemon.wire.ask("POST", "/stop", **options)
        expect(answer.status == 200, f"POST /stop: {answer.status} where 200 is expected{answer.why}")
    now = daemon.joints()
    moved_rad = max(abs(a - b) for a, b in zip(before, now, strict=True))
    expect(moved_rad <= ARRIVED_RAD, f"a stop at rest moved the head by {moved_rad:.4f} rad")


@MOTION.check("motion.after_stop", "after a stop the next pointing goes out", moves=True)
def _after_stop(daemon: Daemon) -> None:
    daemon.wire.stop()
    daemon.point(daemon.goal(0.0, 0.0))


@MOTION.check(
    "motion.estop",
    "an emergency stop refuses moves until a reset with reason and name, and that moves nothing",
    moves=True,
)
def _estop(daemon: Daemon) -> str:
    words = {"reason": "a check of this daemon's promises", "name": "mastctl conform"}
    before = daemon.joints()
    answer = daemon.wire.ask("POST", "/estop", json=words)
    expect(answer.status == 200, f"POST /estop: {answer.status} where 200 is expected{answer.why}")
    told = answer.document()
    expect(told.get("latched") is True, "POST /estop does not answer that it is latched")
    try:
        goal = daemon.goal(0.5, 0.5)
        moved = daemon.wire.ask("POST", "/point", json={"pan_rad": goal[0], "tilt_rad": goal[1]})
        expect(
            (moved.status, moved.refusal[0]) == (409, "estopped"),
            f"a pointing after it: {moved.status} {moved.refusal[0]} where 409 estopped is expected",
        )
        expect(daemon.status().get("state") == "stopped", "after an emergency stop the state is not stopped")
        for half in ({"reason": words["reason"]}, {"name": words["name"]}):
            refused = daemon.wire.ask("POST", "/reset", json=half)
            expect(
                refused.status == 422,
                f"a reset with half of its words: {refused.status} where 422 is expected",
            )
    finally:
        released = daemon.wire.ask("POST", "/reset", json=words)
    expect(released.status == 200, f"POST /reset: {released.status} where 200 is expected{released.why}")
    daemon.let_pass(10 * POLL_S)
    now = daemon.joints()
    moved_rad = max(abs(a - b) for a, b in zip(before, now, strict=True))
    expect(moved_rad <= ARRIVED_RAD, f"emergency stop and reset moved the head by {moved_rad:.4f} rad")
    return "kept across a restart" if told.get("kept") else "not kept across a restart"


@MOTION.check(
    "times.operations", "an operation's times are in order, and within those of the request", moves=True
)
def _operations(daemon: Daemon) -> str:
    asked_s = number(daemon.status(), "now_s")
    record = daemon.point(daemon.goal(0.3, 0.3))
    told_s = number(daemon.status(), "now_s")
    marks = [("the request", asked_s)]
    marks += [(key, number(record, key)) for key in ("created_s", "started_s")]
    steps = field(record, "steps")
    expect(isinstance(steps, list) and steps, "an operation that moved the head has no steps")
    for step in steps:
        name = str(field(step, "name"))
        began_s, duration_s = number(step, "started_s"), number(step, "duration_s")
        expect(duration_s >= 0, f"step {name} took {duration_s} s")
        marks += [(f"the begin of step {name}", began_s), (f"the end of step {name}", began_s + duration_s)]
    marks += [("ended_s", number(record, "ended_s")), ("the answer", told_s)]
    for (before, before_s), (after, after_s) in itertools.pairwise(marks):
        expect(after_s >= before_s - ORDER_S, f"{after} is told {before_s - after_s:.4f} s before {before}")
    return f"{len(steps)} steps in {marks[-2][1] - marks[1][1]:.2f} s"


@MOTION.check(
    "clicks.pointed", "a click on a frame ends with a residual measured in a newer picture", moves=True
)
def _clicked(daemon: Daemon) -> str:
    camera = _eye(daemon)
    reasons = []
    for attempt in range(CLICKS):
        daemon.rest()
        _, shot = daemon.picture(camera, fresh="true")
        places = _places(daemon, shot)
        if attempt >= len(places):
            break
        x, y = places[attempt]
        body = {"pixel": {"camera": camera, "frame_id": shot.frame_id, "x_px": x, "y_px": y}}
        record = daemon.ended(daemon.start(body))
        if record["state"] == "done":
            return _residual(daemon, shot, record)
        code, message = (str(field(record, "error", key)) for key in ("code", "message"))
        expect(code in OF_THE_SCENE, f"the operation ended {record['state']}: {code}: {message}")
        reasons.append(f"{code}: {message}")
    words = reasons[-1] if reasons else "the picture shows nothing that stands out"
    raise NotTried(f"nothing that was clicked could be pointed at; the last time {words}")


def _places(daemon: Daemon, shot: Snapshot) -> list[tuple[float, float]]:
    """Pixels that stand out, the clearest first, near enough to the image centre for the reach."""
    grey = shot.image if shot.image.ndim == 2 else cv2.cvtColor(shot.image, cv2.COLOR_BGR2GRAY)
    height, width = grey.shape
    told = daemon.mast_cameras[shot.camera]
    focal_px = float(np.linalg.norm(np.cross(told["A"], told["H"])))
    half = round(min(0.25 * min(width, height), 0.5 * daemon.reach_rad * focal_px))
    mask = np.zeros_like(grey)
    mask[height // 2 - half : height // 2 + half, width // 2 - half : width // 2 + half] = 255
    found = cv2.goodFeaturesToTrack(grey, CLICKS, 0.01, max(2.0, half / 4), mask=mask, blockSize=7)
    return [] if found is None else [(float(x), float(y)) for x, y in found.reshape(-1, 2)]


def _residual(daemon: Daemon, shot: Snapshot, record: dict[str, Any]) -> str:
    """Say the residual of a pointing that is done. Raises PromiseBroken if it cannot be one."""
    for key in ("residual_px", "residual_sigma_px"):
        pair = field(record, key)
        expect(isinstance(pair, list) and len(pair) == 2, f"{key} is {pair!r} where two numbers are expected")
    residual, sigma = (
        [number({key: v}, key) for v in record[key]] for key in ("residual_px", "residual_sigma_px")
    )
    expect(min(sigma) > 0, f"residual_sigma_px is {sigma}")
    last = field(record, "pointings")[-1]
    answer = daemon.wire.ask(
        "GET", f"/snapshot/{shot.camera}", params={"frame_id": str(field(last, "frame_id"))}
    )
    if answer.status == 200:
        mid_s = float(answer.headers["X-Mastctl-Mid-Exposure-S"])
        expect(mid_s > shot.mid_exposure_s, "the residual was measured in a picture from before the click")
    return f"residual {residual[0]:.2f}, {residual[1]:.2f} px, sigma {sigma[0]:.2f}, {sigma[1]:.2f} px"


def _eye(daemon: Daemon) -> str:
    """A camera on the head that has its other eye."""
    for camera in daemon.cameras:
        other = camera.replace("_left", "_right") if camera.endswith("_left") else ""
        on = daemon.mast_cameras.get(camera, {}).get("on")
        if on == "head" and other in daemon.cameras:
            return camera
    raise NotTried("no stereo pair on the head gives pictures")


@MOTION.check("motion.home", "the head goes back to where it stood before the checks", moves=True)
def _home(daemon: Daemon) -> None:
    joints = field(daemon.began, "joints")
    pan, tilt, _ = daemon.limits
    home = [
        min(max(number(joints, key), low), high)
        for key, (low, high) in (("pan_rad", pan), ("tilt_rad", tilt))
    ]
    try:
        daemon.point((home[0], home[1]))
    except PromiseBroken:
        daemon.wire.stop()
        raise
