"""Messages of ROS made of the daemon's answers: no node, no connection."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import TransformStamped, Vector3Stamped
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Header

from calib.geometry.cahvor import CameraModel
from calib.geometry.rig import Rig
from calib.geometry.rigid import Rigid, quaternion_of, rot_x, rot_y, rot_z, rotation_of
from mastctl.ros2.state import DaemonState, RosNames, RosTime
from mastctl.ros2.tf_tree import NS

OK, WARN, ERROR = 0, 1, 2
LEVELS = {"fault": ERROR} | dict.fromkeys(("stopped", "stopping", "holding", "starting", "closing"), WARN)


def stamp(ns: int) -> Time:
    """Return nanoseconds since 1970 as ROS has them."""
    return Time(sec=ns // NS, nanosec=ns % NS)


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
    message = TransformStamped(header=Header(stamp=stamp(at_ns), frame_id=parent), child_frame_id=child)
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


def residual(header: Header, pixels: Sequence[float | None]) -> Vector3Stamped:
    """Return a residual, or its sigma, of an image, pixels: x right, y down, NaN where not measured."""
    message = Vector3Stamped(header=header)
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
    return DiagnosticArray(header=Header(stamp=stamp(at_ns)), status=list(lines))


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
    values = {"offset_s": f"{used.offset_ns / NS:.9f}", "doubt_s": f"{used.half_s:.6f}", "steps": clock.steps}
    level, message = OK, "ROS time follows the daemon's clock"
    if not clock.steady:
        level, message = (
            WARN,
            f"the offset of ROS time from the daemon's clock has changed {clock.steps} times",
        )
    return status("mastctl: clock", level, message, values, hardware)
