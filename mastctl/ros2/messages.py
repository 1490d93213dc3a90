"""Messages of ROS made of the daemon's answers, and requests of the daemon made of messages of ROS.

No node, no connection. ``*_of`` return arguments of `Client.point` and raise ValueError with a sentence.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TransformStamped, Vector3Stamped
from sensor_msgs.msg import CameraInfo, JointState
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectoryPoint

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid, quaternion_of, rot_x, rot_y, rot_z, rotation_of
from mastctl.client import Client
from mastctl.ros2.state import FRAMES, NS, DaemonState, NoTransform, RosNames, RosTime

OK, WARN, ERROR = 0, 1, 2
LEVELS = {"fault": ERROR} | dict.fromkeys(("stopped", "stopping", "holding", "starting", "closing"), WARN)
TF_WAIT_S = 1.0
FAR_M = 1e6


def header(at_ns: int, frame: str = "") -> Header:
    """Return a header with nanoseconds since 1970 as ROS has them."""
    return Header(stamp=Time(sec=at_ns // NS, nanosec=at_ns % NS), frame_id=frame)


def ns_of(stamp: Any) -> int:
    """Return a ``builtin_interfaces/Time`` as nanoseconds."""
    return int(stamp.sec) * NS + int(stamp.nanosec)


def joint_state(names: RosNames, at_ns: int, joints: Mapping[str, Any]) -> JointState:
    """Return a reading of the head."""
    positions = [joints[key] for key in names.joints.values()]
    return JointState(header=header(at_ns), name=list(names.joints), position=positions)


def feedback(
    kind: Any, names: RosNames, at_ns: int, wanted: Mapping[str, float], joints: Mapping[str, Any]
) -> Any:
    """Return the feedback of a trajectory: where the joints are, and where they are wanted."""
    desired, actual = (
        [one.get(key, joints[key]) for key in names.joints.values()] for one in (wanted, joints)
    )
    off = [one - other for one, other in zip(desired, actual, strict=True)]
    points = {
        key: JointTrajectoryPoint(positions=positions)
        for key, positions in (("desired", desired), ("actual", actual), ("error", off))
    }
    return kind(header=header(at_ns), joint_names=list(names.joints), **points)


def moving_transforms(
    names: RosNames, rig: Rig, at_ns: int, true_pan_rad: float, true_tilt_rad: float
) -> list[TransformStamped]:
    """Return mast <- pan_link <- head at true joint angles."""
    mast = rig.mast
    arm = Rigid(rot_x(mast.axis_twist_rad) @ rot_y(true_tilt_rad), np.array([mast.axis_offset_m, 0.0, 0.0]))
    return [
        transform(names.mast, names.pan_link, at_ns, Rigid(rot_z(true_pan_rad), np.zeros(3))),
        transform(names.pan_link, names.head, at_ns, arm),
    ]


def fixed_transforms(names: RosNames, state: DaemonState, rig: Rig, at_ns: int) -> list[TransformStamped]:
    """Return base <- rover <- mast, and each camera's optical frame in what carries it.

    The base has ROS's axes (x ahead, y left, z up), the rover those of mastctl (y right, z down).
    """
    carriers = {"head": names.head, "rover": names.rover}
    return [
        transform(names.base, names.rover, at_ns, Rigid(np.diag([1.0, -1.0, -1.0]), np.zeros(3))),
        transform(names.rover, names.mast, at_ns, rig.mast.rover_from_mast),
        *(
            transform(carriers[camera.on], names.optical(name), at_ns, state.carrier_from_optical(rig, name))
            for name, camera in rig.cameras.items()
        ),
    ]


def transform(parent: str, child: str, at_ns: int, parent_from_child: Rigid) -> TransformStamped:
    """Return a transform as tf has it."""
    message = TransformStamped(header=header(at_ns, parent), child_frame_id=child)
    w, x, y, z = quaternion_of(parent_from_child.rotation)
    place, turn = message.transform.translation, message.transform.rotation
    place.x, place.y, place.z = parent_from_child.translation_m.tolist()
    turn.w, turn.x, turn.y, turn.z = float(w), float(x), float(y), float(z)
    return message


def rigid(message: TransformStamped) -> Rigid:
    """Return parent_from_child of a transform. Raises ValueError if it is none."""
    place, turn = message.transform.translation, message.transform.rotation
    quaternion = np.array([turn.w, turn.x, turn.y, turn.z])
    if not np.isfinite(quaternion).all() or np.linalg.norm(quaternion) < 0.1:
        raise ValueError(f"the rotation of '{message.child_frame_id}' is no quaternion")
    return Rigid(rotation_of(quaternion / np.linalg.norm(quaternion)), np.array([place.x, place.y, place.z]))


def camera_info(lens: str, camera: CameraModel) -> CameraInfo:
    """Return a camera of one of ROS's lenses; its header is set with each image."""
    width, height = camera.size_px
    shortest = 5 if lens == "plumb_bob" else len(camera.distortion)
    distortion = [*camera.distortion.tolist(), *[0.0] * (shortest - len(camera.distortion))]
    return CameraInfo(
        width=width,
        height=height,
        distortion_model=lens,
        d=distortion,
        k=camera.camera_matrix.ravel().tolist(),
        r=np.eye(3).ravel().tolist(),
        p=np.hstack([camera.camera_matrix, np.zeros((3, 1))]).ravel().tolist(),
    )


def residual(of: Header, pixels: Sequence[float | None]) -> Vector3Stamped:
    """Return a residual, or its sigma, of an image, pixels: x right, y down, NaN where not measured."""
    message = Vector3Stamped(header=of)
    message.vector.x, message.vector.y = (float("nan") if one is None else float(one) for one in pixels)
    return message


def pointing(
    at_ns: int, name: str, state: str, message: str, operation: Mapping[str, Any] | None
) -> DiagnosticArray:
    """Return how an operation ended."""
    keys = ("residual_px", "residual_sigma_px", "position_m", "range_m")
    values = {} if operation is None else {key: operation.get(key) for key in keys}
    level = OK if state == "done" else ERROR
    return diagnostics(at_ns, [status(name, level, message or state, {"state": state, **values})])


def status(
    name: str, level: int, message: str, values: Mapping[str, Any], hardware: str = ""
) -> DiagnosticStatus:
    """Return one line of diagnostics."""
    return DiagnosticStatus(
        level=bytes([level]), name=name, message=message, hardware_id=hardware,
        values=[KeyValue(key=key, value=str(value)) for key, value in values.items() if value is not None],
    )  # fmt: skip


def diagnostics(at_ns: int, lines: Iterable[DiagnosticStatus]) -> DiagnosticArray:
    """Return lines of diagnostics."""
    return DiagnosticArray(header=header(at_ns), status=list(lines))


def health(answer: Mapping[str, Any], clock: RosTime) -> list[DiagnosticStatus]:
    """Return a daemon's status as lines of diagnostics: state, clock, mast file, each camera, each fault."""
    hardware, control, state = str(answer["mast"]["name"]), answer["control"], answer["state"]
    lines = [
        status(
            "mastctl: state", LEVELS.get(state, OK), f"{state}: {answer['reason']}",
            {"steers": control and control["holder"], "hardware": answer["hardware"]}, hardware,
        ),
        _clock_line(clock, hardware),
    ]  # fmt: skip
    calibration = answer["calibration"]
    if calibration is not None:
        level = WARN if calibration["verdict"] == "drifts" else OK
        values = {key: calibration[key] for key in ("verdict", "pointings")}
        lines.append(status("mastctl: mast file", level, calibration["sentence"], values, hardware))
    faults: dict[str, list[Mapping[str, Any]]] = {name: [] for name in answer["cameras"]}
    for fault in answer["faults"]:
        faults.setdefault(fault["device"], []).append(fault)
    for device, found in faults.items():
        values = {one["code"]: f"{one['message']}; until {one['until']}" for one in found}
        message = "; ".join(one["message"] for one in found) or "no fault"
        lines.append(status(f"mastctl: {device}", ERROR if found else OK, message, values, hardware))
    return lines


def _clock_line(clock: RosTime, hardware: str) -> DiagnosticStatus:
    used = clock.exchange
    if used is None:
        return status("mastctl: clock", ERROR, "the daemon's time is not known yet", {}, hardware)
    values = {"offset_s": f"{used.offset_ns / NS:.9f}", "doubt_s": f"{used.half_s:.6f}"}
    level, message = OK, "ROS time follows the daemon's clock"
    if not clock.steady:
        level = WARN
        message = "the offset of ROS time from the daemon's clock has changed"
    return status("mastctl: clock", level, message, values, hardware)


# Requests


def angles_of(trajectory: Any, names: RosNames, client: Client) -> dict[str, float]:
    """Return the joint angles of a trajectory's last point; a joint that it leaves out stays."""
    given = list(trajectory.joint_names)
    if not given or len(set(given)) != len(given) or not set(given) <= set(names.joints):
        known = " and ".join(names.joints)
        raise ValueError(f"the trajectory names the joints {given} where {known} are expected, once each")
    if not trajectory.points:
        raise ValueError("the trajectory has no point")
    last = list(trajectory.points[-1].positions)
    if len(last) != len(given) or not all(map(math.isfinite, last)):
        raise ValueError(
            f"the last point's positions are {last} where finite radians of {given} are expected"
        )
    joints = client.status()["joints"]
    if joints is None and len(given) < 2:
        raise ValueError("the head was not read yet; a trajectory of both joints is expected")
    stays = {} if joints is None else {"pan_rad": joints["pan_rad"], "tilt_rad": joints["tilt_rad"]}
    return stays | {names.joints[name]: float(value) for name, value in zip(given, last, strict=True)}


def point_of(message: Any, names: RosNames, state: DaemonState) -> dict[str, Any]:
    """Return the point in the rover frame, metres, of a ``PointStamped`` of any frame that tf knows."""
    frame = message.header.frame_id.lstrip("/")
    point = [float(message.point.x), float(message.point.y), float(message.point.z)]
    if not all(map(math.isfinite, point)):
        raise ValueError(f"the point is {point} where finite meters are expected")
    if not frame:
        raise ValueError("the point's header has no frame_id")
    if frame != names.rover:
        at_ns = ns_of(message.header.stamp)
        try:
            point = state.tree.transform(names.rover, frame, at_ns, TF_WAIT_S).points(point).tolist()
        except NoTransform as error:
            raise ValueError(str(error)) from None
    return {"position_m": point, "frame": "rover"}


def pixel_of(message: Any, names: RosNames, state: DaemonState) -> dict[str, Any]:
    """Return the pixel of a named frame of a ``PointStamped``: x, y pixels, z the range, metres, or 0.

    Its frame is a camera's optical one, and its stamp that of the image.
    """
    at_ns = ns_of(message.header.stamp)
    x_px, y_px, range_m = float(message.point.x), float(message.point.y), float(message.point.z)
    if not (all(map(math.isfinite, (x_px, y_px, range_m))) and range_m >= 0.0):
        raise ValueError(
            f"the point is {[x_px, y_px, range_m]} where a pixel and a range (meters, or 0) are expected"
        )
    if state.rig is None:
        raise ValueError("the daemon's mast file cannot be read, so that its cameras are not known")
    frame = message.header.frame_id.lstrip("/")
    camera = next((name for name in state.rig.cameras if names.optical(name) == frame), None)
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
