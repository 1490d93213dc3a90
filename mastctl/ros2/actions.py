"""The actions ``FollowJointTrajectory`` and ``PointHead``, where control_msgs is installed."""

from __future__ import annotations

import logging
import math
import threading
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
from mastctl.ros2.asked import Asked
from mastctl.ros2.steering import GoalOutcome

log = logging.getLogger(__name__)

FEEDBACK_S = 0.1
UNSEEN_S = 10.0
"""ROS may tell of a client later than of its goal: so long is one waited for that was not seen yet."""
TRAJECTORY, POINT_HEAD = "follow_joint_trajectory", "point_head"


class Actions:
    """The action servers of one node; goals are wishes like the others."""

    def __init__(self, node: Node, asked: Asked) -> None:
        self._node, self._asked = node, asked
        self._servers: list[Any] = []
        try:
            known = import_module("control_msgs.action")
        except ImportError:
            log.warning("control_msgs is not installed: there are no actions, only topics and services")
            return
        self._trajectory, self._point_head = known.FollowJointTrajectory, known.PointHead
        group = ReentrantCallbackGroup()
        for kind, name, execute in (
            (self._trajectory, TRAJECTORY, self._follow),
            (self._point_head, POINT_HEAD, self._point),
        ):
            self._servers.append(
                ActionServer(
                    node, kind, name, execute, callback_group=group,
                    cancel_callback=lambda goal: CancelResponse.ACCEPT,
                )
            )  # fmt: skip

    def _follow(self, goal: Any) -> Any:
        """Go to the last point of the goal's trajectory; the goal is over when the head rests there."""
        asked = goal.request
        result = self._trajectory.Result()
        wanted: dict[str, float] = {}

        def request(client: Client) -> dict[str, Any]:
            if asked.multi_dof_trajectory.points or not asked.trajectory.points:
                raise ValueError("the goal has no trajectory of the joints pan and tilt")
            wanted.update(self._asked.angles_of(asked.trajectory, client))
            return wanted | _deadline(asked)

        outcome = self._carried_out(TRAJECTORY, goal, request, lambda: self._progress(wanted))
        result.error_string = outcome.message
        if outcome.state == "done":
            off = self._beyond(asked.goal_tolerance, wanted)
            if off:
                result.error_code, result.error_string = result.GOAL_TOLERANCE_VIOLATED, off
                goal.abort()
                return result
            result.error_code = result.SUCCESSFUL
            goal.succeed()
            return result
        result.error_code = result.INVALID_GOAL
        self._give_up(goal, outcome)
        return result

    def _point(self, goal: Any) -> Any:
        """Point a camera at the goal's point; the goal is over when the residual was measured."""
        asked = goal.request

        def request(client: Client) -> dict[str, Any]:
            limit = client.status()["limits"]["speed_rad_per_s"]
            if 0.0 < asked.max_velocity < limit:
                raise ValueError(
                    f"max_velocity is {asked.max_velocity:g} rad/s where the daemon's own speed, {limit:g}, "
                    "or 0 is expected; limits.speed_rad_per_s of its configuration sets it"
                )
            axis = asked.pointing_axis
            aim = self._asked.aim_of(asked.pointing_frame, (axis.x, axis.y, axis.z))
            return self._asked.point_of(asked.target) | aim

        outcome = self._carried_out(POINT_HEAD, goal, request, lambda: None)
        if outcome.state == "done":
            goal.succeed()
        else:
            self._give_up(goal, outcome)
        return self._point_head.Result()

    def _carried_out(
        self,
        what: str,
        goal: Any,
        request: Callable[[Client], Mapping[str, Any]],
        progress: Callable[[], Any],
    ) -> GoalOutcome:
        """Have a goal's wish done, with feedback; it is withdrawn when canceled, or nobody waits for it."""
        over, ends = threading.Event(), list[GoalOutcome]()

        def end(outcome: GoalOutcome) -> None:
            ends.append(outcome)
            over.set()

        wish = self._asked.ask(what, request, end)
        withdrawn, missed, most = False, 0, round(UNSEEN_S / FEEDBACK_S)
        while not over.wait(FEEDBACK_S):
            if self._waited_for(what):
                missed, most = 0, 1
            else:
                missed += 1
            if not withdrawn and (goal.is_cancel_requested or missed > most):
                withdrawn = True
                self._asked.steering.withdraw(wish)
            told = progress()
            if told is not None:
                goal.publish_feedback(told)
        return ends[0]

    def _waited_for(self, what: str) -> bool:
        """Whether a client of an action is there still."""
        service = self._node.resolve_service_name(f"{what}/_action/get_result")
        return bool(self._node.count_clients(service))

    def _give_up(self, goal: Any, outcome: GoalOutcome) -> None:
        if goal.is_cancel_requested and outcome.state in ("stopped", "replaced"):
            goal.canceled()
        else:
            goal.abort()

    def _progress(self, wanted: Mapping[str, float]) -> Any:
        """Where the joints are, and where they are wanted."""
        joints, names = self._asked.known.joints, self._asked.names
        if joints is None or not wanted:
            return None
        at_ns = self._asked.known.clock.stamp_ns(joints["measured_s"])
        goal, actual = ([told["pan_rad"], told["tilt_rad"]] for told in (wanted, joints))
        off = [one - other for one, other in zip(goal, actual, strict=True)]
        return self._trajectory.Feedback(
            header=Header(stamp=messages.stamp(at_ns or 0)),
            joint_names=[names.pan, names.tilt],
            desired=JointTrajectoryPoint(positions=goal),
            actual=JointTrajectoryPoint(positions=actual),
            error=JointTrajectoryPoint(positions=off),
        )

    def _beyond(self, tolerances: Any, wanted: Mapping[str, float]) -> str:
        """Which joint is farther from its goal than the goal's tolerance, in a sentence."""
        joints, names = self._asked.known.joints, self._asked.names
        keys = {names.pan: "pan_rad", names.tilt: "tilt_rad"}
        for one in tolerances:
            key = keys.get(one.name)
            if joints is None or key is None or not one.position > 0.0:
                continue
            off_rad = abs(float(joints[key]) - wanted[key])
            if off_rad > one.position:
                return f"{one.name} is {off_rad:.6f} rad from its goal where {one.position:g} is allowed"
        return ""


def _deadline(asked: Any) -> dict[str, float]:
    """How long a goal may take, where it has a tolerance of time: until its last point and that."""
    late_s = _seconds(asked.goal_time_tolerance)
    whole_s = _seconds(asked.trajectory.points[-1].time_from_start) + late_s
    return {"deadline_s": whole_s} if late_s > 0.0 and math.isfinite(whole_s) else {}


def _seconds(told: Any) -> float:
    return float(told.sec) + 1e-9 * float(told.nanosec)
