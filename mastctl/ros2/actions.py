"""The actions ``FollowJointTrajectory`` and ``PointHead``, where control_msgs is installed."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectoryPoint

from mastctl.client import Client
from mastctl.ros2 import messages
from mastctl.ros2.goals import Goal, GoalOutcome, RosSteering, aim_of, angles_of, point_of
from mastctl.ros2.state import DaemonState, RosNames

log = logging.getLogger(__name__)

FEEDBACK_S = 0.1
UNSEEN_S = 10.0
"""ROS may report a client later than its goal: so long is a client awaited that was not seen yet."""
TRAJECTORY, POINT_HEAD = "follow_joint_trajectory", "point_head"


class Actions:
    """The action servers of one node; their goals are goals like those of topics."""

    def __init__(
        self,
        node: Node,
        names: RosNames,
        state: DaemonState,
        steering: RosSteering,
        begin: Callable[[str, Callable[[Client], Mapping[str, Any]]], Goal],
    ) -> None:
        self._node, self._names, self._state = node, names, state
        self._steering, self._begin = steering, begin
        try:
            known = import_module("control_msgs.action")
        except ImportError:
            log.warning("control_msgs is not installed: there are no actions, only topics and services")
            return
        self._trajectory, self._point_head = known.FollowJointTrajectory, known.PointHead
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
        fields = goal.request
        result = self._trajectory.Result()
        wanted: dict[str, float] = {}

        def request(client: Client) -> dict[str, Any]:
            if fields.multi_dof_trajectory.points or not fields.trajectory.points:
                raise ValueError("the goal has no trajectory of the joints pan and tilt")
            wanted.update(angles_of(fields.trajectory, self._names, client))
            return wanted | _deadline(fields)

        outcome = self._carried_out(TRAJECTORY, goal, request, lambda: self._feedback(goal, wanted))
        result.error_string = outcome.message
        if outcome.state == "done":
            off = self._beyond(fields.goal_tolerance, wanted)
            if off:
                result.error_code, result.error_string = result.GOAL_TOLERANCE_VIOLATED, off
                goal.abort()
                return result
            result.error_code = result.SUCCESSFUL
            goal.succeed()
            return result
        result.error_code = result.INVALID_GOAL
        _give_up(goal, outcome)
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
            aim = aim_of(fields.pointing_frame, (axis.x, axis.y, axis.z), self._names, self._state)
            return point_of(fields.target, self._names, self._state) | aim

        outcome = self._carried_out(POINT_HEAD, goal, request, lambda: None)
        if outcome.state == "done":
            goal.succeed()
        else:
            _give_up(goal, outcome)
        return self._point_head.Result()

    def _carried_out(
        self,
        name: str,
        goal: Any,
        request: Callable[[Client], Mapping[str, Any]],
        feedback: Callable[[], object],
    ) -> GoalOutcome:
        """Carry a goal out with feedback; it is withdrawn when canceled, or when its client is gone."""
        begun = self._begin(name, request)
        service = self._node.resolve_service_name(f"{name}/_action/get_result")
        missed, most = 0, round(UNSEEN_S / FEEDBACK_S)
        while True:
            try:
                return begun.outcome.result(FEEDBACK_S)
            except TimeoutError:
                pass
            missed, most = (0, 1) if self._node.count_clients(service) else (missed + 1, most)
            if not begun.withdrawn and (goal.is_cancel_requested or missed > most):
                self._steering.withdraw(begun)
            feedback()

    def _feedback(self, goal: Any, wanted: Mapping[str, float]) -> None:
        """Publish where the joints are, and where they are wanted."""
        joints, names = self._state.joints, self._names
        if joints is None or not wanted:
            return
        at_ns = self._state.clock.stamp_ns(joints["measured_s"])
        desired, actual = ([one["pan_rad"], one["tilt_rad"]] for one in (wanted, joints))
        off = [one - other for one, other in zip(desired, actual, strict=True)]
        goal.publish_feedback(
            self._trajectory.Feedback(
                header=Header(stamp=messages.stamp(at_ns or 0)),
                joint_names=[names.pan, names.tilt],
                desired=JointTrajectoryPoint(positions=desired),
                actual=JointTrajectoryPoint(positions=actual),
                error=JointTrajectoryPoint(positions=off),
            )
        )

    def _beyond(self, tolerances: Any, wanted: Mapping[str, float]) -> str:
        """Which joint is farther from its goal than the goal's tolerance, in a sentence."""
        joints, names = self._state.joints, self._names
        keys = {names.pan: "pan_rad", names.tilt: "tilt_rad"}
        for one in tolerances:
            key = keys.get(one.name)
            if joints is None or key is None or not one.position > 0.0:
                continue
            off_rad = abs(float(joints[key]) - wanted[key])
            if off_rad > one.position:
                return f"{one.name} is {off_rad:.6f} rad from its goal where {one.position:g} is allowed"
        return ""


def _give_up(goal: Any, outcome: GoalOutcome) -> None:
    if goal.is_cancel_requested and outcome.state in ("stopped", "replaced"):
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
