"""What ROS wants of the head: messages as goals, carried out one at a time under a lease of their own.

A goal is an operation of the daemon: joint angles, a point of the rover frame, or a pixel. A new goal takes
the place of the one before, which is stopped first. The lease runs from a goal's beginning to its end and is
renewed meanwhile, so that others can steer in between; when it is not renewed, the daemon stops what runs.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mastctl.client import Client, ClientError
from mastctl.ros2.state import FRAMES, DaemonState, RosNames
from mastctl.ros2.tf_tree import NS, NoTransform, stamp_ns

log = logging.getLogger(__name__)

LEASE_S = 2.0
WAIT_S = 600.0
"""Longest time of one goal; the daemon's own deadline is sooner."""
TF_WAIT_S = 1.0
FAR_M = 1e6


@dataclass(frozen=True)
class GoalOutcome:
    """How a goal ended: ``state`` is ``done``, ``failed``, ``stopped``, ``refused`` or ``replaced``.

    ``operation`` is the daemon's record, where there is one.
    """

    state: str
    code: str = ""
    message: str = ""
    operation: Mapping[str, Any] | None = None


ENDED = GoalOutcome("stopped", message="the adapter ends")
REPLACED = GoalOutcome("replaced", message="a newer goal came")


@dataclass(eq=False)
class Goal:
    """One goal of ROS; ``name`` is for logs.

    ``request`` returns the arguments of `Client.point`; it may wait, and raises ValueError with a sentence.
    """

    name: str
    request: Callable[[Client], Mapping[str, Any]]
    outcome: Future[GoalOutcome] = field(default_factory=Future)
    withdrawn: bool = False


class RosSteering:
    """Carries out goals in a thread of its own; `close` stops what runs.

    ``connect`` makes a client of the daemon.
    """

    def __init__(self, connect: Callable[[], Client]) -> None:
        self._connect = connect
        self._changed = threading.Condition()
        self._next: Goal | None = None
        self._now: Goal | None = None
        self._operation = ""  # of the daemon, for what runs now
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="steering", daemon=True)
        self._thread.start()

    def begin(self, goal: Goal) -> None:
        """Take a goal; what runs is stopped for it, and what waited is replaced."""
        with self._changed:
            replaced, outcome = (goal, ENDED) if self._closed else (self._next, REPLACED)
            if not self._closed:
                self._next = goal
                self._changed.notify_all()
        if replaced is not None:
            self._end(replaced, outcome)
        self._stop_running()

    def withdraw(self, goal: Goal) -> None:
        """Stop a goal, or never begin it."""
        with self._changed:
            waits = self._next is goal
            if waits:
                self._next = None
            goal.withdrawn, runs = True, self._now is goal
        if waits:
            self._end(goal, GoalOutcome("stopped", message="it was canceled"))
        elif runs:
            self._stop_running()

    def stop(self) -> None:
        """Stop what runs; what waits is never begun."""
        for goal in (self._next, self._now):
            if goal is not None:
                self.withdraw(goal)

    def close(self) -> None:
        """Stop what was begun, and wait until the lease is given back."""
        with self._changed:
            self._closed = True
            waiting, self._next = self._next, None
            self._changed.notify_all()
        if waiting is not None:
            self._end(waiting, ENDED)
        self._stop_running()
        self._thread.join()

    def _stop_running(self) -> None:
        """Stop what ROS has begun, and nothing else: the head may be another client's by now."""
        operation = self._operation
        if operation:
            with contextlib.suppress(ClientError), self._connect() as client:
                client.stop_operation(operation)

    def _superseded(self, goal: Goal) -> bool:
        return self._closed or self._next is not None or goal.withdrawn

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._next is not None)
                if self._next is None:
                    return
                goal, self._next = self._next, None
                self._now = goal
            outcome = self._carried_out(goal)
            with self._changed:
                self._now, self._operation = None, ""
            self._end(goal, outcome)

    def _carried_out(self, goal: Goal) -> GoalOutcome:
        try:
            with self._connect() as client:
                request = goal.request(client)
                with client.lease(for_s=LEASE_S, ends_with_stop=True):
                    return self._pointed(client, goal, request)
        except ValueError as error:
            return GoalOutcome("refused", "bad_request", str(error))
        except ClientError as error:
            return GoalOutcome("refused", error.code, str(error))
        except Exception:  # the thread goes on: the next goal, and the stop at the end, need it
            log.exception("'%s' met a defect of the program", goal.name)
            return GoalOutcome("failed", "defect", "a defect of the program; the log has it")

    def _pointed(self, client: Client, goal: Goal, request: Mapping[str, Any]) -> GoalOutcome:
        if self._superseded(goal):
            return REPLACED
        operation = self._operation = client.point(**request)
        if self._superseded(goal):  # it came before this one could be stopped
            client.stop_operation(operation)
        try:
            record = client.wait(operation, WAIT_S)
        except ClientError as error:
            log.warning("lost sight of '%s' (%s); the head is stopped", goal.name, error)
            with contextlib.suppress(ClientError):
                client.stop_operation(operation)
            return GoalOutcome("failed", error.code, str(error))
        reason = record["error"] or {"code": "", "message": ""}
        return GoalOutcome(record["state"], reason["code"], reason["message"], record)

    def _end(self, goal: Goal, outcome: GoalOutcome) -> None:
        if outcome.state != "done":
            log.warning("%s: %s %s", goal.name, outcome.state, outcome.message)
        goal.outcome.set_result(outcome)


# Messages as arguments of Client.point; each raises ValueError with a sentence


def angles_of(trajectory: Any, names: RosNames, client: Client) -> dict[str, float]:
    """Return the joint angles of a trajectory's last point; a joint that it leaves out stays."""
    keys = {names.pan: "pan_rad", names.tilt: "tilt_rad"}
    given = list(trajectory.joint_names)
    if not given or len(set(given)) != len(given) or not set(given) <= set(keys):
        known = " and ".join(keys)
        raise ValueError(f"the trajectory names the joints {given} where {known} are expected, once each")
    if not trajectory.points:
        raise ValueError("the trajectory has no point")
    last = list(trajectory.points[-1].positions)
    if len(last) != len(given):
        raise ValueError(f"the last point has {len(last)} positions for {len(given)} joints")
    if not all(map(math.isfinite, last)):
        raise ValueError(f"the last point's positions are {last} where finite radians are expected")
    joints = client.status()["joints"]
    if joints is None and len(given) < 2:
        raise ValueError("the head was not read yet; a trajectory of both joints is expected")
    stays = {} if joints is None else {"pan_rad": joints["pan_rad"], "tilt_rad": joints["tilt_rad"]}
    return stays | {keys[name]: float(value) for name, value in zip(given, last, strict=True)}


def point_of(message: Any, names: RosNames, state: DaemonState) -> dict[str, Any]:
    """Return the point in the rover frame, metres, of a ``PointStamped`` of any frame that tf knows."""
    frame = message.header.frame_id.lstrip("/")
    point = [float(message.point.x), float(message.point.y), float(message.point.z)]
    if not all(map(math.isfinite, point)):
        raise ValueError(f"the point is {point} where finite meters are expected")
    if not frame:
        raise ValueError("the point's header has no frame_id")
    if frame != names.rover:
        at_ns = stamp_ns(message.header.stamp)
        try:
            point = state.tree.transform(names.rover, frame, at_ns, TF_WAIT_S).points(point).tolist()
        except NoTransform as error:
            raise ValueError(str(error)) from None
    return {"position_m": point, "frame": "rover"}


def pixel_of(message: Any, names: RosNames, state: DaemonState) -> dict[str, Any]:
    """Return the pixel of a named frame of a ``PointStamped``: x, y pixels, z the range, metres, or 0.

    Its frame is a camera's optical one, and its stamp that of the image.
    """
    at_ns = stamp_ns(message.header.stamp)
    x_px, y_px, range_m = float(message.point.x), float(message.point.y), float(message.point.z)
    if not (all(map(math.isfinite, (x_px, y_px, range_m))) and range_m >= 0.0):
        raise ValueError(
            f"the point is {[x_px, y_px, range_m]} where a pixel and a range (meters, or 0) are expected"
        )
    if state.rig is None:
        raise ValueError("the daemon's mast file cannot be read, so that its cameras are not known")
    frame = message.header.frame_id.lstrip("/")
    camera = names.camera_of(frame, state.rig)
    if camera is None:
        raise ValueError(f"the frame '{frame}' is no camera's; one ends with _optical_frame")
    frame_id = state.frame_at(camera, at_ns)
    if frame_id is None:
        raise ValueError(
            f"none of the last {FRAMES} images of {camera} has the stamp {at_ns / NS:.9f} s; "
            "the stamp of the image that shows the point is expected"
        )
    return {"pixel": (camera, frame_id, x_px, y_px)} | ({"range_m": range_m} if range_m else {})


def aim_of(
    frame: str, axis: tuple[float, float, float], names: RosNames, state: DaemonState
) -> dict[str, Any]:
    """Return the aim of a ``PointHead``: where a camera shows what lies along an axis of its frame.

    Without a frame the daemon chooses; without an axis it is the image's centre.
    """
    if not frame:
        return {}
    rig = state.rig
    on_head = [] if rig is None else [name for name, one in rig.cameras.items() if one.on == "head"]
    camera = next((name for name in on_head if names.optical(name) == frame.lstrip("/")), None)
    if rig is None or camera is None:
        known = [names.optical(name) for name in on_head]
        raise ValueError(f"pointing_frame is '{frame}' where one of {known} is expected")
    model = rig.cameras[camera].model
    if not any(axis):
        return {"aim": (camera, *model.image_center_px)}
    if not all(map(math.isfinite, axis)):
        raise ValueError(f"pointing_axis is {list(axis)} where finite numbers are expected")
    along = state.carrier_from_optical(rig, camera).rotation @ (np.array(axis) / np.linalg.norm(axis))
    pixel, valid = model.project(model.C + FAR_M * along)
    if not valid:
        raise ValueError(f"the camera does not see along pointing_axis {list(axis)}")
    return {"aim": (camera, *pixel.tolist())}
