"""The node: what it publishes of the daemon, and what it takes for it; `run` joins it with ROS."""

from __future__ import annotations

import logging
import threading
import time
from array import array
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, TransformStamped, Vector3Stamped
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from sensor_msgs.msg import CameraInfo, CompressedImage, JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from calib.errors import BadFile
from calib.files import digest_of
from calib.files.mast_file import parse_rig
from mastctl.client import Client, ClientError
from mastctl.client.calls import LivePicture
from mastctl.ros2 import NoRos, messages
from mastctl.ros2.goals import ENDED, Actions, Goal, GoalOutcome, RosSteering
from mastctl.ros2.state import NS, ClockExchange, DaemonState, RosNames, real_from_monotonic_ns

log = logging.getLogger(__name__)

LATCHED, MANY_LATCHED = (
    QoSProfile(
        depth=depth, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
    )
    for depth in (1, 100)
)
RELIABLE, TF = (QoSProfile(depth=depth, reliability=ReliabilityPolicy.RELIABLE) for depth in (10, 100))
REASON = "reset_reason"
NAME = "ROS 2"
THREADS = 6  # of ROS's callbacks: the goal that runs, those that it gives way to, the services beside them
ENDS = 1000  # operations whose end is remembered; the daemon itself keeps some 200
AGAIN_S, STATUS_S = 1.0, 1.0  # between attempts to reach the daemon, and between queries of its status
PICTURE_S, SPIN_S = 0.1, 0.1  # how long a picture, and ROS, are waited for until the end is noticed


def run(
    connect: Callable[[], Client],
    names: RosNames,
    ros_args: Sequence[str],
    ready: Callable[[str], object],
) -> None:
    """Run the node until an exception, a signal's KeyboardInterrupt as a rule; stops what ROS began.

    ``connect`` makes a client of the daemon; ``ros_args`` follow ``--ros-args``; ``ready`` gets the node's
    name when it is there. Raises NoRos if ROS refuses its arguments, or ends; ClientError if the daemon does
    not answer at the beginning.
    """
    try:
        rclpy.init(args=["mastctl", "--ros-args", *ros_args], signal_handler_options=SignalHandlerOptions.NO)
        node = MastNode(connect, names)
    except Exception as error:  # of many kinds: arguments, a middleware that is not there
        raise NoRos(f"ROS cannot begin: {error}") from None
    executor = MultiThreadedExecutor(THREADS)
    executor.add_node(node)
    try:
        node.begin()
        ready(node.get_fully_qualified_name())
        while rclpy.ok():
            executor.spin_once(SPIN_S)
        raise NoRos("ROS has ended")
    except ExternalShutdownException:
        raise NoRos("ROS has ended") from None
    finally:
        node.close()
        executor.shutdown(timeout_sec=1.0)
        rclpy.try_shutdown()


class MastNode(Node):  # type: ignore[misc]  # rclpy has types for whoever has it
    """A node of one daemon; ``connect`` makes a client of it. Its threads each have a client of their own."""

    def __init__(self, connect: Callable[[], Client], names: RosNames) -> None:
        super().__init__("mastctl")
        self.names = names
        self.state = DaemonState()
        self._connect = connect
        self._cameras: tuple[str, ...] = ()
        self._own: set[str] = set()
        self._infos: dict[str, CameraInfo] = {}
        self._mast_digest = ""  # of the file that was read last, also of one that cannot be used
        self._images: dict[str, tuple[Any, Any]] = {}
        self._latched: dict[str, Any] = {}
        self._ends: deque[str] = deque(maxlen=ENDS)
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []
        self._make_publishers()
        self.steering = RosSteering(connect)
        self._subscribe()
        self._actions = Actions(self, names, self.state, self._carry_out)

    def begin(self) -> None:
        """Follow the daemon from now on. Raises ClientError if it does not answer, or is refused."""
        with self._connect() as client:
            self._cameras = tuple(client.status()["cameras"])
            self._ends.extend(one["id"] for one in client.operations() if one["state"] in ENDED)
        for name in self._cameras:
            topic = self.names.topic(name)
            self._images[name] = (
                self.create_publisher(
                    CompressedImage, f"{topic}/image_raw/compressed", qos_profile_sensor_data
                ),
                self.create_publisher(CameraInfo, f"{topic}/camera_info", qos_profile_sensor_data),
            )
        self._read_rig()  # before the first image: its frame is then a camera's for whoever points at it
        for work in (self._follow_status, self._follow_events, self._follow_pictures):
            thread = threading.Thread(target=self._again, args=(work,), name=work.__name__, daemon=True)
            self._threads.append(thread)
            thread.start()

    def close(self) -> None:
        """Stop what ROS began, and publish no more; a thread that waits for the daemon is left to itself."""
        self.steering.close()
        self._over.set()
        for thread in self._threads:
            thread.join(2.0 * PICTURE_S)

    def now_ns(self) -> int:
        """Return ROS time, nanoseconds."""
        return int(self.get_clock().now().nanoseconds)

    # Following the daemon

    def _again(self, work: Callable[[Client], None]) -> None:
        """Follow the daemon in one way, and again when it was lost and is back."""
        reason = ""
        while not self._over.is_set():
            try:
                with self._connect() as client:
                    work(client)
            except ClientError as error:
                if str(error) != reason and not self._over.is_set():
                    log.warning("%s", error)
                reason = str(error)
                if work == self._follow_status:
                    line = messages.status("mastctl: state", messages.ERROR, reason, {})
                    self._diagnostics.publish(messages.diagnostics(self.now_ns(), [line]))
            except Exception:  # a defect must not end the thread
                if not self._over.is_set():
                    log.exception("a defect of the program")
            self._over.wait(AGAIN_S)

    def _follow_status(self, client: Client) -> None:
        while not self._over.is_set():
            sent_s = time.monotonic()
            answer = client.status()
            exchange = ClockExchange(sent_s, answer["now_s"], time.monotonic(), real_from_monotonic_ns())
            clock = self.state.clock
            if clock.update(exchange) and clock.exchange is not None:
                self._offset.publish(Float64(data=clock.exchange.offset_ns / NS))
            lines = messages.health(answer, clock)
            self._diagnostics.publish(messages.diagnostics(self.now_ns(), lines))
            self._over.wait(STATUS_S)

    def _follow_events(self, client: Client) -> None:
        for event in client.events("joints", "operation", "mast"):
            value: Any = event["value"]
            if event["topic"] == "mast" and value["digest"] != self._mast_digest:
                self._read_rig()
            elif event["topic"] == "joints":
                self._publish_joints(value)
            elif event["topic"] == "operation" and value["state"] in ENDED and event["key"] not in self._ends:
                self._ends.append(event["key"])
                self._publish_operation(value)
            if self._over.is_set():
                return

    def _follow_pictures(self, client: Client) -> None:
        """Publish pictures of the cameras that have a subscriber, when they come."""
        if not self._cameras:
            self._over.wait()
            return
        with client.live_pictures(*self._cameras) as line:
            idle = set(self._cameras)
            while not self._over.is_set():
                for camera in filter(self._subscribed, tuple(idle)):
                    idle.discard(camera)
                    line.wanted(camera)
                picture = line.next(PICTURE_S)
                if picture is None:
                    continue
                camera = str(picture.facts["camera"])
                if self._subscribed(camera):
                    line.wanted(camera)  # before it is published: the next one is on its way meanwhile
                    self._publish_picture(picture)
                else:
                    idle.add(camera)

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
            log.warning("tf2_msgs is not installed: no /tf is published, and tf of others is not received")
            return
        self._tf = self.create_publisher(self._tf_message, "/tf", TF)
        self._tf_static = self.create_publisher(self._tf_message, "/tf_static", LATCHED)
        group = ReentrantCallbackGroup()
        for topic, static, profile in (("/tf", False, TF), ("/tf_static", True, MANY_LATCHED)):
            self.create_subscription(
                self._tf_message, topic, lambda message, static=static: self._receive(message, static),
                profile, callback_group=group,
            )  # fmt: skip

    def _publish_transforms(self, transforms: list[TransformStamped], static: bool) -> None:
        for one in transforms:
            self._own.add(one.child_frame_id)
            self._put(one, static)
        if self._tf is not None:
            (self._tf_static if static else self._tf).publish(self._tf_message(transforms=transforms))

    def _receive(self, message: Any, static: bool) -> None:
        for one in message.transforms:
            if one.child_frame_id not in self._own:
                self._put(one, static)

    def _put(self, one: TransformStamped, static: bool) -> None:
        parent, child = one.header.frame_id.lstrip("/"), one.child_frame_id.lstrip("/")
        try:
            rigid = messages.rigid(one)
        except ValueError as error:
            log.warning("a transform of tf is left out: %s", error)
        else:
            self.state.tree.put(parent, child, messages.ns_of(one.header.stamp), rigid, static)

    def _publish_joints(self, joints: dict[str, Any]) -> None:
        at_ns = self.state.clock.stamp_ns(joints["measured_s"])
        self.state.joints = joints
        rig = self.state.rig
        if at_ns is None or rig is None:
            return
        self._joint_states.publish(messages.joint_state(self.names, at_ns, joints))
        true_rad = joints["true_pan_rad"], joints["true_tilt_rad"]
        self._publish_transforms(messages.moving_transforms(self.names, rig, at_ns, *true_rad), False)

    def _publish_operation(self, record: Mapping[str, Any]) -> None:
        message = "" if record["error"] is None else record["error"]["message"]
        at_ns = self.state.clock.stamp_ns(record["ended_s"]) or self.now_ns()
        self._pointings.publish(messages.pointing(at_ns, record["id"], record["state"], message, record))
        if record["residual_px"] is None:
            return
        camera = next((one["camera"] for one in reversed(record["pointings"])), "")
        header = messages.header(at_ns, self.names.optical(camera))
        self._sigma.publish(messages.residual(header, record["residual_sigma_px"] or (None, None)))
        self._residual.publish(messages.residual(header, record["residual_px"]))

    def _subscribed(self, camera: str) -> bool:
        return any(publisher.get_subscription_count() for publisher in self._images[camera])

    def _publish_picture(self, picture: LivePicture) -> None:
        facts = picture.facts
        at_ns = self.state.clock.stamp_ns(facts["mid_exposure_s"])
        if at_ns is None:
            return
        camera = facts["camera"]
        self.state.put_image(camera, at_ns, facts["frame_id"])
        image, info = self._images[camera]
        header = messages.header(at_ns, self.names.optical(camera))
        jpeg = array("B", picture.jpeg)  # bytes are checked one by one
        image.publish(CompressedImage(header=header, format="jpeg", data=jpeg))
        if camera in self._infos:
            self._infos[camera].header = header
            info.publish(self._infos[camera])

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
        self.state.use_rig(rig)
        self._infos = {}
        for name in self._cameras:
            if name not in self.state.lenses:
                continue
            lens, twin, off = self.state.lenses[name]
            log.info("%s: %s, at most %.4f px off", name, lens, off.worst_px)
            if name not in self._latched:
                topic = f"{self.names.topic(name)}/camera_info_error_px"
                self._latched[name] = self.create_publisher(Float64, topic, LATCHED)
            self._latched[name].publish(Float64(data=off.worst_px))
            self._infos[name] = messages.camera_info(lens, twin)
        self._publish_transforms(messages.fixed_transforms(self.names, self.state, rig, self.now_ns()), True)

    # What ROS requests

    def _subscribe(self) -> None:
        group = ReentrantCallbackGroup()
        self.declare_parameter(REASON, "")

        def trajectory(message: Any) -> None:
            if message.points:
                request = lambda client: messages.angles_of(message, self.names, client)  # noqa: E731
                self._carry_out(Goal("joint_trajectory", request))
            else:
                self.steering.stop()

        def point_at(message: Any) -> None:
            self._carry_out(
                Goal("point_at", lambda client: messages.point_of(message, self.names, self.state))
            )

        def point_at_pixel(message: Any) -> None:
            self._carry_out(
                Goal("point_at_pixel", lambda client: messages.pixel_of(message, self.names, self.state))
            )

        for kind, topic, take in (
            (JointTrajectory, "joint_trajectory", trajectory),
            (PointStamped, "point_at", point_at),
            (PointStamped, "point_at_pixel", point_at_pixel),
        ):
            self.create_subscription(kind, topic, take, RELIABLE, callback_group=group)
        services = (("stop", self._stop), ("estop", self._estop), ("reset", self._reset))
        for name, answer in services:
            self.create_service(Trigger, f"~/{name}", answer, callback_group=group)

    def _carry_out(self, goal: Goal) -> GoalOutcome:
        """Carry a goal out; one that never became an operation, whose end is published, is published here."""
        outcome = self.steering.carry_out(goal)
        if outcome.operation is None:
            array = messages.pointing(self.now_ns(), goal.name, outcome.state, outcome.message, None)
            self._pointings.publish(array)
        return outcome

    def _stop(self, request: Any, answer: Any) -> Any:
        try:
            return self._answered(answer, lambda client: "stopped" if client.stop() else "")
        finally:
            self.steering.stop()  # what waits for its turn or for tf must not begin after the stop

    def _estop(self, request: Any, answer: Any) -> Any:
        def estop(client: Client) -> str:
            record = client.estop(reason="requested by ROS 2", name=NAME)
            return str(record.get("message") or "stopped and latched; ~/reset releases it")

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

    def _answered(self, answer: Any, command: Callable[[Client], str]) -> Any:
        try:
            with self._connect() as client:
                answer.message, answer.success = command(client), True
        except ClientError as error:
            answer.message, answer.success = str(error), False
        return answer
