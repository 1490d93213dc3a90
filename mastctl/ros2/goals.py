"""What ROS wants of the head: goals, carried out one at a time under a lease of their own, and the actions.

A goal is an operation of the daemon: joint angles, a point of the rover frame, or a pixel. A new goal takes
the place of the one before, which is stopped first. The lease runs from a goal's beginning to its end and is
renewed meanwhile, so that others can steer in between; when it is not renewed, the daemon stops what runs.
"""

from __future__ import annotations

import contextlib
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from mastctl.client import Client, ClientError
from mastctl.client.connection import polled
from mastctl.ros2.state import DaemonState, RosNames

log = logging.getLogger(__name__)

LEASE_S = 2.0
WAIT_S = 600.0  # longest time of one goal; the daemon's own deadline is sooner
UNSEEN_S, GONE_S = 10.0, 0.1
"""How long an action's client is awaited that ROS may report later than its goal, and one that was there."""
ENDED = ("done", "failed", "stopped")
TRAJECTORY, POINT_HEAD = "follow_joint_trajectory", "point_head"


@dataclass(frozen=True)
class GoalOutcome:
    """How a goal ended: ``state`` is ``done``, ``failed``, ``stopped``, ``refused`` or ``replaced``.

    ``operation`` is the daemon's record, where there is one.
    """

    state: str
    code: str = ""
    message: str = ""
    operation: Mapping[str, Any] | None = None


@dataclass(eq=False)
class Goal:
    """One goal of ROS; ``name`` is for logs.

    ``request`` returns the arguments of `Client.point`; it may wait, and raises ValueError with a sentence.
    ``meanwhile`` is called while the goal runs, some twenty times a second; False ends it.
    """

    name: str
    request: Callable[[Client], Mapping[str, Any]]
    meanwhile: Callable[[], bool] = lambda: True


class RosSteering:
    """Carries out goals, each in its caller's thread; `close` ends them.

    ``connect`` makes a client of the daemon.
    """

    def __init__(self, connect: Callable[[], Client]) -> None:
        self._connect = connect
        self._changed = threading.Condition()
        self._wanted: Goal | None = None  # the newest one; any other that waits or runs ends
        self._runs = False
        self._closed = False

    def carry_out(self, goal: Goal) -> GoalOutcome:
        """Stop the goal that runs, carry this one out, and return how it ended."""
        with self._changed:
            self._wanted = None if self._closed else goal
            self._changed.notify_all()
            self._changed.wait_for(lambda: self._superseded(goal) or not self._runs)
            runs = self._runs = not self._superseded(goal)
        outcome = self._replaced()
        if runs:
            try:
                outcome = self._leased(goal)
            finally:
                with self._changed:
                    self._runs = False
                    self._changed.notify_all()
        if outcome.state != "done":
            log.warning("%s: %s %s", goal.name, outcome.state, outcome.message)
        return outcome

    def stop(self) -> None:
        """Stop what runs; what waits is never begun."""
        with self._changed:
            self._wanted = None
            self._changed.notify_all()

    def close(self) -> None:
        """Stop what was begun, and wait until the lease is given back."""
        with self._changed:
            self._closed = True
            self.stop()
            self._changed.wait_for(lambda: not self._runs)

    def _superseded(self, goal: Goal) -> bool:
        return self._wanted is not goal

    def _replaced(self) -> GoalOutcome:
        if self._wanted is None:
            return GoalOutcome("stopped", message="it was canceled, or the adapter ends")
        return GoalOutcome("replaced", message="a newer goal came")

    def _leased(self, goal: Goal) -> GoalOutcome:
        try:
            with self._connect() as client:
                request = goal.request(client)
                with client.lease(for_s=LEASE_S, ends_with_stop=True):
                    return self._pointed(client, goal, request)
        except ValueError as error:
            return GoalOutcome("refused", "bad_request", str(error))
        except ClientError as error:
            return GoalOutcome("refused", error.code, str(error))
        except Exception:  # the next goal, and the stop at the end, come all the same
            log.exception("'%s' met a defect of the program", goal.name)
            return GoalOutcome("failed", "defect", "a defect of the program; the log has it")

    def _pointed(self, client: Client, goal: Goal, request: Mapping[str, Any]) -> GoalOutcome:
        if self._superseded(goal):
            return self._replaced()
        operation, stopped = client.point(**request), False
        try:
            for record in polled(lambda within_s: client.operation(operation), WAIT_S):
                if record["state"] in ENDED:
                    reason = record["error"] or {"code": "", "message": ""}
                    return GoalOutcome(record["state"], reason["code"], reason["message"], record)
                if not stopped and (self._superseded(goal) or not goal.meanwhile()):
                    client.stop_operation(operation)
                    stopped = True
            raise ClientError("timeout", f"operation {operation} has not ended after {WAIT_S:g} s")
        except ClientError as error:
            log.warning("lost sight of '%s' (%s); the head is stopped", goal.name, error)
            with contextlib.suppress(ClientError):
                client.stop_operation(operation)
            return GoalOutcome("failed", error.code, str(error))


class Actions:
    """The actions ``FollowJointTrajectory`` and ``PointHead`` of a node, where control_msgs is installed.

    Their goals are goals like those of topics, which ``carry_out`` gets.
    """

    def __init__(
        self,
        node: Any,
        names: RosNames,
        state: DaemonState,
        carry_out: Callable[[Goal], GoalOutcome],
    ) -> None:
        self._node, self._names, self._state, self._carry_out = node, names, state, carry_out
        from rclpy.action import ActionServer, CancelResponse
        from rclpy.callback_groups import ReentrantCallbackGroup

        from mastctl.ros2 import messages

        self._messages = messages
        try:
            kinds = import_module("control_msgs.action")
        except ImportError:
            log.warning("control_msgs is not installed: there are no actions, only topics and services")
            return
        self._trajectory, self._point_head = kinds.FollowJointTrajectory, kinds.PointHead
        group = ReentrantCallbackGroup()
        self._servers = [
            ActionServer(
                node, kind, name, execute, callback_group=group,
                cancel_callback=lambda goal: CancelResponse.ACCEPT,
            )
            for kind, name, execute in (
                (self._trajectory, TRAJECTORY, self._follow),
                (self._point_head, POINT_HEAD, self._point),
            )
        ]  # fmt: skip

    def _follow(self, goal: Any) -> Any:
        """Go to the last point of the goal's trajectory; the goal is over when the head rests there."""
        fields, result = goal.request, self._trajectory.Result()
        wanted: dict[str, float] = {}

        def request(client: Client) -> dict[str, Any]:
            if fields.multi_dof_trajectory.points or not fields.trajectory.points:
                raise ValueError("the goal has no trajectory of the joints pan and tilt")
            wanted.update(self._messages.angles_of(fields.trajectory, self._names, client))
            return wanted | _deadline(fields)

        outcome = self._carried_out(TRAJECTORY, goal, request, lambda: self._feedback(goal, wanted))
        result.error_string = outcome.message
        off = self._beyond(fields.goal_tolerance, wanted) if outcome.state == "done" else ""
        if off:
            result.error_code, result.error_string = result.GOAL_TOLERANCE_VIOLATED, off
            goal.abort()
        else:
            result.error_code = result.SUCCESSFUL if outcome.state == "done" else result.INVALID_GOAL
            _end(goal, outcome)
        return result

    def _point(self, goal: Any) -> Any:
        """Point a camera at the goal's point; the goal is over when the residual was measured."""
        fields = goal.request

        def request(client: Client) -> dict[str, Any]:
            limit = client.status()["limits"]["speed_rad_per_s"]
            if 0.0 < fields.max_velocity < limit:
                raise ValueError(
                    f"max_velocity is {fields.max_velocity:g} rad/s where the daemon's own speed, {limit:g}, "
                    "or 0 is expected; limits.speed_rad_per_s of its configuration sets it"
                )
            axis = fields.pointing_axis
            aim = self._messages.aim_of(
                fields.pointing_frame, (axis.x, axis.y, axis.z), self._names, self._state
            )
            point: dict[str, Any] = self._messages.point_of(fields.target, self._names, self._state)
            return {**point, **aim}

        _end(goal, self._carried_out(POINT_HEAD, goal, request, lambda: None))
        return self._point_head.Result()

    def _carried_out(
        self,
        name: str,
        goal: Any,
        request: Callable[[Client], Mapping[str, Any]],
        feedback: Callable[[], object],
    ) -> GoalOutcome:
        """Carry a goal out with feedback; it ends when it is canceled, or when its client is gone."""
        service = self._node.resolve_service_name(f"{name}/_action/get_result")
        until_s = time.monotonic() + UNSEEN_S

        def meanwhile() -> bool:
            nonlocal until_s
            now_s = time.monotonic()
            if self._node.count_clients(service):
                until_s = now_s + GONE_S
            feedback()
            return not goal.is_cancel_requested and now_s <= until_s

        return self._carry_out(Goal(name, request, meanwhile))

    def _feedback(self, goal: Any, wanted: Mapping[str, float]) -> None:
        """Publish where the joints are, and where they are wanted."""
        joints = self._state.joints
        if joints is not None:
            at_ns = self._state.clock.stamp_ns(joints["measured_s"]) or 0
            goal.publish_feedback(
                self._messages.feedback(self._trajectory.Feedback, self._names, at_ns, wanted, joints)
            )

    def _beyond(self, tolerances: Any, wanted: Mapping[str, float]) -> str:
        """Which joint is farther from its goal than the goal's tolerance, in a sentence."""
        joints = self._state.joints
        for one in tolerances:
            key = self._names.joints.get(one.name)
            if joints is None or key is None or not one.position > 0.0:
                continue
            off_rad = abs(float(joints[key]) - wanted[key])
            if off_rad > one.position:
                return f"{one.name} is {off_rad:.6f} rad from its goal where {one.position:g} is allowed"
        return ""


def _end(goal: Any, outcome: GoalOutcome) -> None:
    if outcome.state == "done":
        goal.succeed()
    elif goal.is_cancel_requested and outcome.state in ("stopped", "replaced"):
        goal.canceled()
    else:
        goal.abort()


def _deadline(fields: Any) -> dict[str, float]:
    """How long a goal may take, where it has a tolerance of time: until its last point and that."""
    late_s = _seconds(fields.goal_time_tolerance)
    whole_s = _seconds(fields.trajectory.points[-1].time_from_start) + late_s
    return {"deadline_s": whole_s} if late_s > 0.0 and math.isfinite(whole_s) else {}


def _seconds(duration: Any) -> float:
    return float(duration.sec) + 1e-9 * float(duration.nanosec)
