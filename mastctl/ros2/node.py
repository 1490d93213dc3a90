"""The node: what it publishes of the daemon, and what it takes for it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib import import_module
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, TransformStamped, Vector3Stamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, JointState
from std_msgs.msg import Float64, Header
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from calib.errors import BadFile
from calib.files import digest_of
from calib.files.mast_file import parse_rig
from mastctl.client import Client, ClientError
from mastctl.client.pictures import LivePicture
from mastctl.ros2 import messages
from mastctl.ros2.actions import Actions
from mastctl.ros2.asked import Asked
from mastctl.ros2.follow import Following
from mastctl.ros2.known import KnownState
from mastctl.ros2.names import RosNames
from mastctl.ros2.steering import GoalOutcome, RosSteering
from mastctl.ros2.times import NS, ClockExchange

log = logging.getLogger(__name__)

LATCHED = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
RELIABLE = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
TF = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
REASON = "reset_reason"
NAME = "ROS 2"
ENDED = ("done", "failed", "stopped")


class MastNode(Node):  # type: ignore[misc]  # rclpy has types for whoever has it
    """A node of one daemon.

    Parameters
    ----------
    connect
        Makes a client of the daemon.
    names
        Of joints and frames.
    """

    def __init__(self, connect: Callable[[], Client], names: RosNames) -> None:
        super().__init__("mastctl")
        self.names = names
        self.known = KnownState()
        self._connect = connect
        self._cameras: tuple[str, ...] = ()
        self._own: set[str] = set()
        self._infos: dict[str, CameraInfo] = {}
        self._mast_digest = ""  # of the file that was read last, also of one that cannot be used
        self._images: dict[str, tuple[Any, Any]] = {}
        self._latched: dict[str, Any] = {}
        self._make_publishers()
        self.steering = RosSteering(connect)
        self.following = Following(connect)
        self.asked = Asked(names, self.known, self.steering, self._tell_refusal)
        self._take()
        self._actions = Actions(self, self.asked)

    def begin(self) -> None:
        """Follow the daemon from now on. Raises ClientError if it does not answer, or is refused."""
        with self._connect() as client:
            status = client.status()
            self._cameras = tuple(status["cameras"])
            self.known.expect_ends(one["id"] for one in client.operations() if one["state"] in ENDED)
        self.known.expect_images(self._cameras)
        for name in self._cameras:
            topic = self.names.topic(name)
            self._images[name] = (
                self.create_publisher(
                    CompressedImage, f"{topic}/image_raw/compressed", qos_profile_sensor_data
                ),
                self.create_publisher(CameraInfo, f"{topic}/camera_info", qos_profile_sensor_data),
            )
        self._read_rig()  # before the first image: its frame is then a camera's for whoever points at it
        self.following.status(self._tell_status, self._tell_loss)
        self.following.events(self._tell_event)
        if self._cameras:
            self.following.pictures(self._cameras, self._wanted, self._tell_picture)

    def close(self) -> None:
        """Stop what ROS began, and publish no more."""
        self.steering.close()
        self.following.close()

    def now_ns(self) -> int:
        """Return ROS time, nanoseconds."""
        return int(self.get_clock().now().nanoseconds)

    # Publishing

    def _make_publishers(self) -> None:
        self._joint_states = self.create_publisher(JointState, "joint_states", RELIABLE)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", RELIABLE)
        self._pointings = self.create_publisher(DiagnosticArray, "pointings", RELIABLE)
        self._residual = self.create_publisher(Vector3Stamped, "residual", RELIABLE)
        self._sigma = self.create_publisher(Vector3Stamped, "residual_sigma", RELIABLE)
        self._offset = self.create_publisher(Float64, "clock_offset", LATCHED)
        self._tf: Any = None
        try:
            self._tf_message = import_module("tf2_msgs.msg").TFMessage
        except ImportError:
            log.warning("tf2_msgs is not installed: no /tf is published, and tf of others is not heard")
            return
        self._tf = self.create_publisher(self._tf_message, "/tf", TF)
        self._tf_static = self.create_publisher(self._tf_message, "/tf_static", LATCHED)
        group = ReentrantCallbackGroup()
        self.create_subscription(
            self._tf_message, "/tf", lambda told: self._heard(told, False), TF, callback_group=group
        )
        static = QoSProfile(
            depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
        )
        self.create_subscription(
            self._tf_message, "/tf_static", lambda told: self._heard(told, True), static, callback_group=group
        )

    def _publish_transforms(self, told: list[TransformStamped], static: bool) -> None:
        for one in told:
            self._own.add(one.child_frame_id)
            self._put(one, static)
        if self._tf is not None:
            (self._tf_static if static else self._tf).publish(self._tf_message(transforms=told))

    def _heard(self, told: Any, static: bool) -> None:
        for one in told.transforms:
            if one.child_frame_id not in self._own:
                self._put(one, static)

    def _put(self, told: TransformStamped, static: bool) -> None:
        parent, child = told.header.frame_id.lstrip("/"), told.child_frame_id.lstrip("/")
        try:
            self.known.tree.put(
                parent, child, messages.stamp_ns(told.header.stamp), messages.rigid(told), static
            )
        except ValueError as error:
            log.warning("a transform of tf is left out: %s", error)

    def _tell_status(self, told: dict[str, Any], exchange: ClockExchange) -> None:
        if self.known.clock.heard(exchange):
            used = self.known.clock.exchange
            assert used is not None
            self._offset.publish(Float64(data=used.offset_ns / NS))
        lines = messages.health(told, self.known.clock)
        self._diagnostics.publish(messages.diagnostics(self.now_ns(), lines))

    def _tell_loss(self, why: str) -> None:
        line = messages.status("mastctl: state", messages.ERROR, why, {})
        self._diagnostics.publish(messages.diagnostics(self.now_ns(), [line]))

    def _tell_event(self, topic: str, key: str, value: Any) -> None:
        if topic == "mast" and value["digest"] != self._mast_digest:
            self._read_rig()
        if topic == "joints":
            self._tell_joints(value)
        elif topic == "operation" and value["state"] in ENDED and self.known.is_new_end(key):
            self._tell_operation(value)

    def _tell_joints(self, told: dict[str, Any]) -> None:
        at_ns = self.known.clock.stamp_ns(told["measured_s"])
        self.known.joints = told
        if at_ns is None or self.known.rig is None:
            return
        state = messages.joint_state(self.names, at_ns, told["pan_rad"], told["tilt_rad"])
        self._joint_states.publish(state)
        true_rad = told["true_pan_rad"], told["true_tilt_rad"]
        self._publish_transforms(
            messages.moving_transforms(self.names, self.known.rig, at_ns, *true_rad), False
        )

    def _tell_operation(self, told: dict[str, Any]) -> None:
        error = told["error"]
        message = "" if error is None else error["message"]
        at_ns = self.known.clock.stamp_ns(told["ended_s"]) or self.now_ns()
        self._pointings.publish(messages.pointing(at_ns, told["id"], told["state"], message, told))
        if told["residual_px"] is None:
            return
        camera = next((one["camera"] for one in reversed(told["pointings"])), "")
        header = Header(stamp=messages.stamp(at_ns), frame_id=self.names.optical(camera))
        self._sigma.publish(messages.residual(header, told["residual_sigma_px"] or (None, None)))
        self._residual.publish(messages.residual(header, told["residual_px"]))

    def _tell_refusal(self, what: str, outcome: GoalOutcome) -> None:
        """Publish a wish of ROS that never became an operation."""
        told = messages.pointing(self.now_ns(), what, outcome.state, outcome.message, None)
        self._pointings.publish(told)

    def _wanted(self, camera: str) -> bool:
        image, info = self._images[camera]
        return bool(image.get_subscription_count() or info.get_subscription_count())

    def _tell_picture(self, picture: LivePicture) -> None:
        facts = picture.facts
        at_ns = self.known.clock.stamp_ns(facts["mid_exposure_s"])
        if at_ns is None:
            return
        camera = facts["camera"]
        self.known.put_image(camera, at_ns, facts["frame_id"])
        image, info = self._images[camera]
        header = Header(stamp=messages.stamp(at_ns), frame_id=self.names.optical(camera))
        image.publish(messages.image(header, picture.jpeg))
        told = self._infos.get(camera)
        if told is not None:
            told.header = header
            info.publish(told)

    def _read_rig(self) -> None:
        """Take the mast file in use: fixed transforms, and each camera's lens with its worst error."""
        with self._connect() as client:
            data = client.mast_file()
        digest = digest_of(data)
        if digest == self._mast_digest:
            return
        self._mast_digest = digest
        try:
            rig = parse_rig(data, "the daemon's mast file").rig
        except BadFile as error:
            log.warning("no transforms and no camera_info: %s", error)
            return
        self.known.use_rig(rig)
        self._infos = {}
        for name in self._cameras:
            if name not in self.known.lenses:
                continue
            lens, twin, off = self.known.lenses[name]
            log.info("%s: %s, at most %.4f px off", name, lens, off.worst_px)
            if name not in self._latched:
                topic = f"{self.names.topic(name)}/camera_info_error_px"
                self._latched[name] = self.create_publisher(Float64, topic, LATCHED)
            self._latched[name].publish(Float64(data=off.worst_px))
            self._infos[name] = messages.camera_info(lens, twin)
        self._publish_transforms(messages.fixed_transforms(self.names, self.known, rig, self.now_ns()), True)

    # What ROS asks

    def _take(self) -> None:
        group = ReentrantCallbackGroup()
        self.declare_parameter(REASON, "")
        self.create_subscription(
            JointTrajectory, "joint_trajectory", self.asked.trajectory, RELIABLE, callback_group=group
        )
        self.create_subscription(
            PointStamped, "point_at", self.asked.point_at, RELIABLE, callback_group=group
        )
        self.create_subscription(
            PointStamped, "point_at_pixel", self.asked.point_at_pixel, RELIABLE, callback_group=group
        )
        services = (("stop", self._stop), ("estop", self._estop), ("reset", self._reset))
        for name, answer in services:
            self.create_service(Trigger, f"~/{name}", answer, callback_group=group)

    def _stop(self, request: Any, answer: Any) -> Any:
        try:
            return self._answered(answer, lambda client: "stopped" if client.stop() else "")
        finally:
            self.steering.stop()  # what waits for its turn or for tf must not begin after the stop

    def _estop(self, request: Any, answer: Any) -> Any:
        def estop(client: Client) -> str:
            told = client.estop(reason="asked by ROS 2", name=NAME)
            return str(told.get("message") or "stopped and latched; ~/reset releases it")

        return self._answered(answer, estop)

    def _reset(self, request: Any, answer: Any) -> Any:
        reason = str(self.get_parameter(REASON).value).strip()
        if not reason:
            answer.success = False
            answer.message = f"a reset needs a reason: set the parameter {REASON} of this node first"
            return answer

        def reset(client: Client) -> str:
            client.reset(reason=reason, name=NAME)
            self.set_parameters([rclpy.parameter.Parameter(REASON, value="")])
            return "released"

        return self._answered(answer, reset)

    def _answered(self, answer: Any, ask: Callable[[Client], str]) -> Any:
        try:
            with self._connect() as client:
                answer.message, answer.success = ask(client), True
        except ClientError as error:
            answer.message, answer.success = str(error), False
        return answer
